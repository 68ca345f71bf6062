# SPDX-License-Identifier: Apache-2.0
"""A shot on the workers of a Dask cluster."""

import json
import os
import re
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from oiio_msspl import InputError, MssplError, fuse_shot
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.jobs import pipeline
from oiio_msspl.jobs.farm import dask as dask_cluster
from oiio_msspl.jobs.farm.dask import _sessions, connect, fuse_frames
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.plan import ShotPlan, TemporalOptions
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from tests.jobs.test_over_time import make_shot_with_passes
from tests.programs import fuse
from tests.shots import contents, make_shot, write_png


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

    def write(frame, existing):
        write_png(frame.report.preview)  # of a frame that is not there
        with replacing(frame.report.output) as temporary:
            temporary.write_bytes(b"half")
            marker.touch()
            time.sleep(1000)

    pipeline.write_settled = write


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


def test_passes_and_neighbours_on_a_cluster_are_those_of_a_local_run(tmp_path, bilinear_models, client):
    """A task of eight frames needs the files of frames of the other one."""
    shot = make_shot_with_passes(tmp_path, count=12)
    for out, more in (("local", {}), ("out", {"client": client})):
        report = fuse_shot(
            shot / "lr", shot / "hr", shot / out, model=str(bilinear_models[4]), temporal=TemporalOptions("4"), **more
        )
        assert report.exit_code == 0 and "with 4 frames" in report.temporal
    assert len(contents(shot / "out")) == 12
    assert contents(shot / "out") == contents(shot / "local")


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
        table = re.sub(r"layers of frame \d+", "layers", done.stdout.replace(f"/{out}/", "/"))
        said.append((re.sub(r"\d+\.\d s.*", "", table), sorted(done.stderr.splitlines())))
    assert said[0] == said[1]
    assert "fused    4  1001-1005x2,1006" in said[1][0]
    assert contents(tmp_path / "out") == contents(tmp_path / "local")
    assert all(after - known[address] <= 1 for address, after in client.run(loaded_models).items())


def test_overwrite_replaces_frames_on_a_cluster(tmp_path, bilinear_models, client):
    """Also the second time. A frame that fails is not taken for one that another run has fused."""
    make_shot(tmp_path, 3)
    (tmp_path / "hr/beauty.1003.exr").write_text("no EXR")
    settings = {"model": str(bilinear_models[4]), "previews": True}
    fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "local", **settings)
    (tmp_path / "out").mkdir()
    old = {f"beauty.{number}.{suffix}": b"old" for number in (1001, 1002, 1003) for suffix in ("exr", "png")}
    for name, content in old.items():
        (tmp_path / "out" / name).write_bytes(content)
    for _ in range(2):
        report = fuse_shot(
            tmp_path / "lr", tmp_path / "hr", tmp_path / "out", client=client, overwrite=True, **settings
        )
        assert [result.status for result in report.results.values()] == ["fused", "fused", "failed"]
        assert contents(tmp_path / "out") == old | contents(tmp_path / "local")


def test_workers_in_another_folder_see_that_the_file_of_a_mapping_is_newer(
    tmp_path, bilinear_models, monkeypatch, client
):
    make_shot(tmp_path, 1)
    (tmp_path / "map.toml").write_text('albedo = "albedo"')
    monkeypatch.chdir(tmp_path)
    settings = {"model": str(bilinear_models[4]), "inputs": InputOptions(map_file=Path("map.toml"))}
    assert fuse_shot("lr", "hr", "out", **settings).exit_code == 0
    later = Path("out/beauty.1001.exr").stat().st_mtime + 9
    os.utime("map.toml", (later, later))
    assert fuse_shot("lr", "hr", "out", client=client, update=True, **settings).results[1001].status == "fused"


def test_a_frame_that_kills_its_workers_is_given_up(tmp_path, bilinear_models, two_workers, client):
    make_shot(tmp_path, 1)
    two_workers.scheduler.allowed_failures, usual = 0, two_workers.scheduler.allowed_failures

    def die(self, files):
        os._exit(1)

    client.run(partial(setattr, ShotRun, "read"), die)
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


@pytest.mark.parametrize("text", ["{}", "[]", "no JSON"])
def test_a_file_without_a_scheduler_is_a_mistake(tmp_path, text):
    pytest.importorskip("distributed")
    (tmp_path / "scheduler.json").write_text(text)
    with pytest.raises(InputError, match=r"scheduler\.json: no Dask scheduler answers there"):
        connect(str(tmp_path / "scheduler.json"))


def test_a_shot_that_is_done_waits_for_no_worker():
    pytest.importorskip("distributed")
    assert list(fuse_frames(None, None, None, [])) == []


def test_only_the_frames_of_a_chunk_that_failed_are_tried_again(monkeypatch):
    """The others keep their reports, and are not fused again. The server is away for frame 2, at first."""
    pytest.importorskip("distributed")
    tasks = []

    def fail_once(frames, record):
        tasks.append([frame.number for frame in frames])
        away = MssplError("the server is away") if len(tasks) == 1 else {"warnings": []}
        outcomes = {1: {"warnings": ["a"]}, 2: away, 3: InputError("no file"), 4: None}
        for frame in frames:
            record(frame, outcomes[frame.number])

    monkeypatch.setattr(dask_cluster, "ShotRun", lambda settings, plan, frames: frames)
    monkeypatch.setattr(dask_cluster, "run_pipeline", fail_once)
    frames = [FrameFiles(number, Path("lr.exr"), Path("hr.exr"), Path(f"{number}.exr")) for number in (1, 2, 3, 4)]
    outcomes = dask_cluster._fuse_chunk("run", Settings(), ShotPlan(), frames, 1)
    assert tasks == [[1, 2, 3, 4], [2]]
    assert (outcomes[0], outcomes[1], outcomes[3]) == ({"warnings": ["a"]}, {"warnings": []}, None)
    assert isinstance(outcomes[2], InputError)
