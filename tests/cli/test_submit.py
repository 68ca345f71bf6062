# SPDX-License-Identifier: Apache-2.0
"""msspl submit, as a process: which mistakes it reports before any task runs."""

import json

import numpy as np
import pytest

from tests.conftest import write_exr
from tests.programs import fuse, run
from tests.shots import HEIGHT, WIDTH, layers, make_shot


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lr", "hr", "-o", "out", "--layout", "x"], "--layout 'x': use one of"),
        (["lr", "hr", "-o", "out", "--model", "x"], "no model 'x'"),
        (["lr", "hr", "-o", "out", "--model", "text.onnx"], "text.onnx: onnxruntime can't load it"),
        (["lr", "hr", "-o", "out", "--device", "abacus"], "--device 'abacus': use one of cpu"),
        (["lr", "hr", "-o", "hr"], "hr/beauty.1001.exr: is one of the inputs"),
        (["lr", "hr", "-o", "no/out"], "no/out: the folder no does not exist"),
        (["lr", "hr", "-o", "text.onnx/out"], "the folder text.onnx is a file; name another one"),
        (["lr", "hr", "-o", "text.onnx"], "the folder text.onnx is a file; name another one"),
        (["lr", "hr", "-o", "out", "--temporal", "9"], "give auto, off, or a number of frames from 1 to 8"),
        (
            ["lr", "hr", "-o", "out", "--temporal", "2"],
            "--temporal 2: hr/beauty.####.exr has no two frames that follow",
        ),
        (["lr", "hr", "-o", "out", "--layers", "nonsense"], "nonsense"),
        (["lr", "hr", "-o", "out", "--passes", "nonsense"], "nonsense"),
        (["lr", "hr", "-o", "out", "--error-layer", "--model", "paper"], "does not predict its error"),
        (["lr", "hr", "-o", "out", "--data-passes"], "use --quality best"),
        (["lr", "hr", "-o", "out", "--max-memory", "9"], "--max-memory: this frame needs more"),
        (["lr", "hr", "-o", "out", "--layers", "{{a}}"], "for the start of a parameter"),
        (["lr", "hr", "-o", "out", "--frames", "5-7"], "no frame is in both"),
        (["lr/lr.1001.exr", "hr/beauty.1001.exr", "-o", "out.exr"], "a job is for a shot"),
        (["lr", "no", "-o", "out"], "no: no such file or folder"),
        (["lr/lr.1001.exr", "hr", "-o", "out"], "lr/lr.1001.exr: is a single file"),
        (["hr", "lr", "-o", "out"], "swapped"),
        (["lr", "hr", "-o", "out", "--map", "albedo=nope"], "albedo is mapped to nope, which is not there"),
        (["lr", "hr", "-o", "out", "--model", "joint-x8"], "model joint-x8 is for x8, but this pair is x"),
        (["lr", "hr", "-o", "out", "--chunk", "99999999999"], "--chunk"),
        (["lr", "hr", "-o", "out", "--json"], "No such option"),
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
    ("given", "model"),
    [
        ([], "joint"),
        (["--model", "auto"], "joint"),
        (["--quality", "best"], "joint-large"),
        (["--model", "paper-x4"], "paper-x4"),
    ],
)
def test_a_shipped_model_goes_by_its_name_and_is_the_same_for_all_tasks(tmp_path, given, model):
    make_shot(tmp_path, 1)
    paths = (tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / "out", "--bundle", tmp_path / "job")
    assert run("msspl", "submit", *paths, *given).returncode == 0
    action = json.loads((tmp_path / "job/template.json").read_text())["steps"][0]["script"]["actions"]["onRun"]
    assert action["args"][-2:] == ["--model", model]


def test_every_task_gets_the_options_of_neighbouring_frames(tmp_path):
    make_shot(tmp_path, 2)
    for number in (1001, 1002):
        motion = {f"v.{axis}": np.zeros((HEIGHT, WIDTH), np.float32) for axis in "XY"}
        write_exr(tmp_path / f"hr/beauty.{number}.exr", layers(number) | motion)
    paths = (tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / "out", "--bundle", tmp_path / "job")
    given = ["--temporal", "3", "--motion-format", "layer=v,to=previous,x=left"]
    assert run("msspl", "submit", *paths, *given).returncode == 0
    action = json.loads((tmp_path / "job/template.json").read_text())["steps"][0]["script"]["actions"]["onRun"]
    pairs = set(zip(action["args"], action["args"][1:], strict=False))
    assert {("--temporal", "3"), ("--motion-format", "layer=v,to=previous,x=left")} <= pairs


@pytest.mark.parametrize("arguments", [["--motion-format", "layer=nosuch"], ["--temporal", "2"]])
def test_submission_refuses_what_a_task_would_refuse_over_time(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(make_shot(tmp_path, 4))
    if "--temporal" in arguments:
        for number in (1002, 1004):
            (tmp_path / f"hr/beauty.{number}.exr").unlink()
    done = run("msspl", "submit", "lr", "hr", "-o", "out", "--bundle", "job", *arguments)
    assert done.returncode == 2 and not (tmp_path / "job").exists()
    task = fuse("lr", "hr", "-o", "out", *arguments)
    assert (done.stderr, done.returncode) == (task.stderr, task.returncode)


def test_an_output_may_follow_its_option_without_a_space(tmp_path, monkeypatch):
    monkeypatch.chdir(make_shot(tmp_path, 1))
    done = run("msspl", "submit", "lr", "hr", f"-qo{tmp_path}/outh", "--bundle", "job")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    values = json.loads((tmp_path / "job/openjd_values.json").read_text())
    assert values["OutFolder"] == f"{tmp_path}/outh"
    assert "Usage: " in run("msspl", "submit", "-h").stdout
