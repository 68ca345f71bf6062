# SPDX-License-Identifier: Apache-2.0
"""The Blender add-on in every Python with bpy that is found. tests/cli/test_render.py has msspl-render without it.

MSSPL_TEST_BPY names those Pythons, separated as in PATH; otherwise ~/venvs/bpy*/bin/python are tried.
"""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from msspl_cli.installed import find_msspl_fuse

from oiio_msspl import __version__
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.fusion.alignment import align
from tests.conftest import EXAMPLES

ADDON = Path(__file__).parents[1] / "blender_addon"
posix = pytest.mark.skipif(os.name != "posix", reason="the stand-in for Blender is a script")


# ---------------------------------------------------------------------------------------------- without Blender


def test_the_add_on_is_apart_from_the_core():
    """GPL files that say so, and that talk to the core as a program alone."""
    for path in [*ADDON.rglob("*.py"), ADDON / "blender_manifest.toml"]:
        text = path.read_text()
        assert text.startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n"), path
        assert "import oiio_msspl" not in text, path
        assert "from oiio_msspl" not in text, path
    assert "GNU GENERAL PUBLIC LICENSE" in (ADDON / "LICENSE").read_text()
    assert tomllib.loads((ADDON / "blender_manifest.toml").read_text())["version"] == __version__


# ---------------------------------------------------------------------------------------------- in Blender


def pythons_with_bpy():
    named = os.environ.get("MSSPL_TEST_BPY")
    if named is not None:
        return [Path(p) for p in named.split(os.pathsep) if p]
    return sorted(Path.home().glob("venvs/bpy*/bin/python"))


BPY = pythons_with_bpy()


@pytest.fixture(scope="module", params=BPY or [None], ids=lambda p: p.parents[1].name if p else "none")
def python(request):
    if request.param is None:
        pytest.skip("no Python with bpy; name some in MSSPL_TEST_BPY")
    return request.param


@pytest.fixture(scope="module")
def results(python, tmp_path_factory):
    """The folder that the add-on's own checks leave."""
    folder, resources = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("resources")
    environment = {
        **os.environ,
        "MSSPL_FUSE": find_msspl_fuse(),
        "BLENDER_USER_RESOURCES": str(resources),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    script = ADDON / "tests" / "in_blender.py"
    done = subprocess.run([python, script, folder], env=environment, capture_output=True, text=True, timeout=600)
    assert done.stdout.endswith("all is well\n"), done.stdout[-2000:] + done.stderr[-2000:]
    return folder


def layer(path, name, components):
    """float32 (height, width, components) of a layer of a single-part EXR."""
    file = open_exr(path)
    channels = {c.name: c for part in file.parts for c in part.channels}
    names = [name + component for component in components]
    return file.read([channels[n] for n in names], file.parts[0].data_window)


def test_the_composited_frame_is_the_file(results):
    for name, components in (("Combined", "RGBA"), ("Mist", "ZZZ"), ("Normal", "XYZ")):
        fused = layer(results / "fused_012.exr", f"ViewLayer.{name}.", components)
        composited = layer(results / f"composited_{name}.exr", "", "RGBA"[: len(components)])
        np.testing.assert_array_equal(composited, fused)
        assert fused.std() > 0.01


def test_both_renders_show_the_same_frame_when_sizes_are_rounded(results):
    """A ramp has the same values at the edges of the frame: to a twentieth of an HRLS pixel, at x8."""
    for name in ("wide", "tall", "squeezed"):
        low, high = (map_render(open_exr(results / f"{name}_{kind}.exr"), features=()) for kind in ("lr", "hr"))
        assert align(low, high).scale == 8
        for axis in (0, 1):
            edges = []
            for render_ in (low, high):
                values = render_.read(render_.data_window)["rgb"][..., 1 - axis].mean(1 - axis)
                centres = (np.arange(len(values)) + 0.5) / len(values)
                edges.append(np.polyval(np.polyfit(centres, values, 1), [0, 1]))
            pixel = abs(edges[1][1] - edges[1][0]) / (high.data_window.width if axis else high.data_window.height)
            assert np.abs(edges[0] - edges[1]).max() < 0.05 * pixel, (name, axis)


def msspl_render(*arguments):
    main = "import sys; from msspl_cli.app import msspl_render as main; sys.argv[0] = 'msspl-render'; main()"
    return subprocess.run([sys.executable, "-c", main, *map(str, arguments)], capture_output=True, text=True)


@posix
def test_msspl_render_from_scene_to_frame(python, results, tmp_path):
    """With a stand-in for Blender's program that reads the command line as Blender does."""
    out = tmp_path / "out {frame}"  # Blender has variables of such names
    blender = tmp_path / "blender"
    blender.write_text(
        f"#!{python}\nimport bpy, runpy, sys\n"
        "assert sys.argv[1] + sys.argv[3] + sys.argv[5] == '--background' + '--python' + '--'\n"
        "bpy.ops.wm.open_mainfile(filepath=sys.argv[2])\n"
        "runpy.run_path(sys.argv[4], run_name='__main__')\n"
    )
    blender.chmod(0o755)
    options = ["-s", "2", "--lr-spp", "8", "--view-layer", "ViewLayer", "--keep", "--compare", "--json"]
    frames = ["--frames", "3-4", "-o", out / "out.##.exr"]
    done = msspl_render(results / "scene.blend", "--blender", blender, *options, *frames)
    assert done.returncode == 0, done.stderr
    reports = json.loads(done.stdout)
    assert [report["frame"] for report in reports] == [3, 4]
    for report in reports:
        assert (report["lrhs"]["size"], report["lrhs"]["spp"]) == ([51, 38], 8)
        assert (report["hrls"]["size"], report["hrls"]["spp"]) == ([101, 75], 1)
        stages = report["lrhs"]["seconds"], report["hrls"]["seconds"], report["fuse_seconds"]
        assert report["seconds"] == pytest.approx(sum(stages))
        assert report["plain_spp"] > 3
        assert report["oidn"]["spp"] >= 1
    names = [f"out.{n}{suffix}.exr" for n in ("03", "04") for suffix in ("", "_hr", "_lr", "_oidn")]
    assert sorted(p.name for p in out.iterdir()) == sorted(names)
    for name, components in (("CryptoObject00", "rgba"), ("Mist", "Z"), ("Combined_key", "RGB"), ("Matte", "RGB")):
        both = [layer(out / f"out.03{s}.exr", f"ViewLayer.{name}.", components) for s in ("", "_hr")]
        np.testing.assert_array_equal(*both)
    means = [layer(out / f"out.03{suffix}.exr", "ViewLayer.Combined.", "RGB").mean() for suffix in ("", "_lr", "_oidn")]
    assert means == pytest.approx([means[2]] * 3, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-s", "2"], "2 view layers are on (ViewLayer, Other.1); name the one to render"),
        (["--view-layer", "Third"], "has no view layer 'Third'; it has ViewLayer, Other.1"),
    ],
)
def test_what_the_scene_does_not_allow_comes_through_as_a_sentence(python, results, tmp_path, options, message):
    done = msspl_render(results / "scene.blend", "--blender", python, *options, "-o", tmp_path / "out.exr")
    assert (done.returncode, list(tmp_path.iterdir())) == (2, [])
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_that_is_no_scene(python, tmp_path):
    done = msspl_render(EXAMPLES / "README.md", "--blender", python, "-o", tmp_path / "out.exr")
    assert done.returncode == 2
    assert "README.md: can't be opened" in done.stderr
