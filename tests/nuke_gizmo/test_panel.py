# SPDX-License-Identifier: Apache-2.0
"""What the artist sees while the node works and afterwards, what Undo takes back, and jobs for a farm."""

import gc
import json
import os
import sys
import sysconfig

import numpy as np
import pytest

from tests.conftest import noisy, rgb, write_exr
from tests.moving_plane import positions, texture, truck
from tests.nuke_gizmo.test_inputs import fuse
from tests.nuke_gizmo.test_msspl_nuke import results
from tests.shots import contents


def test_the_progress_window_closes_after_a_failure(host, tmp_path):
    for button, file in (("fuse_frame", "lr.1002.exr"), ("fuse_range", "lr.1001.exr")):
        (tmp_path / file).write_bytes(b"not an EXR")
        gc.disable()
        try:
            fuse(host, button)
            assert [task.window() for task in host.ProgressTask.made] == [None] * len(host.ProgressTask.made)
        finally:
            gc.enable()
    assert len(host.messages) == len(host.ProgressTask.made) == 2


def test_the_progress_window_closes_after_an_unexpected_error(host, monkeypatch):
    import msspl_nuke

    def fail(*_):
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr(msspl_nuke, "run", fail)
    gc.disable()
    try:
        fuse(host, "fuse_frame")
        assert [task.window() for task in host.ProgressTask.made] == [None]
    finally:
        gc.enable()
    assert host.messages == ["MSSPLFuse1: unexpected RuntimeError('a mistake of ours')"]
    assert host.gizmo["found"].value() == "not done"


def test_the_node_shows_what_matters(host, tmp_path):
    """No albedo, frame by frame, and warnings, each once."""
    for frame in (1001, 1002, 1003):
        where = positions(truck, frame - 1001)
        clean = texture(where[..., 0], where[..., 1])
        write_exr(tmp_path / f"hr.{frame}.exr", rgb(noisy(clean, 1, frame).astype(np.float32)))
    host.gizmo.setInput(1, None)
    fuse(host, temporal="auto")
    assert host.messages == []
    lines = host.gizmo["found"].value().splitlines()
    assert lines[0] == "3 fused"
    assert lines[1].startswith("fuses frame by frame: no motion vectors")
    assert max(map(len, lines)) <= 90  # a wider line would widen the panel
    assert " ".join(lines).count("no albedo was found, so textures blur") == 1


def test_a_mistake_in_the_options_is_a_sentence(host):
    fuse(host, "fuse_frame", options="--nope")
    (message,) = host.messages
    assert message.startswith(("MSSPLFuse1: No such option: --nope", "MSSPLFuse1: No such option '--nope'."))
    assert not set(message) & set("╭─╮│╰╯\n")


def test_undo_takes_back_all_that_a_button_did(host):
    host.undo_steps.clear()
    fuse(host, "fuse_frame")
    assert host.undo_steps == ["MSSPLFuse1"]
    fuse(host, "rebuild")
    assert host.undo_steps[1:] == ["Rebuild from passes"]


@pytest.fixture
def farm(tmp_path):
    """Return a command that submits a job: it stores its arguments."""
    program = tmp_path / "farm.py"
    program.write_text(
        "import json, pathlib, sys\n"
        f"pathlib.Path({str(tmp_path / 'submitted.json')!r}).write_text(json.dumps(sys.argv[1:]))\n"
        "print('job-0123')\n"
    )
    return f"'{sys.executable}' '{program}' --queue fast"


def test_a_range_is_submitted_as_a_job(host, tmp_path, farm):
    fuse(host, "submit_range", submit=farm, chunk=2, quality="best", layers="none", frames="1001-1002")
    assert host.messages == []
    *options, bundle = json.loads((tmp_path / "submitted.json").read_text())
    assert options == ["--queue", "fast"]
    with open(os.path.join(bundle, "openjd_values.json")) as file:
        values = json.load(file)
    assert (values["Frames"], values["FramesPerTask"]) == ("1001-1002", 2)
    assert (values["HRFolder"], values["HRName"], values["OutName"]) == (
        *(str(tmp_path), "hr.%04d.exr"),
        "hr_fused.%04d.exr",
    )
    with open(os.path.join(bundle, "template.json")) as file:
        arguments = json.load(file)["steps"][0]["script"]["actions"]["onRun"]["args"]
    assert arguments[arguments.index("--model") + 1] == "joint-large"
    assert {"--update", "--no-preview", "nuke"} <= set(arguments)
    assert results(host) == []
    assert host.gizmo["found"].value().splitlines()[::-1][0] == "job-0123"


def test_the_job_of_one_render_gives_the_frames_of_the_range(host, tmp_path, monkeypatch):
    """openjd runs it in place of a farm, in two tasks."""
    pytest.importorskip("openjd.cli")
    scripts = sysconfig.get_path("scripts")
    monkeypatch.setenv("PATH", scripts + os.pathsep + os.environ["PATH"])
    program = tmp_path / "run.py"
    program.write_text(
        "import subprocess, sys\n"
        "values = f'file://{sys.argv[1]}/openjd_values.json'\n"
        "command = [sys.executable, '-m', 'openjd', 'run', sys.argv[1] + '/template.json', '--job-param', values]\n"
        "sys.exit(subprocess.call(command))\n"
    )
    host.gizmo.setInput(1, None)
    given = {"temporal": "auto", "quality": "fast"}
    fuse(host, output=str(tmp_path / "here" / "f.####.exr"), **given)
    submit = {"submit": f"'{sys.executable}' '{program}'", "chunk": 2}
    (tmp_path / "farm").mkdir()
    fuse(host, "submit_range", output=str(tmp_path / "farm" / "f.####.exr"), **given, **submit)
    assert host.messages == []
    assert len(contents(tmp_path / "here")) == 3
    assert contents(tmp_path / "farm") == contents(tmp_path / "here")


def test_a_job_is_only_written_if_nothing_submits_it(host):
    fuse(host, "submit_range", submit="")
    assert host.messages == []
    last = host.gizmo["found"].value().splitlines()[-1]
    assert last.startswith("deadline bundle submit ")
    assert os.path.exists(os.path.join(last.split()[-1], "template.json"))


def test_a_mistake_in_a_job_is_told_and_nothing_is_submitted(host, tmp_path, farm):
    fuse(host, "submit_range", submit=farm, layers="nothing")
    assert len(host.messages) == 1 and "nothing" in host.messages[0]
    assert not (tmp_path / "submitted.json").exists()
