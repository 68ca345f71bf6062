# SPDX-License-Identifier: Apache-2.0
"""A shot on many machines: as an Open Job Description job that openjd runs, and on the workers of a Dask dask_cluster."""

import json
import os
import re
import shutil
import signal
import subprocess
import sysconfig
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from oiio_msspl.exr import preview
from oiio_msspl.jobs import dask_cluster, shot
from oiio_msspl import InputError, fuse_shot
from oiio_msspl.exr.preview import write_png
from oiio_msspl.jobs.dask_cluster import _sessions
from oiio_msspl.jobs.shot import Stages
from tests.conftest import write_exr
from tests.test_cli import fuse, run
from tests.test_shot import contents, layers, low_layers

SCRIPTS = sysconfig.get_path("scripts")


def make_shot(folder, count, lr="lr", hr="hr"):
    for name in (lr, hr):
        (folder / name).mkdir(parents=True)
    for frame in range(1001, 1001 + count):
        write_exr(folder / lr / f"lr.{frame}.exr", low_layers(frame))
        write_exr(folder / hr / f"beauty.{frame}.exr", layers(frame))
    return folder


def submit(folder, *more, lr="lr", hr="hr", out="out"):
    return run("msspl", "submit", folder / lr, folder / hr, "-o", folder / out, "--bundle", folder / "job", *more)


# ------------------------------------------------------------------------------------------------ the job


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lr", "hr", "-o", "out", "--overwrite"], "--overwrite has no meaning in a job"),
        (["lr", "hr", "-o", "out", "--json"], "--json has no meaning in a job"),
        (["lr", "hr", "-o", "out", "--layout", "x"], "--layout 'x': use one of"),
        (["lr", "hr", "-o", "out", "--model", "x"], "no model 'x'"),
        (["lr", "hr", "-o", "out", "--model", "text.onnx"], "text.onnx: can't be read as an ONNX file"),
        (["lr", "hr", "-o", "out", "--device", "abacus"], "--device 'abacus': use one of cpu"),
        (["lr", "hr", "-o", "hr"], "hr/beauty.1001.exr: is one of the inputs"),
        (["lr", "hr", "-o", "no/out"], "no/out: the folder no does not exist"),
        (["lr", "hr", "-o", "text.onnx/out"], "the folder text.onnx does not exist"),
        (["lr", "hr", "-o", "out", "--layers", "{{a}}"], "for the start of a parameter"),
        (["lr", "hr", "-o", "out", "--frames", "5-7"], "no frame is in both"),
        (["lr/lr.1001.exr", "hr/beauty.1001.exr", "-o", "out.exr"], "a job is for a shot"),
        (["lr", "no", "-o", "out"], "no: is a single file"),
        (["lr", "hr", "-o", "out", "--colour"], "No such option"),
        (["lr", "hr"], "Missing option"),
        (["lr", "hr", "-o", "out", "--bundle", "hr"], "hr: exists; name a new folder"),
    ],
)
def test_what_no_task_could_do_is_said_at_submission(tmp_path, monkeypatch, arguments, message):
    make_shot(tmp_path, 1)
    (tmp_path / "text.onnx").write_text("no model")
    monkeypatch.chdir(tmp_path)
    done = run("msspl", "submit", "--bundle", "job", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / "job").exists()


@pytest.mark.parametrize(
    ("given", "model"), [([], "pyramid"), (["--model", "auto"], "pyramid"), (["--model", "paper-x4"], "paper-x4")]
)
def test_a_shipped_model_goes_by_its_name_and_is_the_same_for_all_tasks(tmp_path, given, model):
    make_shot(tmp_path, 1)
    assert submit(tmp_path, *given).returncode == 0
    action = json.loads((tmp_path / "job/template.json").read_text())["steps"][0]["script"]["actions"]["onRun"]
    assert action["args"][-2:] == ["--model", model]


# ------------------------------------------------------------------------------------------------ Dask


@pytest.fixture(scope="module")
def two_workers(tmp_path_factory):
    """A cluster of two worker processes, as ``dask scheduler`` and ``dask worker --nthreads 1`` make it."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        memory_limit=0,
        dashboard_address="127.0.0.1:0",
        local_directory=tmp_path_factory.mktemp("dask"),
        silence_logs=50,
    ) as made:
        yield made


@pytest.fixture
def client(two_workers):
    from distributed import Client

    with Client(two_workers) as made:
        made.wait_for_workers(2)  # the cluster starts another one for one that died
        yield made


def hang_in_writing(marker):
    """In a worker: leave what there is in the middle of writing a frame, tell, and go no further."""

    def write(self, report, fused):
        write_png(report.preview, np.zeros((2, 2, 3)))  # of a frame that is not there
        report.output.with_name(f".{report.output.stem}.{os.getpid()}.tmp.exr").write_bytes(b"half")
        marker.touch()
        time.sleep(1000)

    Stages.write = write


def loaded_models():
    """In a worker: how often it has started to load models anew."""
    return _sessions.cache_info().misses


def test_a_worker_killed_in_the_middle_of_a_frame_loses_nothing(tmp_path, bilinear_models, client):
    """Another one takes the frame over, and every file is that of a local run; nothing else is there."""
    make_shot(tmp_path, 10)
    settings = {"model": str(bilinear_models[4]), "previews": True}
    fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "local", **settings)
    processes = client.run(os.getpid)
    victim = next(iter(processes))
    client.run(hang_in_writing, tmp_path / "writing", workers=[victim])
    killed = []

    def kill(result, report):
        if not killed:
            while not (tmp_path / "writing").exists():
                time.sleep(0.01)
            os.kill(processes[victim], signal.SIGKILL)
            killed.append(len(report.results))

    report_path = tmp_path / "r.json"
    report = fuse_shot(
        tmp_path / "lr",
        tmp_path / "hr",
        tmp_path / "out",
        client=client,
        progress=kill,
        report_path=report_path,
        **settings,
    )
    assert killed == [1]
    assert report.exit_code == 0
    assert [result.status for result in report.results.values()] == ["fused"] * 10
    assert contents(tmp_path / "out") == contents(tmp_path / "local")
    saved = json.loads(report_path.read_text())
    assert saved["finished"] and saved["counts"]["fused"] == 10
    assert [entry["frame"] for entry in saved["frames"]] == list(range(1001, 1011))


def test_the_program_says_of_a_cluster_what_it_says_of_a_local_run(tmp_path, bilinear_models, two_workers, client):
    """Table, messages, exit code; bad frames stop no others; each worker loads the model once."""
    make_shot(tmp_path, 6)
    (tmp_path / "hr/beauty.1002.exr").write_text("no EXR")
    (tmp_path / "hr/beauty.1004.exr").unlink()
    known = client.run(loaded_models)
    said = []
    for out, more in (("local", []), ("out", ["--scheduler", two_workers.scheduler_address])):
        done = fuse(tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / out, "--model", bilinear_models[4], *more)
        assert done.returncode == 2, done.stderr
        table = re.sub(r"read as in frame \d+", "read", done.stdout.replace(f"/{out}/", "/"))
        said.append((re.sub(r"\d+\.\d s.*", "", table), sorted(done.stderr.splitlines())))
    assert said[0] == said[1]
    assert "fused    4  1001-1005x2,1006" in said[1][0]
    assert contents(tmp_path / "out") == contents(tmp_path / "local")
    assert all(after - known[address] <= 1 for address, after in client.run(loaded_models).items())


def test_a_frame_that_kills_its_workers_is_given_up(tmp_path, bilinear_models, two_workers, client):
    make_shot(tmp_path, 1)
    two_workers.scheduler.allowed_failures, usual = 0, two_workers.scheduler.allowed_failures

    def die(self, frame):
        os._exit(1)

    client.run(partial(setattr, Stages, "read"), die)
    try:
        report = fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out", client=client)
    finally:
        two_workers.scheduler.allowed_failures = usual
        client.restart()
    assert report.exit_code == 1
    assert "every worker that tried it died" in report.results[1001].message


def test_a_worker_of_several_threads_is_refused(tmp_path):
    distributed = pytest.importorskip("distributed")
    make_shot(tmp_path, 1)
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as made,
        distributed.Client(made) as client,
        pytest.raises(InputError, match="2 frames at a time; start it with --nthreads 1"),
    ):
        fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out", client=client)


def test_an_address_without_a_scheduler_is_a_mistake(tmp_path):
    pytest.importorskip("distributed")
    make_shot(tmp_path, 1)
    done = fuse(tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / "out", "--scheduler", "nobody")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --scheduler nobody: no Dask scheduler answers there")
    assert done.stderr.count("\n") == 1
