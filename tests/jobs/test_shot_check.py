# SPDX-License-Identifier: Apache-2.0
"""Checking a shot, warnings with codes, and what a shot's report says of each frame."""

import json

import pytest

from oiio_msspl import InputOptions, TemporalOptions, check_files, check_shot, fuse_shot
from tests.conftest import write_exr
from tests.shots import layers, make_shot


def without_albedo(seed):
    return {name: plane for name, plane in layers(seed).items() if not name.startswith("albedo")}


@pytest.fixture
def shot(tmp_path):
    return make_shot(tmp_path, 3)


def test_each_frame_and_the_shot_are_checked(shot):
    bright = {name: plane * 4 for name, plane in layers(1002).items()}
    write_exr(shot / "hr/beauty.1002.exr", bright)
    (shot / "lr/lr.1003.exr").unlink()
    told = []
    check = check_shot(shot / "lr", shot / "hr", progress=lambda number, pair: told.append(number))
    assert told == [1001, 1002, 1003] == [*check.frames]
    assert check.frames[1001].fits and not check.fits
    assert check.frames[1002].codes >= {"exposure"} and "no such file" in check.frames[1003].problem
    assert check.codes >= {"exposure", "not_averaged", "add_motion"}
    assert check.warnings[-1] == check.temporal and check.temporal.startswith("frame by frame: ")
    data = json.loads(json.dumps(check.as_dict()))
    assert data["warning_codes"] == ["not_averaged"] and not data["fits"]
    assert [(frame["frame"], frame["warning_codes"]) for frame in data["frames"]] == [
        (1001, []),
        (1002, ["exposure"]),
        (1003, []),
    ]


def test_frames_that_differ_from_the_first_one_are_named(shot):
    write_exr(shot / "hr/beauty.1003.exr", without_albedo(1003))
    check = check_shot(shot / "lr", shot / "hr", temporal=TemporalOptions("off"))
    assert [warning.code for warning in check.warnings] == ["flicker"]
    assert check.warnings[0].startswith("frame 1003: the layers found are rgb here and albedo, rgb in frame 1001")
    assert check.fits and check.temporal == ""
    one = check_shot(None, shot / "hr", "1001-1002", temporal=TemporalOptions("off"))
    assert one.codes == {"add_motion", "no_lrhs", "second_seed"}


def test_a_check_of_one_frame_tells_a_missing_albedo(tmp_path):
    write_exr(tmp_path / "hr.exr", without_albedo(1))
    check = check_files(None, tmp_path / "hr.exr")
    assert check.fits and "add_albedo" in check.codes and "add_motion" not in check.codes


def test_a_hook_can_refuse_a_shot_by_codes(shot):
    """Before, warnings was empty for frames without an albedo, and for frames that were not averaged."""
    for number in (1001, 1002, 1003):
        write_exr(shot / f"hr/beauty.{number}.exr", without_albedo(number))
    report = fuse_shot(shot / "lr", shot / "hr", shot / "out", report_path=shot / "shot.json")
    assert report.codes >= {"no_albedo", "not_averaged"}
    assert [warning.code for warning in report.warnings] == ["not_averaged"]
    assert all("no_albedo" in result.codes for result in report.results.values())
    data = json.loads((shot / "shot.json").read_text())
    assert data["warning_codes"] == ["not_averaged"]
    assert all("no_albedo" in frame["warning_codes"] for frame in data["frames"])
    again = fuse_shot(shot / "lr", shot / "hr", shot / "out", report_path=shot / "shot.json", skip_existing=True)
    assert {result.status for result in again.results.values()} == {"skipped"}
    assert again.codes >= {"no_albedo"}
    off = fuse_shot(shot / "lr", shot / "hr", shot / "off", temporal="off")
    assert "not_averaged" not in off.codes


def test_a_result_names_the_layers_and_passes_of_its_frame(tmp_path):
    make_shot(tmp_path, 2)
    whole = layers(1001)
    shares = {"light_key": 0.75, "light_fill": 0.25}
    lights = {
        f"{light}.{c}": (whole[c] * share).astype(whole[c].dtype) for light, share in shares.items() for c in "RGB"
    }
    write_exr(tmp_path / "hr/beauty.1001.exr", whole | lights)
    inputs = InputOptions(sums=("lights=light_*",))
    report = fuse_shot(
        tmp_path / "lr", tmp_path / "hr", tmp_path / "out", inputs=inputs, report_path=tmp_path / "shot.json"
    )
    first, second = report.results[1001], report.results[1002]
    assert first.layers == ["Z", "albedo", "light_fill", "light_key"] and "lights" in first.passes
    assert first.passes["lights"].startswith("fused: ")
    assert {"feature": "albedo", "status": "found", "source": "albedo", "note": ""} in first.aovs
    assert (second.status, second.layers, second.passes) == ("failed", [], {})
    entry = json.loads((tmp_path / "shot.json").read_text())["frames"][0]
    assert (entry["layers"], entry["passes"]) == (first.layers, first.passes)
