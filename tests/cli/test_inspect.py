# SPDX-License-Identifier: Apache-2.0
"""msspl inspect, as a process."""

import json
import re

import numpy as np
import pytest

from oiio_msspl.aovs.motion import MotionFormat
from tests.conftest import SHARED, needs_shared, picture, rgb, spread, write_exr
from tests.moving_plane import encode, frame, layer, truck_and_dolly, vectors
from tests.programs import run


def test_inspect_tells_a_person_and_a_machine(files):
    done = run("msspl", "inspect", files / "hr.exr")
    assert done.returncode == 0
    assert "display window 128x96+0+0" in done.stdout
    data = json.loads(run("msspl", "inspect", files / "hr.exr", "--json").stdout)
    assert data["usable"]
    assert data["parts"][0]["channels"]["mask.X"] == "half"


@pytest.mark.parametrize(("sigma", "noise"), [(0, "independent"), (0.5, "spread")])
def test_inspect_tells_of_a_pair_whether_its_noise_is_spread(tmp_path, sigma, noise):
    rng = np.random.default_rng(0)
    for name, side, spp in (("lr", 64, 16), ("hr", 256, 1)):
        image = rng.gamma(spp, 0.5 / spp, (side, side, 3)).astype(np.float32)
        write_exr(tmp_path / f"{name}.exr", rgb(spread(image, sigma) if sigma else image))
    done = run("msspl", "inspect", tmp_path / "hr.exr", tmp_path / "lr.exr")
    assert f"  noise, compared with lr.exr: {'the pixel filter' if sigma else 'independent'}" in done.stdout
    high, low = json.loads(run("msspl", "inspect", tmp_path / "hr.exr", tmp_path / "lr.exr", "--json").stdout)
    assert (high["noise"], low["noise"]) == (noise, None)


def test_inspect_lists_only_what_the_model_reads(files):
    """joint reads colour, albedo and normal; paper reads diffuse, specular and variance, too."""
    channels = rgb(picture(8, 8)) | rgb(picture(8, 8), "diffuse.") | {"variance.Y": -picture(8, 8)[..., 0]}
    write_exr(files / "more.exr", channels)
    said = {model: run("msspl", "inspect", files / "more.exr", "--model", model).stdout for model in ("joint", "paper")}
    table = said["joint"].partition("  what joint would read:\n")[2]
    assert [line.split()[0] for line in table.splitlines()[:4]] == ["rgb", "albedo", "normal", "alpha"]
    assert "variance" not in said["joint"].partition("  layers:\n")[0]
    assert "diffuse   found: diffuse\n" in said["paper"]
    assert "specular  none (optional)\n" in said["paper"]
    assert "variance: 64 values are negative; fusing sets them to 0\n" in said["paper"]
    for text in said.values():
        assert "none: expect blur, render an albedo (or name it with --map albedo=LAYER)\n" in text
    mapped = run("msspl", "inspect", files / "more.exr", "--model", "joint", "--map", "specular=diffuse").stdout
    assert "specular  not read: diffuse\n" in mapped


def test_inspect_lists_all_layers_and_says_that_a_file_is_a_result(files):
    made = run("msspl_fuse", files / "lr.exr", files / "hr.exr", "-o", files / "made.exr", "--quality", "fast")
    assert made.returncode == 0, made.stderr
    said = run("msspl", "inspect", files / "made.exr").stdout
    assert f"a result, fused with joint-small-x4 from {files}/lr.exr and {files}/hr.exr\n" in said
    assert re.search(r"\n    mask +X +half ", said)
    data = json.loads(run("msspl", "inspect", files / "hr.exr", "--json").stdout)
    assert {row["layer"]: row["channels"] for row in data["layers"]}["mask"] == "X"
    assert not any("result" in fact for fact in data["facts"])


def test_inspect_names_layers_that_may_hold_vectors(files):
    still = np.zeros((8, 8), np.float32)
    write_exr(files / "moving.exr", rgb(picture(8, 8)) | {"motion.X": still, "motion.Y": still})
    assert "motion: motion.XY may hold vectors" in run("msspl", "inspect", files / "moving.exr").stdout


def test_inspect_counts_negatives_apart(files):
    values = picture(8, 8)
    values[0, :3, 0], values[1, 0, 1], values[1, 1, 1] = -0.01, np.nan, -np.inf
    write_exr(files / "odd.exr", rgb(values) | rgb(-np.ones((8, 8, 3), np.float32), "N."))
    done = run("msspl", "inspect", files / "odd.exr")
    assert "rgb: 2 values are NaN or infinite; fusing repairs them\n" in done.stdout
    assert "rgb: 3 values are negative (colours out of gamut); fusing sets them to 0\n" in done.stdout
    assert "normal: " not in done.stdout


def test_inspect_notes_a_black_frame(files):
    """Frames of a shot may be black, and are fused."""
    write_exr(files / "black.exr", rgb(np.zeros((8, 8, 3), np.float32)) | rgb(picture(8, 8), "albedo."))
    done = run("msspl", "inspect", files / "black.exr")
    assert done.returncode == 0, done.stdout
    assert "note: the beauty is black everywhere, though others are not: albedo; check which layer" in done.stdout
    data = json.loads(run("msspl", "inspect", files / "black.exr", "--json").stdout)
    assert data["usable"] and data["notes"][0].startswith("the beauty is black everywhere")


def test_inspect_explains_what_cannot_be_used(files):
    done = run("msspl", "inspect", files / "hr.exr", "--map", "rgb=mask")
    assert done.returncode == 2
    assert "can't be used: rgb: layer 'mask' has channels X, not R, G, B (or X, Y, Z)" in done.stdout
    done = run("msspl", "inspect", files / "hr.####.exr")
    assert done.returncode == 2 and "is a pattern; name one of its files" in done.stdout


@needs_shared("exr")
@pytest.mark.parametrize("path", sorted(SHARED.glob("exr/**/*.exr")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_inspect_handles_every_real_file(path):
    """Usable with a mapped beauty, or explained in a sentence: never a traceback."""
    done = run("msspl", "inspect", path, "--json")
    data = json.loads(done.stdout)
    assert done.stderr == ""
    assert done.returncode == (0 if data["usable"] else 2)
    assert data["usable"] == (not data["problems"])
    unusable = {
        "crypto_only",
        "deep",
        "ALBEDO",
        "AVG_SHADING_NORMAL",
        "DEPTH",
        "DIRECT_DIFFUSE",
        "INDIRECT_GLOSSY",
        "NOISE",
    }
    # Of the V-Ray file only the headers are there.
    unusable |= {"rgba_z_crypto_diffuse_normals"}
    assert data["usable"] == (path.stem not in unusable), data["problems"]


def test_inspect_verifies_motion_vectors_with_the_next_frame(tmp_path):
    for t in (0, 1):
        frame(tmp_path, t, layer("velocity", encode(vectors(truck_and_dolly, t, 1), MotionFormat(y="up"))))
    first, last = (tmp_path / f"plane.{number}.exr" for number in (1001, 1002))
    assert (
        "motion, checked with plane.1002.exr: motion vectors of velocity.XY (to=next,x=right,y=up,unit=pixels)"
        in run("msspl", "inspect", first).stdout
    )
    data = json.loads(run("msspl", "inspect", first, "--json").stdout)
    assert data["motion"]["kind"] == "vectors" and list(data["motion_layers"]) == ["velocity.XY"]
    assert "the next frame beside this one would verify it" in run("msspl", "inspect", last).stdout
    done = run("msspl", "inspect", first, "--motion-format", "layer=velocity,to=next,x=left,y=up,unit=pixels")
    assert done.returncode == 2 and "can't be used: --motion-format" in done.stdout
    for size in (last.stat().st_size // 2, 200):  # it is still rendered: its pixels are cut off, or its header
        last.write_bytes(last.read_bytes()[:size])
        done = run("msspl", "inspect", first)
        assert done.returncode == 0 and "motion: not verified, because the next frame can't be read" in done.stdout
    done = run("msspl", "inspect", first, "--motion-format", "to=nowhere")
    assert done.returncode == 2 and "can't be used: --motion-format" in done.stdout
