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

from oiio_msspl.errors import InputError, MssplError
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
    more = ("--chunk", 3, "--timeout", 60, "--layers", "a b", "--half", "--max-memory", "4G", "--conda", "oiio-msspl")
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
    assert {"--no-preview", "--update"} <= {*action["args"]} and "--skip-existing" not in action["args"]
    needs = {amount["name"]: amount["min"] for amount in data["steps"][0]["hostRequirements"]["amounts"]}
    assert needs == {"amount.worker.memory": 4096, "amount.worker.gpu": 1}
    assert data["name"] == f"msspl-fuse {'/'.join((*tmp_path.parts[-2:], 'hr/beauty'))} 1001-1006"
    assert values["CondaPackages"] == "oiio-msspl"
    assert all(p["userInterface"]["label"] for p in data["parameterDefinitions"])
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
    # With neighbours, the others are fused again, too: they lacked this one.
    options = ("--model", bilinear_models[4], "--chunk", 2, "--temporal", "off")
    assert submit(tmp_path, *options).returncode == 0
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


def test_a_resubmitted_job_fuses_what_was_rendered_again(tmp_path, bilinear_models):
    """Before, the frames of the first job were kept, whatever had become of their renders."""
    make_shot(tmp_path, 3)
    assert submit(tmp_path, "--model", bilinear_models[4], "--temporal", "off").returncode == 0
    assert openjd(tmp_path).communicate()[0] and (tmp_path / "out/beauty.1003.exr").exists()
    before = contents(tmp_path / "out")
    assert sorted(before) == [f"beauty.{number}.exr" for number in (1001, 1002, 1003)]  # and no preview
    write_exr(tmp_path / "hr/beauty.1002.exr", layers(7) | {"Z": layers(7)["Z"] * 2})
    later = time.time() + 2
    os.utime(tmp_path / "hr/beauty.1002.exr", (later, later))
    said = openjd(tmp_path).communicate()[0]
    assert re.findall(r"frame (\d+) fused", said) == ["1002"], said
    after = contents(tmp_path / "out")
    assert [name for name in before if before[name] != after[name]] == ["beauty.1002.exr"]


@pytest.mark.parametrize("chunk", [2, 5])
def test_a_job_of_one_render_a_frame_gives_the_frames_of_one_run(tmp_path, chunk):
    """With a model that ships, and with neighbours of other tasks."""
    make_shot_with_passes(tmp_path, count=5)
    options = ("--quality", "fast", "--no-preview")
    bundle = ("--bundle", tmp_path / "job", "--chunk", chunk)
    assert run("msspl", "submit", tmp_path / "hr", "-o", tmp_path / "out", *options, *bundle).returncode == 0
    values = json.loads((tmp_path / "job/openjd_values.json").read_text())
    assert "LRFolder" not in values
    process = openjd(tmp_path)
    said = process.communicate()[0]
    assert process.returncode == 0, said
    assert len(re.findall(r"Frame\(CHUNK\[INT\]\) = ", said)) == -(-5 // chunk)
    local = fuse(tmp_path / "hr", "-o", tmp_path / "local", *options)
    assert local.returncode == 0 and "frames before and after each" in local.stdout, local.stderr
    assert pixels(tmp_path / "out") == pixels(tmp_path / "local")


def test_a_launcher_runs_the_program(tmp_path, bilinear_models):
    make_shot(tmp_path, 1)
    launcher = f"env MSSPL_TEST=1 '{SCRIPTS}/msspl-fuse'"
    options = ("--model", bilinear_models[4], "--command", launcher, "--name", "sh010 denoise", "--preview")
    assert submit(tmp_path, *options).returncode == 0
    template = json.loads((tmp_path / "job/template.json").read_text())
    action = template["steps"][0]["script"]["actions"]["onRun"]
    assert (template["name"], action["command"]) == ("sh010 denoise", "env")
    assert action["args"][:2] == ["MSSPL_TEST=1", f"{SCRIPTS}/msspl-fuse"]
    process = openjd(tmp_path)
    assert process.communicate()[0] and process.returncode == 0
    assert sorted(contents(tmp_path / "out")) == ["beauty.1001.exr", "beauty.1001.png"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"command": "a 'b"}, r"can't be read \(No closing quotation\)"),
        ({"command": ""}, "is empty"),
        ({"command": "{{x}}"}, "start of a parameter"),
        ({"name": "{{x}}"}, "start of a parameter"),
        ({"packages": {"pip": "x"}}, "use one of conda, rez"),
        ({"max_memory": "much"}, "write it as 3G"),
    ],
)
def test_what_a_job_cannot_say_is_refused(tmp_path, arguments, message):
    make_shot(tmp_path, 1)
    with pytest.raises(InputError, match=message):
        bundles.make_job(tmp_path / "lr", tmp_path / "hr", tmp_path / "out", **arguments)


def test_a_worker_without_gpu_will_do_for_the_cpu(tmp_path):
    make_shot(tmp_path, 1)
    job = bundles.make_job(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert job.template["steps"][0]["hostRequirements"] == {"amounts": [{"name": "amount.worker.memory", "min": 3072}]}


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


def test_a_bundle_takes_no_folder_that_another_one_makes_meanwhile(tmp_path, monkeypatch):
    monkeypatch.setattr(bundles, "check_folder", lambda folder: None)
    monkeypatch.setattr(Path, "exists", lambda path: False)
    (tmp_path / "job").mkdir()
    (tmp_path / "job/mine").touch()
    with pytest.raises(InputError, match="can't be made"):
        bundles.write_bundle(tmp_path / "job", bundles.Job(None, {}, {}))
    assert [path.name for path in (tmp_path / "job").iterdir()] == ["mine"]


def test_a_bundle_that_cannot_be_completed_leaves_no_folder(tmp_path, monkeypatch):
    def full(*_, **__):
        raise MssplError("the disk is full")

    monkeypatch.setattr(bundles, "replacing", full)
    with pytest.raises(MssplError, match="full"):
        bundles.write_bundle(tmp_path / "job", bundles.Job(None, {}, {}))
    assert not (tmp_path / "job").exists()
