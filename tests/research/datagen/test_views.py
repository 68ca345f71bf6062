# SPDX-License-Identifier: Apache-2.0
"""What the renderers of training views share: files that training reads back, cameras worth rendering."""

import numpy as np
import pytest

from oiio_msspl.image.colour import luminance
from research.datagen import command_line, quality, views


def _write(folder, seed=20, brightness=1.0):
    rng = np.random.default_rng(seed)
    n = views.SIZE
    hr = rng.random((views.HR_PASSES, n, n, 15), np.float32) * brightness
    lr = rng.random((len(views.LR_SPP), n, n, 3), np.float32) * brightness
    ref = rng.random((n, n, 3), np.float32) * brightness
    meta = {"seed": f"cycles-{seed}", "split": views.split_of(seed)}
    views.save(folder / f"cycles-{seed:06d}-0.npz", views.pack(hr, {1: lr}, ref, rng, meta))
    return hr, lr, ref


@pytest.mark.parametrize("brightness", [1e-7, 1e7])
def test_training_reads_what_a_renderer_saves(tmp_path, brightness):
    hr, lr, ref = _write(tmp_path, brightness=brightness)
    assert [p.name for p in tmp_path.iterdir()] == ["cycles-000020-0.npz"]
    (view,) = views.Folder(tmp_path).split("validation")
    assert view.scene == "cycles-20" and tuple(view.lr_spp) == views.LR_SPP
    # Exposed so that half floats hold it, all radiance alike; albedo and normal are no radiance.
    scale = luminance(view.ref.astype(np.float32)).mean() / luminance(ref).mean()
    assert 0.02 < luminance(view.ref.astype(np.float32)).mean() < 100
    for stored, values in (
        (view.ref, ref * scale),
        (view.lr[1], lr * scale),
        (view.hr[..., :3], hr[..., :3] * scale),
        (view.hr[..., 3:9], hr[..., 3:9]),
        (view.hr[..., 9:], hr[..., 9:] * scale),
    ):
        np.testing.assert_allclose(stored, np.minimum(values, 65504), rtol=2e-3, atol=1e-6)


def test_whole_scenes_are_held_out():
    splits = [views.split_of(seed) for seed in range(40)]
    assert splits.count("validation") == 2 and splits.count("test") == 2 and splits[20] == "validation"


def test_psnr_of_mean_is_the_error_of_the_mean():
    rng = np.random.default_rng(0)
    clean = np.full((64, 64, 3), 0.18)
    a, b = (clean + rng.normal(0, 0.02, clean.shape) for _ in range(2))
    slope = 0.46 / 0.18 / 2.4 * 1.1  # of the sRGB curve at mid-grey, about
    expected = -20 * np.log10(0.02 / np.sqrt(2) * slope)
    assert quality.psnr_of_mean(a, b) == pytest.approx(expected, abs=0.5)


def test_bare_and_black_views_show_nothing():
    rng = np.random.default_rng(0)
    busy = rng.random((32, 32, 15)).astype(np.float32)
    bare, black, sky = busy.copy(), busy.copy(), busy.copy()
    bare[..., 3:9] = 0.5
    black[: 32 // 2, :, :3] = 0
    sky[:24, :, 6:9] = 0
    assert quality.shows_something(busy)
    assert not any(quality.shows_something(probe) for probe in (bare, black, sky))


def test_seeds_are_ranges():
    parser = command_line.parser("x", "", ref_spp=1)
    for text, seeds in (("7", [7]), ("3:5", [3, 4]), ("1:50:20", [1, 21, 41])):
        assert list(parser.parse_args(["--out", "o", "--seeds", text]).seeds) == seeds
