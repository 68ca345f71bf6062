# SPDX-License-Identifier: Apache-2.0
"""msspl check, as a process; and what msspl submit says about the first pair."""

import json

from tests.conftest import write_exr
from tests.programs import run
from tests.shots import layers, make_shot


def test_a_pair_that_fits_and_one_that_does_not(files):
    done = run("msspl", "check", files / "lr.exr", files / "hr.exr")
    assert (done.returncode, done.stderr) == (0, "")
    fits, not_judged, *advice = done.stdout.splitlines()
    assert fits.endswith("hr.exr: fits")
    assert not_judged == "  not judged: the albedo, the framing"  # the pair is small
    assert advice and all(line.startswith("  advice: ") for line in advice)
    done = run("msspl", "check", files / "hr.exr", files / "lr.exr")
    assert done.returncode == 2
    assert "can't be fused: the inputs look swapped" in done.stdout
    data = json.loads(run("msspl", "check", files / "lr.exr", files / "hr.exr", "--json").stdout)
    assert data["fits"] and [f"  advice: {entry['text']}" for entry in data["advice"]] == advice
    assert {entry["code"] for entry in data["advice"]} == {"no_lrhs"}


def test_a_shot_is_checked_frame_by_frame(tmp_path):
    make_shot(tmp_path, 3)
    bright = {name: plane * 4 for name, plane in layers(1002).items()}
    write_exr(tmp_path / "hr/beauty.1002.exr", bright)
    (tmp_path / "lr/lr.1003.exr").unlink()
    done = run("msspl", "check", tmp_path / "lr", tmp_path / "hr")
    assert done.returncode == 2
    lines = [line for line in done.stdout.splitlines() if not line.startswith(("  not judged: ", "  advice: "))]
    assert lines[0] == "frame 1001: fits"
    assert lines[1] == "frame 1002: does not fit"
    assert "times as bright" in lines[2]
    assert lines[-2].startswith("frame 1003: can't be fused: ") and "no such file" in lines[-2]
    assert lines[-1].startswith("the shot: frame by frame: ")
    assert run("msspl", "check", tmp_path / "lr", tmp_path / "hr", "--frames", "1001").returncode == 0
    data = json.loads(run("msspl", "check", tmp_path / "lr", tmp_path / "hr", "--json").stdout)
    assert data["warning_codes"] == ["not_averaged"]
    assert [(pair["frame"], pair["fits"]) for pair in data["frames"]] == [(1001, True), (1002, False), (1003, False)]


def test_a_wrong_pair_is_said_before_a_farm_is_asked(tmp_path):
    make_shot(tmp_path, 1)
    write_exr(tmp_path / "hr/beauty.1001.exr", {name: plane * 4 for name, plane in layers(1001).items()})
    paths = (tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / "out", "--bundle", tmp_path / "job")
    done = run("msspl", "submit", *paths)
    assert done.returncode == 0
    assert "warning: frame 1001: the HRLS is" in done.stderr and "times as bright" in done.stderr
