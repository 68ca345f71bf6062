# SPDX-License-Identifier: Apache-2.0
"""The buttons and the menu in the fake Nuke, with the real msspl-fuse."""

import importlib
import shutil
import sys

import pytest

from oiio_msspl.exr.reader import open_exr
from tests.conftest import EXAMPLES
from tests.jobs.test_over_time import make_moving_shot
from tests.nuke_gizmo.conftest import FOLDER
from tests.nuke_gizmo.fake_nuke import Node
from tests.shots import contents


def results(nuke):
    """Return the Reads that the gizmo made."""
    return [n for n in nuke.everything if n.Class() == "Read" and n not in nuke.reads]


def test_a_frame_is_fused_and_comes_back_as_a_read(host, tmp_path):
    host.gizmo["mapping"].setValue("albedo=ViewLayer.Denoising Albedo")
    host.gizmo["layers"].setValue("crypto*, depth")
    host.reads[1]["colorspace"].setValue("scene_linear")
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    assert host.messages == []
    (read,) = results(host)
    assert read["file"].value() == str(tmp_path / "hr_fused.%04d.exr")
    assert [read[k].value() for k in ("first", "last", "frame")] == [1002, 1002, ""]
    assert read["colorspace"].value() == "scene_linear"
    assert (read.xpos(), read.ypos()) == (40, 300)
    out = tmp_path / "hr_fused.1002.exr"
    assert read.metadata("input/filename", 1002) == str(out)
    names = [part.name for part in open_exr(out).parts]
    # The tooltip's example "crypto*, depth": case and view layer need not be typed.
    assert names[1:] == ["ViewLayer_Depth", "ViewLayer_CryptoObject00"]
    assert host.gizmo.name() not in importlib.import_module("msspl_nuke")._running


def test_frame_0_can_be_fused(host, tmp_path):
    for read, name in zip(host.reads, ("lr", "hr"), strict=True):
        shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / f"{name}.0000.exr")
        read["first"].setValue(0)
    host.frame_number = 0
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    assert host.messages == []
    assert [results(host)[0][k].value() for k in ("first", "last", "origfirst", "origlast")] == [0] * 4


def test_a_second_frame_updates_the_same_read(host):
    for frame in (1002, 1001):
        host.frame_number = frame
        host.press(host.gizmo, "fuse_frame")
        host.wait()
    (read,) = results(host)
    assert [read[k].value() for k in ("first", "last")] == [1001, 1002]
    assert read["reload"].presses == 1
    read["file"].setValue("/elsewhere.%04d.exr")  # The artist loads another file; the next job takes the Read back.
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    assert [results(host)[0][k].value() for k in ("first", "last")] == [1001, 1001]


def test_a_range_shows_progress_and_comes_back_as_a_read(host, tmp_path):
    host.gizmo["output"].setValue(str(tmp_path / "out" / "f.%04d.exr"))
    host.press(host.gizmo, "fuse_range")
    host.wait()
    assert host.messages == []
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"f.{n}.exr" for n in (1001, 1002, 1003)]
    (read,) = results(host)
    assert [read[k].value() for k in ("first", "last", "origfirst", "origlast")] == [1001, 1003] * 2
    (task,) = host.ProgressTask.made
    assert task.progress == [33, 66, 100]
    assert any("3 of 3" in message for message in task.messages)


def test_a_frame_fused_with_its_neighbours_has_the_pixels_that_the_range_gives_it(host, tmp_path, bilinear_models):
    shot = make_moving_shot(tmp_path / "shot", count=6)
    for read, name in zip(host.reads, ("lr", "hr"), strict=True):
        read["file"].setValue(str(shot / name / f"{name}.%04d.exr"))
        read["last"].setValue(1006)
    host.gizmo["model"].setValue(str(bilinear_models[4]))

    def fused(button, output):
        (shot / output).mkdir()
        host.gizmo["output"].setValue(str(shot / output / "f.%04d.exr"))
        host.press(host.gizmo, button)
        host.wait()
        assert host.messages == []
        return contents(shot / output)["f.1003.exr"]

    host.frame_number = 1003
    alone = fused("fuse_frame", "alone")
    host.gizmo["temporal"].setValue("auto")
    one = fused("fuse_frame", "one")
    assert len(contents(shot / "one")) == 1
    assert (results(host)[0]["first"].value(), results(host)[0]["last"].value()) == (1003, 1003)
    host.gizmo["frames"].setValue("1002-1004")
    assert one == fused("fuse_range", "range")
    host.gizmo["temporal"].setValue("off")
    assert one != alone == fused("fuse_range", "range alone")


def test_a_reads_frame_expression_is_followed(host, tmp_path):
    """The Reads are shifted in time. The files that Nuke reads are fused, and the result is shifted alike."""
    for read in host.reads:
        read["frame"].setValue("frame+1000")
    host.gizmo["frames"].setValue("2-3")
    host.press(host.gizmo, "fuse_range")
    host.wait()
    assert host.messages == []
    assert sorted(p.name for p in tmp_path.glob("hr_fused*")) == ["hr_fused.1002.exr", "hr_fused.1003.exr"]
    (read,) = results(host)
    assert read["frame"].value() == "frame+1000"
    assert read.metadata("input/filename", 3) == str(tmp_path / "hr_fused.1003.exr")


def test_a_read_is_found_through_dots_only(host):
    nuke = host
    dot = nuke.add(Node("Dot", "Dot1", inputs=1))
    dot.setInput(0, nuke.reads[0])
    nuke.gizmo.setInput(1, dot)
    module = importlib.import_module("msspl_nuke")
    assert module._find_read(nuke.gizmo, 1, "LRHS") is nuke.reads[0]
    grade = nuke.add(Node("Grade", "Grade1", inputs=1))
    grade.setInput(0, nuke.reads[1])
    nuke.gizmo.setInput(0, grade)
    nuke.press(nuke.gizmo, "fuse_frame")
    nuke.gizmo.setInput(0, None)
    nuke.press(nuke.gizmo, "fuse_frame")
    assert nuke.messages == [
        "MSSPLFuse1: HRLS is connected to Grade1 (Grade), but MSSPLFuse reads files; connect the Read itself, or write "
        "the image to an EXR and read that",
        "MSSPLFuse1: nothing is connected to HRLS; connect the Read of the render",
    ]


def test_a_mistake_is_one_sentence_and_nothing_runs(host, tmp_path):
    def pressed(button="fuse_frame", **knobs):
        before = {name: host.gizmo[name].value() for name in knobs}
        for name, value in knobs.items():
            host.gizmo[name].setValue(value)
        host.press(host.gizmo, button)
        for name, value in before.items():
            host.gizmo[name].setValue(value)
        (message,) = host.messages
        host.messages.clear()
        return message.removeprefix("MSSPLFuse1: ")

    assert pressed(program="/nowhere").startswith("the program knob names /nowhere, but there is no such program")
    assert pressed(mapping="albedo").startswith("mapping 'albedo': write one feature=layer per line")
    assert pressed("fuse_range", frames="5-4").startswith("range '5-4': write the first and the last frame")
    assert pressed("fuse_range", frames="1001-1005").startswith(
        "Read1 does not have one numbered file per frame from 1001 to 1005"
    )
    one_file = str(tmp_path / "out.exr")
    assert "a range needs a frame number in the name" in pressed("fuse_range", output=one_file)
    host.reads[0]["frame"].setValue("frame-1")
    assert "for a range, both need the same numbers" in pressed("fuse_range", frames="1002-1003")
    host.root()["proxy"].setValue(True)
    assert pressed().startswith("proxy mode is on; turn it off")
    host.root()["proxy"].setValue(False)
    for path in tmp_path.glob("lr.*"):
        path.unlink()
    assert pressed() == "Read1 has no file at frame 1002; go to a frame that is rendered"
    assert results(host) == host.ProgressTask.made == []


def test_a_bad_frame_does_not_stop_the_range(host, tmp_path):
    (tmp_path / "lr.1002.exr").write_bytes(b"not an EXR")
    host.press(host.gizmo, "fuse_range")
    host.wait()
    (message,) = host.messages
    assert message.startswith("MSSPLFuse1: frame 1002: ")
    assert sorted(p.name for p in tmp_path.glob("hr_fused*")) == ["hr_fused.1001.exr", "hr_fused.1003.exr"]
    assert len(results(host)) == 1


def test_cancelling_keeps_finished_frames_and_leaves_no_half_written_file(host, tmp_path):
    for read, name in zip(host.reads, ("lr", "hr"), strict=True):
        read["last"].setValue(1020)
        for frame in range(1004, 1021):
            shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / f"{name}.{frame}.exr")
    host.ProgressTask.cancel_at = "1 of 20"
    host.press(host.gizmo, "fuse_range")
    host.wait()
    assert host.messages == []
    written = sorted(p.name for p in tmp_path.iterdir() if "fused" in p.name)
    assert 1 <= len(written) < 20
    assert written == [f"hr_fused.{1001 + i}.exr" for i in range(len(written))]
    assert len(results(host)) == 1


def test_a_node_runs_one_job_at_a_time_and_may_be_deleted_meanwhile(host, tmp_path):
    host.press(host.gizmo, "fuse_frame")
    host.press(host.gizmo, "fuse_frame")
    assert host.messages == ["MSSPLFuse1: is still fusing; wait, or cancel it in the progress window"]
    host.delete(host.gizmo)
    host.wait()
    assert host.messages[1:] == [f"MSSPLFuse1 was deleted; its result is {tmp_path}/hr_fused.%04d.exr"]


def test_the_menu_makes_a_node(host):
    exec((FOLDER / "menu.py").read_text(encoding="utf-8"), {})
    entries = host.menu("Nodes").entries["MSSPL"].entries
    assert list(entries) == ["MSSPLFuse"]
    entries["MSSPLFuse"]()
    assert host.everything[-1].name() == "MSSPLFuse2"


def test_the_buttons_of_a_group_that_nuke_makes_of_the_gizmo_work(host):
    group = host.gizmo.makeGroup()
    for index, read in enumerate(reversed(host.reads)):
        group.setInput(index, read)
    host.press(group, "fuse_frame")
    host.wait()
    assert (host.messages, len(results(host))) == ([], 1)


def test_a_button_without_the_module_says_what_to_install(host, monkeypatch):
    monkeypatch.setitem(sys.modules, "msspl_nuke", None)
    for button in ("fuse_frame", "fuse_range", "submit_range", "rebuild"):
        host.press(host.gizmo, button)
    assert len(host.messages) == 4
    for message in host.messages:
        assert message.startswith("This button needs the folder nuke_gizmo of oiio_msspl on the plug-in path of Nuke.")


@pytest.mark.parametrize(("version", "messages"), [((3, 7), 1), ((3, 9), 0)])
def test_init_warns_only_where_python_is_too_old(host, monkeypatch, version, messages):
    monkeypatch.setattr(sys, "version_info", version)
    exec((FOLDER / "init.py").read_text(encoding="utf-8"), {})
    assert len(host.messages) == messages
