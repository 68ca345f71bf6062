# SPDX-License-Identifier: Apache-2.0
"""Blending the candidates. Needs PyTorch."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: E402

from oiio_msspl.model.contract import SCALES  # noqa: E402
from research.training.encoding import log_encode  # noqa: E402
from research.training.joint import MARGIN, blend, mixed  # noqa: E402

HEIGHT, WIDTH = 64, 96
#: Indices of the candidates in FINER and in COARSEST.
RESCALED, DENOISED, LIGHT, HRLS = range(4)
DENOISED_MEAN, DENOISED_HRLS, HRLS_MEAN, LRHS = range(4, 8)


def images(scale: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random inputs of :func:`research.training.joint.blend`: LRHS with the denoised mean, HRLS, denoised HRLS."""
    generator = torch.Generator().manual_seed(scale)
    sizes = ((6, HEIGHT // scale, WIDTH // scale), (6, HEIGHT, WIDTH), (3, HEIGHT, WIDTH))
    lrhs, hrls, denoised = (torch.rand(1, *size, generator=generator) for size in sizes)
    return lrhs, hrls, denoised


def preferring(finer: int, coarsest: int = DENOISED_MEAN) -> list[torch.Tensor]:
    """Logits by which every pixel takes one candidate, and the albedo colours all light."""
    choice = torch.full((8,), -40.0)
    choice[[finer, coarsest]] = 40.0
    full = torch.cat([choice[:4], torch.full((1,), 40.0)])
    return [
        (choice if level else full)[None, :, None, None].expand(1, -1, HEIGHT >> level, WIDTH >> level)
        for level in range(4)
    ]


def test_weights_are_those_of_a_softmax() -> None:
    logits = 30 * torch.randn(2, 3, 4, 5)
    candidates = [torch.rand(2, 3, 4, 5) for _ in range(3)]
    expected = (torch.softmax(logits, 1).unsqueeze(2) * torch.stack(candidates, 1)).sum(1)
    torch.testing.assert_close(mixed(logits, candidates), expected)


@pytest.mark.parametrize("scale", SCALES)
def test_every_fine_candidate_can_be_chosen(scale: int) -> None:
    """With noisy renders of even light, a denoised HRLS that is 1.5 times too dark, and a striped albedo."""
    lrhs, hrls, denoised = images(scale)
    stripes = 0.4 + 0.2 * (torch.arange(WIDTH) % 2).expand(1, 3, HEIGHT, WIDTH)
    light = 0.5 * torch.ones(1, 3, HEIGHT, WIDTH)
    hrls[:, 3:6] = stripes
    denoised = log_encode(stripes * light / 1.5)
    lrhs[:, 3:] = log_encode(F.avg_pool2d(stripes * light, scale))
    expected = {
        RESCALED: log_encode(stripes * light),
        DENOISED: denoised,
        LIGHT: log_encode(stripes * light),
        HRLS: hrls[:, :3],
    }
    for choice, image in expected.items():
        torch.testing.assert_close(
            blend(lrhs, hrls[:, :3], hrls[:, 3:6], denoised, preferring(choice)), image, atol=0.01, rtol=0
        )


@pytest.mark.parametrize("scale", SCALES)
def test_every_coarse_candidate_can_be_chosen(scale: int) -> None:
    """The coarsest candidate sets the brightness of the result, if finer levels follow it."""
    lrhs, hrls, denoised = images(scale)
    hrls[:, :3], denoised[:], lrhs[:, :3], lrhs[:, 3:] = 0.2, 0.3, 0.4, 0.35
    for choice, value in {DENOISED_MEAN: 0.35, DENOISED_HRLS: 0.3, HRLS_MEAN: 0.2, LRHS: 0.4}.items():
        expected = torch.full((1, 3, HEIGHT, WIDTH), value)
        torch.testing.assert_close(
            blend(lrhs, hrls[:, :3], hrls[:, 3:6], denoised, preferring(RESCALED, choice)), expected, atol=0.01, rtol=0
        )


def test_it_never_leaves_the_range_of_its_inputs() -> None:
    """Even with random weights and a wrong denoised HRLS. A denoised mean that is in the range does not widen it."""
    lrhs, hrls, denoised = images(4)
    denoised, lrhs[:, 3:] = 4.0 * denoised, 4.0 * lrhs[:, 3:]
    lrhs[:, :3, :8], hrls[:, :3, :32], lrhs[:, 3:, :8] = 0.1, 0.2, 0.15
    logits = [5 * torch.randn(1, 8 if level else 5, HEIGHT >> level, WIDTH >> level) for level in range(4)]
    fused = blend(lrhs, hrls[:, :3], hrls[:, 3:6], denoised, logits)
    assert fused[:, :, :20].min() >= 0.1 and fused[:, :, :20].max() <= 0.2
    assert fused.max() <= 1.0


@pytest.mark.parametrize("scale", SCALES)
def test_where_all_samples_around_are_black_the_denoised_mean_counts(scale: int) -> None:
    """As far as a sample nearby is as bright; without any light nearby the result is black."""
    lrhs, hrls, denoised = (torch.zeros_like(image) for image in images(scale))
    lrhs[:, 3:] = denoised[:] = 0.3
    assert blend(lrhs, hrls[:, :3], hrls[:, 3:6], denoised, preferring(DENOISED)).max() == 0
    lrhs[:, :3, 2, 2] = 0.2
    fused = blend(lrhs, hrls[:, :3], hrls[:, 3:6], denoised, preferring(DENOISED))
    row = 6 * scale  # beyond the LRHS pixels beside the lit one
    torch.testing.assert_close(fused[:, :, row, : 4 * scale], torch.full((1, 3, 4 * scale), 0.2))


def test_a_margin_allows_more_than_the_denoised_mean() -> None:
    """Between rare samples. So the result has no step where a sample is near enough to allow more."""
    lrhs, hrls, denoised = (torch.zeros_like(image) for image in images(2))
    lrhs[:, 3:], denoised[:], lrhs[:, :3, 2, 2] = 0.3, 0.5, 0.9
    row = 12  # beyond the LRHS pixels beside the lit one
    for margin, highest in ((0.0, 0.3), (0.1, 0.4), (0.3, 0.5)):
        fused = blend(lrhs, hrls[:, :3], hrls[:, 3:6], denoised, preferring(DENOISED), margin)
        torch.testing.assert_close(fused[:, :, row, :8], torch.full((1, 3, 8), highest))
    assert MARGIN["usual"] == 0 < MARGIN["large"]
