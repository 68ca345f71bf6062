# SPDX-License-Identifier: Apache-2.0
"""What may be connected: one render or two, views, ranges with holes."""

import shutil

import numpy as np
import pytest

from oiio_msspl.exr.reader import open_exr
from tests.conftest import EXAMPLES, rgb, write_exr
from tests.nuke_gizmo.test_msspl_nuke import results


def fuse(host, button="fuse_range", **knobs):
    for name, value in knobs.items():
        host.gizmo[name].setValue(value)
    host.press(host.gizmo, button)
    host.wait()


def names(folder, pattern="*_fused*"):
    return sorted(path.name for path in folder.glob(pattern))


@pytest.mark.parametrize("button", ["fuse_frame", "fuse_range"])
def test_one_render_is_fused(host, tmp_path, button):
    host.gizmo.setInput(1, None)
    fuse(host, button)
    assert host.messages == []
    fused = names(tmp_path)
    assert fused == [f"hr_fused.{n}.exr" for n in ((1002,) if button == "fuse_frame" else (1001, 1002, 1003))]
    assert open_exr(tmp_path / fused[0]).metadata["msspl/model"] == "joint-x1"
    assert len(results(host)) == 1


def test_one_render_without_a_number_is_fused(host, tmp_path):
    shutil.copy(EXAMPLES / "hr.exr", tmp_path / "still.exr")
    host.gizmo.setInput(1, None)
    host.reads[1]["file"].setValue(str(tmp_path / "still.exr"))
    fuse(host, "fuse_frame")
    assert (host.messages, names(tmp_path)) == ([], ["still_fused.exr"])
    assert [results(host)[0][k].value() for k in ("first", "last")] == [1, 1]


def test_two_renders_of_one_size_are_fused(host, tmp_path):
    for name, read in zip("ab", host.reads, strict=True):
        for frame in (1001, 1002):
            random = np.random.default_rng([ord(name), frame])
            layers = rgb(random.gamma(1, 1, (64, 96, 3)).astype(np.float32)) | rgb(
                np.full((64, 96, 3), 0.5, np.float32), "albedo."
            )
            write_exr(tmp_path / f"{name}.{frame}.exr", layers)
        read["file"].setValue(str(tmp_path / f"{name}.%04d.exr"))
        read["last"].setValue(1002)
    fuse(host)
    assert host.messages == []
    assert names(tmp_path) == ["b_fused.1001.exr", "b_fused.1002.exr"]
    assert open_exr(tmp_path / "b_fused.1001.exr").metadata["msspl/model"] == "joint-x1"


def test_two_renders_that_do_not_fit_are_told_in_one_sentence(host, tmp_path):
    for name, seed, size in (("a", 1, 64), ("b", 1, 64), ("c", 2, 192)):
        pixels = np.random.default_rng(seed).gamma(4, 0.25, (size, size, 3)).astype(np.float32)
        write_exr(tmp_path / f"{name}.exr", rgb(pixels))
    host.reads[0]["file"].setValue(str(tmp_path / "a.exr"))
    for other, sentence in (("b", "have the same noise; render each with"), ("c", "a ratio of 3 is not supported")):
        host.reads[1]["file"].setValue(str(tmp_path / f"{other}.exr"))
        fuse(host, "fuse_frame")
        (message,) = host.messages
        host.messages.clear()
        assert sentence in message and "\n" not in message
    assert results(host) == []


@pytest.mark.parametrize(
    ("knobs", "model"), [({"quality": "fast"}, "joint-small-x4"), ({"model": "paper"}, "paper-x4")]
)
def test_quality_is_a_choice_and_a_model_wins(host, tmp_path, knobs, model):
    fuse(host, "fuse_frame", **knobs)
    assert open_exr(tmp_path / "hr_fused.1002.exr").metadata["msspl/model"] == model


def test_an_empty_range_is_all_frames_that_both_reads_have(host, tmp_path):
    host.reads[0]["first"].setValue(1002)
    fuse(host)
    assert (host.messages, names(tmp_path)) == ([], ["hr_fused.1002.exr", "hr_fused.1003.exr"])
    host.reads[1]["last"].setValue(1001)
    fuse(host)
    assert host.messages == ["MSSPLFuse1: the Reads have no frame in common; connect renders of the same frames"]


def test_a_range_may_have_holes_at_its_ends(host, tmp_path):
    (tmp_path / "hr.1001.exr").unlink()
    (tmp_path / "lr.1003.exr").unlink()
    fuse(host)
    assert names(tmp_path) == ["hr_fused.1002.exr"]
    (message,) = host.messages
    assert message.startswith("MSSPLFuse1: frame 1001: no HRLS ")
    assert message.endswith("(1 more failed)")
    assert host.gizmo["found"].value().startswith("2 missing, 1 fused")
    assert [results(host)[0][k].value() for k in ("first", "last")] == [1002, 1002]


def test_a_range_that_fails_loads_no_results_of_an_earlier_run(host, tmp_path):
    for frame in (1001, 1002, 1003):
        (tmp_path / f"hr_fused.{frame}.exr").write_bytes(b"of an earlier run")
        (tmp_path / f"hr.{frame}.exr").write_bytes(b"not an EXR")
    fuse(host)
    assert len(host.messages) == 1
    assert results(host) == []


def test_every_view_is_fused_into_files_of_its_own(host, tmp_path):
    host.view_names = ["main", "left", "right"]
    for read, name in zip(host.reads, ("lr", "hr"), strict=True):
        for view in ("left", "right"):
            (tmp_path / view).mkdir(exist_ok=True)
            for frame in (1001, 1002):
                shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / view / f"{name}_{view[0]}.{frame}.exr")
        read["file"].setValue(str(tmp_path / "%V" / f"{name}_%v.%04d.exr"))
        read["last"].setValue(1002)
    fuse(host)
    assert host.messages == []
    assert names(tmp_path, "*/*_fused*") == [f"hr_{v}_fused.{n}.exr" for v in "lr" for n in (1001, 1002)]
    (read,) = results(host)
    assert read["file"].value() == str(tmp_path / "%V" / "hr_%v_fused.%04d.exr")
    assert [read.metadata("input/filename", 1001, view) for view in ("left", "right")] == [
        str(tmp_path / view / f"hr_{view[0]}_fused.1001.exr") for view in ("left", "right")
    ]
    assert host.ProgressTask.made[0].progress == [25, 50, 75, 100]
    fuse(host, "fuse_frame", output=str(tmp_path / "one.####.exr"))
    assert "has no %V or %v, so the views would replace each other" in host.messages[0]
    fuse(host, "fuse_frame", output=str(tmp_path / "own_%V.####.exr"))
    assert names(tmp_path, "own*") == ["own_left.1002.exr", "own_right.1002.exr"]
