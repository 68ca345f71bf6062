# SPDX-License-Identifier: Apache-2.0
"""A shot as an Open Job Description job: openjd accepts it and runs it."""

import json
import os
import re
import shutil
import signal
import subprocess
import sysconfig
import time
from pathlib import Path

import pytest

from oiio_msspl.errors import MssplError
from oiio_msspl.jobs.farm import openjd as bundles
from tests.conftest import write_exr
from tests.jobs.test_over_time import make_shot_with_passes
from tests.programs import fuse, run
from tests.shots import contents, layers, make_shot, pixels

SCRIPTS = sysconfig.get_path("scripts")


def submit(folder, *more, lr="lr", hr="hr", out="out"):
    return run("msspl", "submit", folder / lr, folder / hr, "-o", folder / out, "--bundle", folder / "job", *more)


def openjd(folder, *more):
    """``openjd run`` of a bundle, as a process."""
    pytest.importorskip("openjd.cli")
    program = shutil.which("openjd", path=SCRIPTS)
    values = f"file://{folder / 'job/openjd_values.json'}"
    return subprocess.Popen(
        [program, "run", str(folder / "job/template.json"), "--job-param", values, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}"},
    )


def test_the_bundle_is_a_valid_job_of_both_forms(tmp_path, bilinear_models):
    """Open Job Description's own model accepts template and values, and chunks the frames; Deadline Cloud's file has
    the same values; a file that an option names is a parameter, for the farm to copy."""
    model = pytest.importorskip("openjd.model")
    make_shot(tmp_path, 6)
    (tmp_path / "hr/beauty.1004.exr").unlink()
    elsewhere = ("--map", "albedo=a.exr", "--device", "cuda")  # which need not be usable here
    more = ("--chunk", 3, "--timeout", 60, "--layers", "a b", "--half")
    done = submit(tmp_path, "--model", bilinear_models[4], *elsewhere, *more)
    assert done.returncode == 0, done.stderr
    assert "beauty.####.exr lacks 1004" in done.stderr and "6 frames" in done.stdout
    data = json.loads((tmp_path / "job/template.json").read_text())
    values = json.loads((tmp_path / "job/openjd_values.json").read_text())
    template = model.decode_job_template(template=data, supported_extensions=["TASK_CHUNKING"])
    parameters = model.preprocess_job_parameters(
        job_template=template, job_parameter_values=values, job_template_dir=tmp_path, current_working_dir=tmp_path
    )
    step = model.create_job(job_template=template, job_parameter_values=parameters).steps[0]
    chunks = [task["Frame"].value for task in model.StepParameterSpaceIterator(space=step.parameterSpace)]
    assert chunks == ["1001-1003", "1004-1006"]

    action = data["steps"][0]["script"]["actions"]["onRun"]
    assert action["timeout"] == 180
    assert action["cancelation"]["mode"] == "NOTIFY_THEN_TERMINATE"
    assert action["args"][-3:] == ["--layers", "a b", "--half"]
    assert action["args"][action["args"].index("--map") + 1] == f"albedo={Path('a.exr').absolute()}"
    assert values["Model"] == str(bilinear_models[4])
    kinds = {p["name"]: (p.get("objectType"), p.get("dataFlow")) for p in data["parameterDefinitions"]}
    assert kinds["HRFolder"] == ("DIRECTORY", "IN")
    assert kinds["OutFolder"] == ("DIRECTORY", "OUT")
    assert kinds["Model"] == ("FILE", "IN")
    for_deadline = json.loads((tmp_path / "job/parameter_values.json").read_text())["parameterValues"]
    assert {each["name"]: each["value"] for each in for_deadline} == values


def test_openjd_runs_it_and_names_survive(tmp_path, bilinear_models):
    """Every second frame, in chunks, under names that a shell would take apart: the frames of a local run."""
    names = {"lr": """it's "low" $HOME""", "hr": "high & {{Task.Param.Frame}}", "out": "a;b 'c'"}
    make_shot(tmp_path, 15, names["lr"], names["hr"])
    more = ("--model", bilinear_models[4], "--layers", "albedo", "--no-preview")
    frames = ("--frames", "1001-1015x2")
    done = submit(tmp_path, *frames, "--chunk", 4, *more, **names)
    assert done.returncode == 0, done.stderr
    process = openjd(tmp_path)
    said = process.communicate()[0]
    assert process.returncode == 0, said
    assert "Frame(CHUNK[INT]) = 1001-1007:2" in said
    assert re.findall(r"openjd_progress: (.*)", said) == ["25.0", "50.0", "75.0", "100.0"] * 2
    assert "openjd_status: frame 1003 fused, 2 of 4 done" in said

    local = fuse(tmp_path / names["lr"], tmp_path / names["hr"], "-o", tmp_path / "local", *frames, *more)
    assert local.returncode == 0, local.stderr
    assert contents(tmp_path / names["out"]) == contents(tmp_path / "local")


@pytest.fixture(scope="module")
def averaged(tmp_path_factory, bilinear_models):
    """A shot with passes that is averaged with its neighbours in one run: local/."""
    folder = make_shot_with_passes(tmp_path_factory.mktemp("averaged"), count=8)
    options = ("--model", bilinear_models[4], "--no-preview")
    done = fuse(folder / "lr", folder / "hr", "-o", folder / "local", *options)
    assert done.returncode == 0, done.stderr
    assert "Fuses with 4 frames before and after each: motion vectors" in done.stdout
    return folder


@pytest.mark.parametrize("chunk", [1, 3, 7])
def test_tasks_average_frames_with_neighbours_of_other_tasks(averaged, bilinear_models, tmp_path, chunk):
    """Each task sees the files of the whole shot, so it plans as one run does, and gives the same frames."""
    for name in ("lr", "hr"):
        (tmp_path / name).symlink_to(averaged / name)
    done = submit(tmp_path, "--chunk", chunk, "--model", bilinear_models[4], "--no-preview")
    assert done.returncode == 0, done.stderr
    process = openjd(tmp_path)
    said = process.communicate()[0]
    assert process.returncode == 0, said
    assert len(re.findall(r"Frame\(CHUNK\[INT\]\) = ", said)) == -(-8 // chunk)
    assert pixels(tmp_path / "out") == pixels(averaged / "local")


def test_a_bad_frame_fails_its_task_and_the_next_try_does_only_that_one(tmp_path, bilinear_models):
    make_shot(tmp_path, 4)
    (tmp_path / "hr/beauty.1003.exr").write_text("no EXR")
    assert submit(tmp_path, "--model", bilinear_models[4], "--chunk", 2).returncode == 0
    process = openjd(tmp_path)
    said = process.communicate()[0]
    assert process.returncode != 0
    assert re.search(r"openjd_fail: frame 1003: .*beauty\.1003\.exr: can't be opened", said), said
    assert "exited with code: 2" in said
    assert sorted(p.name for p in (tmp_path / "out").glob("*.exr")) == [f"beauty.{n}.exr" for n in (1001, 1002, 1004)]

    write_exr(tmp_path / "hr/beauty.1003.exr", layers(1003))
    process = openjd(tmp_path)
    said = process.communicate()[0]
    assert process.returncode == 0, said
    assert re.findall(r"frame (\d+) fused", said) == ["1003"]
    assert len(re.findall(r"frame \d+ skipped", said)) == 3


def test_a_canceled_job_ends_with_whole_frames(tmp_path, bilinear_models):
    make_shot(tmp_path, 100)
    assert submit(tmp_path, "--model", bilinear_models[4], "--no-preview", "--chunk", 100).returncode == 0
    process = openjd(tmp_path)
    while sum(1 for _ in tmp_path.glob("out/beauty.*.exr")) < 3:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    said = process.communicate()[0]
    assert process.returncode != 0
    assert "exited with code: 143" in said
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == [f"beauty.{n}.exr" for n in range(1001, 1001 + len(files))]
    assert re.findall(r"frame (\d+) fused", said)[-1] == files[-1].split(".")[1]
    assert 3 <= len(files) < 100


def test_a_bundle_that_cannot_be_completed_leaves_no_folder(tmp_path, monkeypatch):
    def full(*_, **__):
        raise MssplError("the disk is full")

    monkeypatch.setattr(bundles, "replacing", full)
    with pytest.raises(MssplError, match="full"):
        bundles.write_bundle(tmp_path / "job", bundles.Job(None, {}, {}))
    assert not (tmp_path / "job").exists()
