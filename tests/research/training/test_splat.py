# SPDX-License-Identifier: Apache-2.0
"""Samples with a place, filtered as renderers filter them."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training is an extra")

from research.datagen import samples, views  # noqa: E402
from research.training import data, splat  # noqa: E402
from research.training.splat import BOX, KINDS, PixelFilter, apply, filter_reference  # noqa: E402

#: Those with negative lobes have one radius in use, others any.
LOBED = [PixelFilter(kind, 2.0) for kind in ("mitchell", "catmull-rom", "lanczos")]
SPREAD = LOBED + [
    PixelFilter(kind, radius) for kind in sorted(KINDS.keys() - {f.kind for f in LOBED}) for radius in (0.75, 1.5, 2.0)
]
INDEPENDENT = [PixelFilter("blackman-harris", 0.75, splatted=False), PixelFilter("gaussian", 2.0, splatted=False)]


def _noise(k: int = 4, size: int = 48, channels: int = 2, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Places, in the steps of stored ones, and values of samples that know nothing of each other."""
    rng = np.random.default_rng(seed)
    place = (rng.integers(256, size=(k, size, size, 2)) + 0.5) / 256
    values = rng.exponential(1.0, (k, channels, size, size))
    return torch.from_numpy(place).float(), torch.from_numpy(values).float()


def _correlation(image: torch.Tensor, distance: int) -> float:
    image = image - image.mean()
    return float((image[:, distance:] * image[:, :-distance]).mean() / image.square().mean())


def test_a_box_of_one_pixel_is_the_plain_mean() -> None:
    place, values = _noise()
    torch.testing.assert_close(apply(BOX, place, values), values.mean(dim=0))


@pytest.mark.parametrize("scale", [1, 2, 4])
@pytest.mark.parametrize("pixel_filter", [PixelFilter("mitchell", 2.0), PixelFilter("tent", 0.75)])
def test_splatting_is_the_weighted_mean_of_all_samples_around(pixel_filter: PixelFilter, scale: int) -> None:
    """Against a sum over all samples for single pixels, at the edge and inside, in pixels of s x s."""
    place, values = _noise(k=2, size=24)
    image = apply(pixel_filter, place, values, scale=scale)
    rows, columns = np.mgrid[0:24, 0:24]
    x = (columns + place[..., 0].numpy()) / scale
    y = (rows + place[..., 1].numpy()) / scale

    def weight(distance: np.ndarray) -> np.ndarray:
        t = torch.from_numpy(np.abs(distance) / pixel_filter.radius)
        return np.where(t <= 1, KINDS[pixel_filter.kind](t), 0)

    for row, column in ((0, 0), (2, 3), (24 // scale - 1, 1)):
        w = weight(x - column - 0.5) * weight(y - row - 0.5)
        expected = (w[:, None] * values.numpy()).sum((0, 2, 3)) / w.sum()
        np.testing.assert_allclose(image[:, row, column], expected, rtol=1e-4)


@pytest.mark.parametrize("scale", [1, 2, 8])
@pytest.mark.parametrize("pixel_filter", SPREAD + INDEPENDENT)
def test_constant_images_stay_constant(pixel_filter: PixelFilter, scale: int) -> None:
    place, values = _noise()
    flat = torch.full_like(values, 0.7)
    filtered = apply(pixel_filter, place, flat, scale, 2, torch.Generator().manual_seed(0))
    torch.testing.assert_close(filtered, flat[0, :, ::scale, ::scale], rtol=1e-4, atol=0)
    cells = torch.full((3, 96, 96), 0.7)
    torch.testing.assert_close(filter_reference(pixel_filter, cells, 2), cells[:, ::2, ::2])


@pytest.mark.parametrize("pixel_filter", SPREAD + INDEPENDENT)
def test_no_light_is_lost_or_made(pixel_filter: PixelFilter) -> None:
    """The mean of an image is that of its samples, but for the edge and the chance of the weights."""
    place, values = _noise(k=8, size=128)
    image = apply(pixel_filter, place, values, count=8, generator=torch.Generator().manual_seed(0))
    assert image.mean().item() == pytest.approx(values.mean().item(), rel=0.02)


def test_spread_noise_is_correlated_and_distributed_noise_is_not() -> None:
    """Mitsuba's Gaussian has correlations of 0.44 to 0.56 between neighbours; other renderers' samples are their own.

    White noise through the filter has the filter's autocorrelation: exp(-1 / (4 sigma^2)) with a sigma of 0.5 is 0.37
    for dense samples. Few samples a pixel have random weights, so theirs is near, but not the same.
    """
    place, values = _noise(k=8, size=128)
    gaussian = PixelFilter("gaussian", 2.0)
    near, far = (_correlation(apply(gaussian, place, values)[0], distance) for distance in (1, 3))
    assert near == pytest.approx(np.exp(-1), abs=0.05)
    assert abs(far) < 0.05
    for independent in INDEPENDENT:
        image = apply(independent, place, values, count=2, generator=torch.Generator().manual_seed(0))[0]
        assert abs(_correlation(image, 1)) < 0.03


@pytest.mark.parametrize("pixel_filter", [BOX, *INDEPENDENT, *SPREAD])
def test_a_reference_has_the_filter_of_the_samples(pixel_filter: PixelFilter) -> None:
    """A dense render of a smooth picture, filtered, is its reference filtered."""
    rng = np.random.default_rng(2)
    k, size, cells = 64, 24, 4
    place = (rng.integers(256, size=(k, size, size, 2)) + 0.5) / 256
    rows, columns = np.mgrid[0:size, 0:size]

    def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 1 + 0.5 * np.sin(1.1 * x + 0.3) * np.cos(0.8 * y)

    values = picture(columns + place[..., 0], rows + place[..., 1])
    image = apply(pixel_filter, torch.from_numpy(place), torch.from_numpy(values)[:, None], generator=torch.Generator())
    y, x = (np.mgrid[0 : size * cells, 0 : size * cells] + 0.5) / cells
    expected = filter_reference(pixel_filter, torch.from_numpy(picture(x, y))[None], cells)
    error = (image - expected).square().mean().sqrt().item()
    assert error < 0.03
    if pixel_filter.kind == "gaussian" and pixel_filter.radius == 2.0:  # another filter would be seen
        assert (image - filter_reference(BOX, torch.from_numpy(picture(x, y))[None], cells)).std() > 2 * error


@pytest.mark.parametrize(
    ("pixel_filter", "plugin"),
    [
        (BOX, {"type": "box"}),
        (PixelFilter("tent", 1.0), {"type": "tent"}),
        (PixelFilter("gaussian", 2.0), {"type": "gaussian"}),
        (PixelFilter("mitchell", 2.0), {"type": "mitchell"}),
        (PixelFilter("catmull-rom", 2.0), {"type": "catmullrom"}),
        (PixelFilter("lanczos", 2.0), {"type": "lanczos", "lobes": 2}),
    ],
)
def test_splatting_is_what_mitsubas_film_does(pixel_filter: PixelFilter, plugin: dict) -> None:
    """The same samples, put into Mitsuba's image block with the same filter."""
    pytest.importorskip("mitsuba", reason="rendering views is optional")
    from research.datagen.mitsuba import start

    mi = start()
    place, values = _noise(k=4, size=32, channels=3)
    rows, columns = np.mgrid[0:32, 0:32]
    x, y = (mi.Float((grid + place[..., i].numpy()).ravel()) for i, grid in enumerate((columns, rows)))
    block = mi.ImageBlock([32, 32], [0, 0], 4, rfilter=mi.load_dict(plugin), normalize=False, border=True)
    colours = [mi.Float(values[:, c].numpy().ravel()) for c in range(3)]
    block.put(mi.Point2f(x, y), [*colours, mi.Float(1)])
    border = block.border_size()
    film = np.array(block.tensor())[border : border + 32, border : border + 32]
    image = apply(pixel_filter, place, values).movedim(0, -1).numpy()
    np.testing.assert_allclose(image, film[..., :3] / film[..., 3:], rtol=5e-3, atol=2e-3)


def test_radiance_is_stored_within_half_a_step() -> None:
    rng = np.random.default_rng(0)
    radiance = 10 ** rng.uniform(-5, 4.8, (1000, 3)).astype(np.float32)
    radiance[0], radiance[1], radiance[2] = 0, (1e9, 1, 0), (511.9, 0.1, 255.6)
    read = data.decode_radiance(torch.from_numpy(samples.encode(radiance).view(np.int32))[None, None])
    stored = read[0, :, 0].T.numpy()
    clipped = radiance.clip(0, 65408)
    assert (np.abs(stored - clipped) <= clipped.max(-1, keepdims=True) / 511 + samples.STEP).all()


def test_training_draws_filters_from_sample_views(sample_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are no views with passes, and every filter gives the pairs that training reads."""
    found = views.Folder(sample_folder)
    assert not found.split("train")
    (view,) = found.sample_views("train")
    assert json.loads(str(view.arrays["meta"]))["exposure"]["log_mean"] > 0
    tensors = data.view_tensors(found, "train", torch.device("cpu"))
    plain = data.Sampling(drop_each=0, drop_lobes=0, drop_all=0, exposure_stops=0, gain_stops=0, grey=0)
    for pixel_filter, scale in zip((BOX, *INDEPENDENT, *LOBED), itertools.cycle((2, 8))):
        monkeypatch.setattr(data, "draw_filter", lambda rng, f=pixel_filter, **_: f)
        batch = data.draw(tensors, scale, 64, 2, np.random.default_rng(0), plain)
        assert batch["hrls"].shape == (2, 16, 64, 64)
        torch.testing.assert_close(batch["hrls"][:, :3], batch["target"], atol=0.01, rtol=0)
        torch.testing.assert_close(batch["lrhs"], batch["target"][..., ::scale, ::scale], atol=0.01, rtol=0)
        assert (batch["hrls"][:, 3:6] - 0.6).abs().max() < 0.02  # the albedo
    contract = data.spp_range([view], 4)
    assert contract == {"hrls": [1, 8], "lrhs": [16, 64]}


def test_shares_of_filters() -> None:
    """Half of the pairs have independent noise."""
    assert sum(share for share, *_ in splat.SHARES) == pytest.approx(1)
    rng = np.random.default_rng(0)
    drawn = [splat.draw_filter(rng) for _ in range(2000)]
    independent = np.mean([not f.spreads_noise for f in drawn])
    assert independent == pytest.approx(0.5, abs=0.04)
    assert all(0.5 <= f.radius <= 2 for f in drawn)
    for spread_noise in (True, False):
        drawn = [splat.draw_filter(rng, spread_noise=spread_noise) for _ in range(200)]
        assert all(f.spreads_noise is spread_noise for f in drawn)
