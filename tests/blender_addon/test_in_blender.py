# SPDX-License-Identifier: Apache-2.0
"""The add-on and msspl-render with a real Blender, in every Python with bpy that is found.

The variable MSSPL_TEST_BPY names these Pythons, separated as in PATH. Otherwise ~/venvs/bpy*/bin/python are used.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from msspl_cli.commands.nuke_install import find_msspl_fuse

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.fusion.motion import source as motion
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.colour import ACESCG, REC709, conversion
from oiio_msspl.image.sampling import sample_linear
from tests.blender_addon.conftest import posix, render_command
from tests.conftest import EXAMPLES


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
    """Return the folder with the files that the checks inside Blender have written."""
    folder, resources = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("resources")
    environment = {
        **os.environ,
        "MSSPL_FUSE": find_msspl_fuse(),
        "BLENDER_USER_RESOURCES": str(resources),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    script = Path(__file__).with_name("in_blender")
    done = subprocess.run([python, script, folder], env=environment, capture_output=True, text=True, timeout=600)
    assert done.stdout.endswith("all is well\n"), done.stdout[-2000:] + done.stderr[-2000:]
    return folder


def layer(path, name, components):
    """Return a layer of a single-part EXR as float32 (height, width, components)."""
    file = open_exr(path)
    channels = {c.name: c for part in file.parts for c in part.channels}
    names = [name + component for component in components]
    return file.read([channels[n] for n in names], file.parts[0].data_window)


def test_the_composited_frame_equals_the_fused_file(results):
    for name, components in (("Combined", "RGBA"), ("Mist", "ZZZ"), ("Normal", "XYZ")):
        fused = layer(results / "fused_ViewLayer_012.exr", f"ViewLayer.{name}.", components)
        composited = layer(results / f"composited_{name}.exr", "", "RGBA"[: len(components)])
        np.testing.assert_array_equal(composited, fused)
        assert fused.std() > 0.01


def test_each_frame_of_the_composited_animation_equals_its_fused_file(results):
    fused = layer(results / "ViewLayer_13.exr", "ViewLayer.Combined.", "RGBA")
    np.testing.assert_array_equal(layer(results / "composited_shot.exr", "", "RGBA"), fused)
    assert fused.std() > 0.01


@pytest.mark.parametrize(
    ("name", "spp", "scale"), [("ONE", [None, "8"], "1"), ("TWO", ["4", "4"], "1"), ("SIZES", ["16", "1"], "4")]
)
def test_the_button_fuses_one_render_or_two_seeds_or_two_sizes(results, name, spp, scale):
    """The result names its renders, but not the folder that they lay in."""
    made = open_exr(results / f"renders_{name}.exr").metadata
    assert [made.get("msspl/spp_lrhs"), made["msspl/spp_hrls"]] == spp
    assert (made["msspl/scale"], made["msspl/hrls"]) == (scale, "hr.exr")


def test_two_seeds_have_two_noises(python, results, tmp_path):
    options = ["--blender", python, "--view-layer", "ViewLayer", "--renders", "2", "--hr-spp", "2", "--keep"]
    done = msspl_render(results / "scene.blend", *options, "-o", tmp_path / "out.exr")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.exr", "out_a.exr", "out_b.exr"]
    a, b = (layer(tmp_path / f"out_{name}.exr", "ViewLayer.Combined.", "RGB") for name in "ab")
    assert a.shape == b.shape and np.abs(a - b).mean() > 0.1 * np.abs(a - np.median(a)).mean()
    assert a.mean() == pytest.approx(b.mean(), rel=0.05)


def test_frames_that_share_a_loaded_scene_have_the_pixels_of_frames_that_load_it(python, results, tmp_path):
    """All channels of both renders, with a moving camera and a moving object."""
    options = ["--blender", python, "-s", "2", "--hr-spp", "2", "--quality", "fast", "--keep"]
    done = msspl_render(results / "motion.blend", *options, "--frames", "1-3", "-o", tmp_path / "shot.#.exr")
    assert done.returncode == 0, done.stderr
    for number in (2, 3):
        one = ["--frames", f"{number}", "-o", tmp_path / f"alone.{number}.exr"]
        done = msspl_render(results / "motion.blend", *options, *one)
        assert done.returncode == 0, done.stderr
        for suffix in ("lr", "hr"):
            shot, alone = (open_exr(tmp_path / f"{name}.{number}_{suffix}.exr").parts[0] for name in ("shot", "alone"))
            names = [channel.name for channel in alone.channels]
            assert names == [channel.name for channel in shot.channels] and len(names) > 30
            paths = [tmp_path / f"{name}.{number}_{suffix}.exr" for name in ("shot", "alone")]
            np.testing.assert_array_equal(*(layer(path, "", names) for path in paths))


def test_frames_have_the_linear_space_of_the_output_and_the_compositor_converts_it_back(results):
    """ACEScg is linear and kept. sRGB is not, so the frame is in the space in which the scene is rendered."""
    kept, own = (layer(results / f"space_{name}.exr", "ViewLayer.Combined.", "RGB") for name in ("ACEScg", "sRGB"))
    converted = kept @ conversion(ACESCG, REC709).astype(np.float32).T
    assert np.abs(converted - own).mean() < 0.1 * np.abs(kept - own).mean()
    for name, wanted in (("ACEScg", converted), ("sRGB", own)):
        np.testing.assert_allclose(layer(results / f"space_{name}_Combined.exr", "", "RGB"), wanted, atol=2e-3)
        normal = layer(results / f"space_{name}.exr", "ViewLayer.Normal.", "XYZ")
        np.testing.assert_array_equal(layer(results / f"space_{name}_Normal.exr", "", "RGB"), normal)


def test_the_animation_button_renders_what_averaging_needs(results):
    names = [channel.name for part in open_exr(results / "ViewLayer_12.exr").parts for channel in part.channels]
    assert "ViewLayer.Vector.X" in names
    assert "ViewLayer.Vector.X" not in [
        c.name for part in open_exr(results / "fused_ViewLayer_012.exr").parts for c in part.channels
    ]


#: What the checks in Blender rebuild the beauty from. A component is light, or light times a colour.
GROUPS = ("Combined_key", "Combined_rest", "Combined_world")
COMPONENTS = (
    *(
        (f"{kind} {part}", f"{kind} Color")
        for kind in ("Diffuse", "Glossy", "Transmission")
        for part in ("Direct", "Indirect")
    ),
    *(("Emission",), ("Volume Direct",), ("Volume Indirect",)),
)


@pytest.mark.parametrize(("film", "precision"), [("opaque", 2**-11), ("transparent", 2**-22)])
@pytest.mark.parametrize("name", ["light groups", "components"])
def test_the_beauty_that_the_compositor_builds_from_fused_passes_is_the_fused_beauty(results, film, precision, name):
    """Every layer is rounded once: the first file has half floats, the second one float.

    A pixel whose colours are all black can hold no light in a component. At the edges of a transparent film there are
    such pixels.
    """
    path = results / f"{film}.exr"
    environment = [("Environment",)] if film == "opaque" else []
    terms = [(group,) for group in GROUPS] if name == "light groups" else [*COMPONENTS, *environment]
    stored = {x: layer(path, f"ViewLayer.{x}.", "RGB") for term in terms for x in term}
    layers = [np.prod([stored[x] for x in term], axis=0) for term in terms]
    beauty = layer(path, "ViewLayer.Combined.", "RGB")
    holds_light = np.ones(beauty.shape, bool)
    if (film, name) == ("transparent", "components"):
        holds_light = np.any([stored[term[-1]] >= 1e-3 for term in terms], axis=0)
        assert holds_light.mean() > 0.5
    total, rebuilt = sum(layers), layer(results / f"{film}_{name}.exr", "", "RGB")
    rounding = precision * (total + beauty) + 1e-6
    assert (np.abs(rebuilt - total) <= rounding).all()
    assert (np.abs(rebuilt - beauty) <= rounding)[holds_light].all()
    fused = json.loads(open_exr(path).metadata["msspl/passes"])
    assert {entry["name"]: len(entry["layers"]) for entry in fused}[name] == len(terms)
    assert sum(layer.max() > 0.05 for layer in layers) >= 3


def test_light_in_no_group_stays_out_of_the_fused_groups(results):
    """The lamp "key" has left its group. All that it lights is missing in the sum; the other groups are clean."""
    path = results / "remainder.exr"
    names = {channel.name for part in open_exr(path).parts for channel in part.channels}
    assert not {name for name in names if "Transmission" in name}
    key, rest, world = (layer(path, f"ViewLayer.{group}.", "RGB") for group in GROUPS)
    beauty = layer(path, "ViewLayer.Combined.", "RGB")
    assert key.max() == 0
    assert ((key + rest + world) <= beauty * (1 + 2**-20) + 1e-6).all()
    lost = layer(results / "transparent.exr", "ViewLayer.Combined_key.", "RGB")
    assert (beauty - rest - world).mean() == pytest.approx(lost.mean(), rel=0.02)


def test_both_renders_show_the_same_frame_if_the_size_is_rounded(results):
    """At x8, a ramp has the same values at the edges of both renders, within a twentieth of an HRLS pixel."""
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


def test_cycles_motion_vectors_are_as_the_table_says(results, monkeypatch):
    """Both directions of a moving camera and a moving cube fetch the same world positions; the sky is not believed."""
    monkeypatch.setattr(motion, "has_optical_flow", lambda: False)
    frames = [map_render(open_exr(results / f"sharp.{number:04d}.exr")) for number in (2, 3)]
    source = motion.find_motion(*frames, required=True)
    assert source.kind == "vectors" and source.fields == frames[0].motion.fields
    for here, there, step in ((0, 1, 1), (1, 0, -1)):
        vectors, known = source.read(motion.MotionFrame(frames[here]), motion.MotionFrame(frames[there]), step)
        places = [frame.file.read(frame.motion.position, frame.data_window) for frame in frames]
        y, x = np.mgrid[0:128, 0:192].astype(np.float32)
        fetched = sample_linear(places[there], x + vectors[..., 0], y + vectors[..., 1])
        cube = known & (places[here][..., 2] > 0.2)
        floor = known & (np.abs(places[here][..., 2]) < 0.01)
        change = np.abs(fetched - places[here]).max(axis=-1)
        # The floor stays where it is. The cube has moved in the world, along x.
        assert np.median(change[floor]) < 0.005
        assert np.median((fetched - places[here])[cube, 0]) == pytest.approx(step * 0.18, abs=0.06)
        # At the horizon, vectors are means over samples of the floor and of the sky.
        assert known[(places[here] == 0).all(axis=-1)].mean() < 0.05
        assert 0.7 < known.mean() < 0.9
    blurred = [map_render(open_exr(results / f"blurred.{number:04d}.exr")) for number in (2, 3)]
    source = motion.find_motion(*blurred)
    assert source.kind == "none" and "Cycles writes zeros if motion blur is on" in source.text


def msspl_render(*arguments):
    return subprocess.run(render_command(*arguments), capture_output=True, text=True)


@posix
def test_msspl_render_goes_from_a_scene_to_fused_frames(python, results, tmp_path):
    """A script that reads its command line as Blender does runs in place of Blender's program."""
    out = tmp_path / "out {frame}"  # Blender replaces such variables in paths.
    blender = tmp_path / "blender"
    blender.write_text(
        f"#!{python}\nimport bpy, runpy, sys\n"
        "assert sys.argv[1] + sys.argv[3] + sys.argv[5] == '--background' + '--python' + '--'\n"
        "bpy.ops.wm.open_mainfile(filepath=sys.argv[2])\n"
        "runpy.run_path(sys.argv[4], run_name='__main__')\n"
    )
    blender.chmod(0o755)
    options = ["-s", "2", "--hr-spp", "4", "--view-layer", "ViewLayer", "--keep", "--json"]
    options += ["--model", "joint-small", "--error-layer", "--components"]
    frames = ["--frames", "3-4", "-o", out / "out.##.exr"]
    done = msspl_render(results / "scene.blend", "--blender", blender, *options, *frames)
    assert done.returncode == 0, done.stderr
    reports = json.loads(done.stdout)
    assert [report["frame"] for report in reports] == [3, 4]
    for report in reports:
        # The LRHS gets a third of the HRLS's samples: 4/3 x 2 x 2 per pixel, rounded up. Nothing warns of it.
        renders = [(render["name"], render["size"], render["spp"]) for render in report["renders"]]
        assert renders == [("LRHS", [51, 38], 6), ("HRLS", [101, 75], 4)]
        assert not [warning for warning in report["warnings"] if "spp" in warning]
        stages = [*(render["seconds"] for render in report["renders"]), report["fuse_seconds"]]
        assert report["seconds"] == pytest.approx(sum(stages))
        assert report["plain_spp"] > 3
    written = open_exr(out / "out.03.exr")
    assert written.metadata["msspl/model"] == "joint-small-x2"
    assert "error.Y" in [channel.name for channel in written.parts[0].channels]
    names = [f"out.{n}{suffix}.exr" for n in ("03", "04") for suffix in ("", "_hr", "_lr")]
    assert sorted(p.name for p in out.iterdir()) == sorted(names)
    for name, components in (("CryptoObject00", "rgba"), ("Mist", "Z"), ("Combined_key", "RGB"), ("Matte", "RGB")):
        both = [layer(out / f"out.03{s}.exr", f"ViewLayer.{name}.", components) for s in ("", "_hr")]
        np.testing.assert_array_equal(*both)
    (fused,) = json.loads(written.metadata["msspl/passes"])
    assert [f"ViewLayer.{term[0]}" for term in COMPONENTS] == [term[0] for term in fused["layers"]]
    for suffix in ("", "_lr", "_hr"):  # both renders have all passes, and the fused file too
        assert layer(out / f"out.03{suffix}.exr", "ViewLayer.Volume Direct.", "RGB").shape[2] == 3
    means = [layer(out / f"out.03{suffix}.exr", "ViewLayer.Combined.", "RGB").mean() for suffix in ("", "_lr", "_hr")]
    assert means == pytest.approx([means[2]] * 3, rel=0.05)


def test_msspl_render_averages_frames_along_the_vectors_that_cycles_writes(python, results, tmp_path):
    """Vectors are those of a render without persistent data, and frames gain from them. A resumed run gives the same
    frames."""
    options = [
        "--blender",
        python,
        "-s",
        "2",
        "--hr-spp",
        "4",
        "--model",
        "joint-small",
        "--layout",
        "spec",
        "--frames",
    ]
    for name, more in (("alone", []), ("whole", ["--temporal", "1", "--keep"])):
        out = tmp_path / name / "out.####.exr"
        done = msspl_render(results / "motion.blend", *options, "1-4", *more, "-o", out)
        assert done.returncode == 0, done.stderr
    assert "Fused with 1 frame before and after each" in done.stdout
    assert len(list((tmp_path / "whole").iterdir())) == 12
    for number in (2, 3):
        kept, sharp = (
            layer(path, "ViewLayer.Vector.", "XYZW")
            for path in (tmp_path / f"whole/out.{number:04d}_hr.exr", results / f"sharp.{number:04d}.exr")
        )
        assert np.median(np.abs(kept - sharp)) < 0.05
        assert np.median(np.abs(sharp)) > 0.5

    whole = {number: beauty(tmp_path / f"whole/out.{number:04d}.exr") for number in (2, 3)}
    errors = np.zeros(2)
    for number, averaged in whole.items():
        alone, truth = beauty(tmp_path / f"alone/out.{number:04d}.exr"), beauty(results / f"clean.{number:04d}.exr")
        errors += [np.square(np.log((pixels + 0.01) / (truth + 0.01))).mean() for pixels in (alone, averaged)]
    assert errors[1] < 0.98 * errors[0]
    for path in (tmp_path / "whole").glob("out.0002*.exr"):
        path.unlink()
    more = ["--temporal", "1", "--skip-existing", "-o", tmp_path / "whole/out.####.exr"]
    done = msspl_render(results / "motion.blend", *options, "1-4", *more)
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(beauty(tmp_path / "whole/out.0002.exr"), whole[2], rtol=1e-3)

    frames = ["1-2", "-o", tmp_path / "blurred.####.exr"]
    done = msspl_render(results / "motion_blur.blend", *options, *frames, "--temporal", "2")
    assert done.returncode == 2
    assert done.stderr.startswith("error: --temporal 2: motion blur is on, and Cycles then writes no motion vectors")
    done = msspl_render(results / "motion_blur.blend", *options, *frames, "--temporal", "auto")
    assert done.returncode == 0, done.stderr
    assert "Fused frame by frame: motion blur is on" in done.stdout


def beauty(path):
    return map_render(open_exr(path), features=()).load().layers["rgb"]


def test_neighbouring_frames_have_different_noise_if_they_are_averaged(python, results, tmp_path):
    """The scene stands still."""
    options = ["--blender", python, "-s", "2", "--hr-spp", "4", "--model", "joint-small", "--view-layer", "ViewLayer"]
    for temporal in ("off", "1"):
        more = ["--temporal", temporal, "--keep", "--frames", "1-2", "-o", tmp_path / f"{temporal}.#.exr"]
        done = msspl_render(results / "scene.blend", *options, *more)
        assert done.returncode == 0, done.stderr
        one, other = (layer(tmp_path / f"{temporal}.{n}_hr.exr", "ViewLayer.Combined.", "RGB") for n in (1, 2))
        assert (one == other).all() == (temporal == "off")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-s", "2"], "2 view layers are on (ViewLayer, Other.1); choose one with --view-layer NAME"),
        (["--view-layer", "Third"], "has no view layer 'Third'; it has ViewLayer, Other.1"),
        (["--view-layer", "ViewLayer", "--passes", "light*"], "no such set of layers; it has 'components'"),
    ],
)
def test_a_scene_that_cannot_be_fused_is_refused_in_one_sentence(python, results, tmp_path, options, message):
    done = msspl_render(results / "scene.blend", "--blender", python, *options, "-o", tmp_path / "out.exr")
    assert (done.returncode, list(tmp_path.iterdir())) == (2, [])
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_that_is_no_scene_is_named(python, tmp_path):
    done = msspl_render(EXAMPLES / "README.md", "--blender", python, "-o", tmp_path / "out.exr")
    assert done.returncode == 2
    assert "README.md: can't be opened" in done.stderr
