# SPDX-License-Identifier: Apache-2.0
"""The main job on one pair: what is refused before any work, and what does not stop it."""

import os
import re
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest

from oiio_msspl import InputError, InputOptions, MssplError, WriteOptions, fuse_files
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.fusion.tiles.tiling import MAX_MEMORY
from oiio_msspl.jobs import settings as job_settings
from oiio_msspl.jobs import write as writing
from oiio_msspl.jobs.checks import check_wanted_outputs
from oiio_msspl.jobs.inputs import map_pair
from oiio_msspl.jobs.plan import ShotPlan
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from tests.conftest import HEADER_ONLY, downsample, picture, read_bits, rgb, write_exr
from tests.programs import leave_temporary
from tests.shots import HEIGHT, WIDTH, layers, low_layers, write_png


@pytest.fixture
def pair(tmp_path):
    return write_exr(tmp_path / "lr.exr", low_layers(1)), write_exr(tmp_path / "hr.exr", layers(1))


def test_a_pattern_is_no_name_for_one_frame(pair, tmp_path):
    with pytest.raises(InputError, match=r"out\.####\.exr: is a pattern, but LR and HR are single files"):
        fuse_files(*pair, tmp_path / "out.####.exr")


def test_the_result_is_written_over_the_hrls_s_data_window(pair, tmp_path, bilinear_models):
    done = []
    report = fuse_files(
        *pair, tmp_path / "out.exr", model=str(bilinear_models[4]), progress=lambda *tiles: done.append(tiles)
    )
    beauty = open_exr(report.output).parts[0]
    assert beauty.data_window.size == f"{WIDTH}x{HEIGHT}"
    assert (done[0], done[-1]) == ((0, 1000), (1000, 1000))
    assert set(report.seconds) == {"read", "fuse", "network", "write"}


def test_python_takes_what_people_write(pair, tmp_path, bilinear_models):
    """And a report that is printed is one line."""
    report = fuse_files(*pair, tmp_path / "out.exr", model=str(bilinear_models[4]), max_memory="2G", preview_path=True)
    assert report.preview == tmp_path / "out.png" and report.preview.exists()
    assert str(report) == f"<{tmp_path}/out.exr, fused at x4 with bilinear-x4, {len(report.warnings)} warnings>"
    with pytest.raises(InputError, match="'much'"):
        fuse_files(*pair, tmp_path / "more.exr", max_memory="much")


@pytest.mark.parametrize(
    ("output", "more", "message"),
    [
        ("out.png", {}, "the result is an EXR"),
        ("hr.exr", {"overwrite": True}, "is one of the inputs"),
        ("lr.exr", {}, "exists; pass --overwrite"),
        ("out.exr", {"write": WriteOptions(layers=("nothing*",))}, "nothing"),
    ],
)
def test_what_is_wrong_is_said_before_the_work(pair, tmp_path, monkeypatch, output, more, message):
    monkeypatch.setattr(job_settings, "load_model", pytest.fail)
    with pytest.raises(InputError, match=message):
        fuse_files(*pair, tmp_path / output, **more)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hr.exr", "lr.exr"]


def test_a_layout_that_can_not_hold_the_layers_is_refused_by_the_headers(tmp_path, monkeypatch):
    """Of one frame, of a frame of a shot, and of a shot that a farm is to fuse."""
    lr, hr, out = (tmp_path / name for name in ("lr.exr", "hr.exr", "out.exr"))
    write_exr(lr, low_layers(1))
    display = (np.array([0, 0], np.int32), np.array([WIDTH - 1, HEIGHT - 1], np.int32))
    mist = {"mist.Z": np.ones((8, 8), np.float32)}
    write_exr(hr, [("rgba", layers(1), (0, 0)), ("mist", mist, (5, 3))], display=display)
    write = WriteOptions(layout="multilayer")
    of_shot = FrameFiles(1, lr, hr, out)
    monkeypatch.setattr(ExrFile, "read", pytest.fail)
    for check in (
        lambda: fuse_files(lr, hr, out, write=write),
        lambda: ShotRun(Settings(write=write), ShotPlan(), [of_shot]).read(of_shot)[0].require(),
        lambda: check_wanted_outputs([of_shot], InputOptions(), write, None, MAX_MEMORY),
    ):
        with pytest.raises(InputError, match=r"part 'mist' of .* one part can hold only one, use --layout spec"):
            check()


def test_a_frame_without_its_preview_is_a_warning(pair, tmp_path, bilinear_models, monkeypatch):
    def full_disk(*arguments, **more):
        raise MssplError("disk full")

    monkeypatch.setattr(writing, "write_preview", full_disk)
    out = tmp_path / "out.exr"
    report = fuse_files(*pair, out, model=str(bilinear_models[4]), preview_path=tmp_path / "out.png")
    assert out.is_file()
    assert report.preview is None
    assert "no preview: disk full" in report.warnings


def test_the_mapping_is_the_hrls_s_and_only_its_beauty_applies_to_the_lrhs(tmp_path):
    """The LRHS need not have the layer that albedo is mapped to, and then has no albedo."""
    clean = picture(HEIGHT, WIDTH)
    lr = write_exr(tmp_path / "lr.exr", rgb(clean[::4, ::4], "key.") | rgb(clean[::4, ::4], "albedo."))
    hr = write_exr(tmp_path / "hr.exr", rgb(clean, "key.") | rgb(clean, "colours."))
    low, high = map_pair(lr, hr, InputOptions({"rgb": "key", "albedo": "colours"}, lr_spp=64, hr_spp=2))
    assert (set(low.features), set(high.features)) == ({"rgb"}, {"rgb", "albedo"})
    assert (low.features["rgb"].text, high.features["albedo"].text) == ("key", "colours")
    assert (low.spp, high.spp) == (64, 2)


@pytest.mark.parametrize(("pixel_type", "lamp", "clipped"), [("half", 65504.0, 3 * 64), ("float", 1e6, 0)])
def test_values_that_half_cannot_hold_are_clipped_and_counted(tmp_path, bilinear_models, pixel_type, lamp, clipped):
    clean = np.full((64, 64, 3), 0.5, np.float32)
    clean[16:24, 40:48] = 1e6
    lr, hr = write_exr(tmp_path / "lr.exr", rgb(downsample(clean, 4))), write_exr(tmp_path / "hr.exr", rgb(clean))
    write = WriteOptions(pixel_type=pixel_type)
    report = fuse_files(lr, hr, tmp_path / "out.exr", write=write, model=str(bilinear_models[4]))
    assert report.clipped == report.as_dict()["clipped"] == clipped
    assert any(f"{clipped} values are too bright for half" in warning for warning in report.warnings) == bool(clipped)
    [(_, channels)] = read_bits(tmp_path / "out.exr")
    assert (channels["R"][16:24, 40:48] == lamp).all()


# ------------------------------------------------------------------------------------------------ inputs stay


def protected(folder):
    """{name: bytes} of all files in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def luxcore_pair(folder):
    """LuxCore writes one file for each AOV; the beauty's reads the others."""
    write_exr(folder / "lr.exr", low_layers(1))
    for name in ("ALBEDO", "AVG_SHADING_NORMAL"):
        write_exr(folder / f"{name}.exr", rgb(picture(HEIGHT, WIDTH)))
    return folder / "lr.exr", write_exr(folder / "RGB.exr", rgb(picture(HEIGHT, WIDTH)))


@pytest.mark.parametrize("target", ["other.exr", "map.toml", "model.onnx", "ALBEDO.exr", "AVG_SHADING_NORMAL.exr"])
@pytest.mark.parametrize("kind", ["output", "preview"])
def test_no_file_that_is_read_is_written_even_with_overwrite(tmp_path, monkeypatch, target, kind):
    """A file of --map, the mapping's file, the model, and the sibling files of a LuxCore beauty, by name or by link."""
    monkeypatch.setattr(job_settings, "load_model", pytest.fail)
    pair = luxcore_pair(tmp_path)
    write_exr(tmp_path / "other.exr", rgb(picture(HEIGHT, WIDTH)))
    for name in ("map.toml", "model.onnx"):
        (tmp_path / name).write_text("text")
    (tmp_path / "out.exr").symlink_to(target)
    (tmp_path / "out.png").symlink_to(target)
    before = protected(tmp_path)
    mapping = {"diffuse": f"file:{tmp_path / 'other.exr'}"}
    inputs = InputOptions(mapping, map_file=tmp_path / "map.toml")
    more = {"inputs": inputs, "model": str(tmp_path / "model.onnx"), "overwrite": True}
    output, preview = ("out.exr", None) if kind == "output" else ("new.exr", tmp_path / "out.png")
    with pytest.raises(InputError, match="is one of the inputs"):
        fuse_files(*pair, tmp_path / output, preview_path=preview, **more)
    assert protected(tmp_path) == before


def test_a_preview_is_a_png(pair, tmp_path):
    with pytest.raises(InputError, match=r"out\.jpg: the preview is a PNG; name it \.png"):
        fuse_files(*pair, tmp_path / "out.exr", preview_path=tmp_path / "out.jpg")
    assert not (tmp_path / "out.exr").exists()


def test_a_preview_that_is_a_link_to_the_result_is_refused(pair, tmp_path, bilinear_models):
    (tmp_path / "out.png").symlink_to("out.exr")
    with pytest.raises(InputError, match="is the same file as"):
        fuse_files(
            *pair,
            tmp_path / "out.exr",
            model=str(bilinear_models[4]),
            preview_path=tmp_path / "out.png",
            overwrite=True,
        )


# ------------------------------------------------------------------------------------------------ what is left behind


def test_a_new_frame_never_keeps_the_preview_of_the_old_one(pair, tmp_path, bilinear_models, monkeypatch):
    """Neither if no preview is asked for, nor if it can't be written, nor if the run dies before it."""
    out, png, model = tmp_path / "out.exr", tmp_path / "out.png", str(bilinear_models[4])

    def full_disk(*arguments, **more):
        raise MssplError("disk full")

    for preview, writes in ((None, writing.write_preview), (png, full_disk)):
        out.write_text("old")
        write_png(png, overwrite=True)
        monkeypatch.setattr(writing, "write_preview", writes)
        fuse_files(*pair, out, model=model, preview_path=preview, overwrite=True)
        assert not png.exists()
    png.write_text("somebody's picture")
    fuse_files(*pair, out, model=model, overwrite=True)
    assert png.read_text() == "somebody's picture"


def test_what_a_killed_run_left_is_removed_by_the_next(pair, tmp_path, bilinear_models):
    out, png = tmp_path / "out.exr", tmp_path / "out.png"
    left = [leave_temporary(out), leave_temporary(png)]
    assert all(path.exists() for path in left)
    fuse_files(*pair, out, model=str(bilinear_models[4]), preview_path=png)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hr.exr", "lr.exr", "out.exr", "out.png"]


# ------------------------------------------------------------------------------------------------ memory


@pytest.mark.parametrize("layout", ["spec", "multilayer"])
def test_a_frame_that_can_not_fit_is_refused_from_its_headers_by_one_sentence(
    tmp_path, bilinear_models, monkeypatch, layout
):
    """At any limit below the one that it names; at that one the frame is fused."""
    clean = picture(512, 512)
    lr = write_exr(tmp_path / "lr.exr", rgb(clean[::4, ::4]))
    channels = rgb(clean) | {f"l.{i:03d}": clean[..., 0] for i in range(300)}
    hr = write_exr(tmp_path / "hr.exr", channels, compression=OpenEXR.NO_COMPRESSION)
    more = {"model": str(bilinear_models[4]), "write": WriteOptions(layout=layout)}

    def refusal(megabytes):
        with monkeypatch.context() as patched, pytest.raises(InputError) as caught:
            patched.setattr(ExrFile, "read", pytest.fail)
            fuse_files(lr, hr, tmp_path / "out.exr", max_memory=megabytes << 20, **more)
        return str(caught.value)

    said = refusal(1)
    needed = re.fullmatch(r"--max-memory: this frame needs more with model bilinear-x4; allow at least (\d\.\d)G", said)
    assert needed, said
    sentences = {
        refusal(megabytes).partition(", or use")[0] for megabytes in (300, 350, int(float(needed[1]) * 1024) - 103)
    }
    assert sentences == {said}
    if layout == "multilayer":
        assert "use --layout spec" in refusal(500)
    else:
        assert float(needed[1]) < 0.6
    fuse_files(lr, hr, tmp_path / "out.exr", max_memory=int(float(needed[1]) * 2**30), **more)


#: Writes zeros over a file and prints by how many MiB that raised the peak of the process's memory.
WRITE = """
import sys
from pathlib import Path
import numpy as np
from tests.mutants import peak_mib
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr import writer
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.exr.write_options import WriteOptions
hr = map_render(open_exr(sys.argv[1]))
window = hr.data_window
rgb = np.zeros((window.height, window.width, 3), np.float32)
options = WriteOptions(sys.argv[3])
held = writer.bytes_held(hr.file, hr.beauty_channels, options)
before = peak_mib()
writer.write_fused(Path(sys.argv[2]), writer.FileContents(hr.file, hr.beauty_channels, options, rgb))
print(held >> 20, peak_mib() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems keep no such mark")
@pytest.mark.parametrize(("layout", "holds"), [("spec", False), ("nuke", False), ("multilayer", True)])
def test_writing_holds_no_more_than_is_planned_for(tmp_path, layout, holds):
    """The single-part layout holds the file."""
    plane = np.zeros((1024, 1024), np.float32)
    mixed = {f"a{i:02d}.Y": plane for i in range(20)} | {f"b{i:02d}.Y": plane.astype(np.float16) for i in range(20)}
    parts = [("rgba", rgb(np.zeros((1024, 1024, 3), np.float16)), (0, 0)), ("extra", mixed, (0, 0))]
    hr = write_exr(tmp_path / "hr.exr", parts, compression=OpenEXR.NO_COMPRESSION)
    command = [sys.executable, "-c", WRITE, str(hr), str(tmp_path / "out.exr"), layout]
    held, grown = map(int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    times = 1 if HEADER_ONLY or layout != "multilayer" else 2  # OpenEXR 3.3 decodes the render for its header, too
    assert grown < times * (held if holds else 0) + 64, (held, grown)
    assert (held > 100) == holds


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit for the size of files")
@pytest.mark.parametrize("layout", ["spec", "nuke", "multilayer"])
def test_a_file_whose_last_bytes_cannot_be_written_is_no_result(pair, tmp_path, bilinear_models, layout):
    """OpenImageIO does not tell. The limit of a process stands for a full disk."""
    whole = fuse_files(*pair, tmp_path / "whole.exr", model=str(bilinear_models[4]), write=WriteOptions(layout=layout))
    limit = whole.output.stat().st_size - 100
    code = (
        "import resource, sys; from oiio_msspl import *; limit = int(sys.argv[5]);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit));"
        "fuse_files(*sys.argv[1:4], model=sys.argv[4], write=WriteOptions(layout=sys.argv[6]))"
    )
    arguments = [*pair, tmp_path / "cut.exr", bilinear_models[4], limit, layout]
    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True)
    assert "MssplError" in done.stderr and "is the disk full?" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hr.exr", "lr.exr", "whole.exr"]


def test_nothing_is_sent_and_nothing_is_left_in_the_home_folder(pair, tmp_path, bilinear_models):
    """ONNX Runtime keeps a number of the device there, and what it is going to send."""
    home = tmp_path / "home"
    home.mkdir()
    code = "import sys; from oiio_msspl import fuse_files; fuse_files(*sys.argv[1:4], model=sys.argv[4])"
    arguments = [*pair, tmp_path / "out.exr", bilinear_models[4]]
    environment = {k: v for k, v in os.environ.items() if k != "ORT_DISABLE_TELEMETRY" and not k.startswith("XDG")}
    subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], check=True, env=environment | {"HOME": str(home)}
    )
    assert (tmp_path / "out.exr").exists() and not list(home.iterdir())


def test_a_view_layer_that_a_file_does_not_name_is_refused(pair, tmp_path):
    with pytest.raises(InputError, match=r"hr\.exr: no view or view layer 'fg'; the file names none"):
        fuse_files(*pair, tmp_path / "out.exr", inputs=InputOptions(view="fg"))
