# SPDX-License-Identifier: Apache-2.0
"""Pixel filters, applied to samples whose place in their pixel is known (:mod:`research.datagen.samples`).

Renderers use a filter in one of two ways, and the noise differs:

* **splatting**: a sample counts in all pixels within the filter's radius, and a pixel is sum(w L) / sum(w). Neighbours
  share samples, so their noise is correlated;
* **importance sampling**: a sample counts in one pixel, with a probability in proportion to the filter. The noise of
  neighbours is independent.

A filter is separable. Lengths are in pixels of the image that is made, so the LRHS is filtered in its own pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

# Filters


def _blackman_harris(t: Tensor) -> Tensor:
    a = (0.35875, 0.48829, 0.14128, 0.01168)
    return torch.stack([value * torch.cos(math.pi * k * t) for k, value in enumerate(a)]).sum(dim=0)


def _cubic(b: float, c: float) -> Callable[[Tensor], Tensor]:
    """Return a cubic of Mitchell and Netravali, "Reconstruction Filters in Computer Graphics" (1988), equation 8."""

    def weight(t: Tensor) -> Tensor:
        x = 2 * t
        inner = (12 - 9 * b - 6 * c) * x**3 + (-18 + 12 * b + 6 * c) * x**2 + (6 - 2 * b)
        outer = (-b - 6 * c) * x**3 + (6 * b + 30 * c) * x**2 + (-12 * b - 48 * c) * x + (8 * b + 24 * c)
        return torch.where(x < 1, inner, outer) / 6

    return weight


#: Weight at the distance t = |x| / radius, between 0 and 1. The Gaussian of Mitsuba has a standard deviation of a
#: quarter of the radius and is shifted to end at zero; Arnold's has half the radius and is cut off.
KINDS: dict[str, Callable[[Tensor], Tensor]] = {
    "box": torch.ones_like,
    "tent": lambda t: 1 - t,
    "gaussian": lambda t: torch.exp(-8 * t**2) - math.exp(-8),
    "wide-gaussian": lambda t: torch.exp(-2 * t**2),
    "blackman-harris": _blackman_harris,
    "mitchell": _cubic(1 / 3, 1 / 3),
    "catmull-rom": _cubic(0, 1 / 2),
    "lanczos": lambda t: torch.sinc(2 * t) * torch.sinc(t),
}


@dataclass(frozen=True)
class PixelFilter:
    """A pixel filter: its kind, its radius in pixels, and whether samples are splatted to all pixels that it covers."""

    kind: str = "box"
    radius: float = 0.5
    splatted: bool = True

    @property
    def reach(self) -> int:
        """How many pixels away from its own a sample may count."""
        return math.ceil(self.radius - 0.5)

    @property
    def spreads_noise(self) -> bool:
        """Whether neighbouring pixels share samples, and so their noise."""
        return self.splatted and self.reach > 0

    def samples_for(self, count: int) -> int:
        """Return how many stored samples of a pixel give it ``count``.

        Importance sampling moves some to other pixels, so it needs more to choose from.
        """
        return count if self.splatted else 2 * count + 4

    def weights(self, place: Tensor) -> Tensor:
        """Return the weights of samples at ``place`` (0 to 1) in pixels -reach ... reach: (2 * reach + 1, ...).

        For importance sampling they are divided by their sum, so that they are probabilities.
        """
        offsets = torch.arange(-self.reach, self.reach + 1, device=place.device, dtype=place.dtype)
        t = (place - 0.5 - offsets.reshape(-1, *[1] * place.ndim)).abs() / self.radius
        weights = torch.where(t <= 1, KINDS[self.kind](t), 0.0)
        return weights if self.splatted else weights / weights.sum(dim=0)


BOX = PixelFilter()

#: Share of training pairs, kind of filter, least and greatest radius in pixels, splatted. Half of the pairs have
#: independent noise, as Cycles, RenderMan and pbrt make it and as every renderer does with a box of one pixel. The rest
#: is led by the Gaussian, the default of Mitsuba, Arnold, Redshift, Karma and Mantra.
SHARES: tuple[tuple[float, str, float, float, bool], ...] = (
    (0.25, "box", 0.5, 0.5, True),
    (0.15, "blackman-harris", 0.75, 1.65, False),
    (0.06, "gaussian", 1.0, 2.0, False),
    (0.04, "tent", 0.75, 1.5, False),
    (0.14, "gaussian", 1.0, 2.0, True),
    (0.10, "wide-gaussian", 0.75, 1.5, True),
    (0.10, "blackman-harris", 0.75, 2.0, True),
    (0.04, "tent", 0.75, 1.5, True),
    (0.05, "mitchell", 2.0, 2.0, True),
    (0.02, "catmull-rom", 2.0, 2.0, True),
    (0.03, "lanczos", 2.0, 2.0, True),
    (0.02, "box", 0.75, 1.5, True),
)


def draw_filter(rng: np.random.Generator, *, spread_noise: bool | None = None) -> PixelFilter:
    """Draw a filter in the shares of ``SHARES``: only those that spread noise, only the others, or any (None)."""
    filters = [(share, PixelFilter(kind, greatest, splatted)) for share, kind, _, greatest, splatted in SHARES]
    shares = [share if spread_noise in (None, kind.spreads_noise) else 0.0 for share, kind in filters]
    _, kind, least, greatest, splatted = SHARES[rng.choice(len(SHARES), p=np.divide(shares, sum(shares)))]
    return PixelFilter(kind, float(rng.uniform(least, greatest)), splatted)


# Samples to pixels


def apply(
    pixel_filter: PixelFilter, place: Tensor, values: Tensor, scale: int = 1,
    count: int | None = None, generator: torch.Generator | None = None,
) -> Tensor:  # fmt: skip
    """Filter samples into pixels of s x s of theirs. Samples outside the image are missing, as at the edge of a film.

    Args:
        place: (K, H, W, 2), x and y of the samples in their pixels, 0 to 1.
        values: (K, C, H, W).
        scale: s. H and W are multiples of it.
        count: for importance sampling, at most this many samples in each pixel; for a spread filter without meaning.
        generator: of the random numbers for importance sampling.

    Returns:
        (C, H / s, W / s)
    """

    def blocks(samples: Tensor) -> Tensor:
        """Reorder (K, ..., H, W) to (K * s * s, ..., h, w)."""
        split = samples.unflatten(-1, (-1, scale)).unflatten(-3, (-1, scale))
        return split.movedim((-3, -1), (1, 2)).flatten(0, 2)

    rows, columns = (torch.arange(n, device=place.device) % scale for n in values.shape[-2:])
    x = blocks((place[..., 0] + columns) / scale)
    y = blocks((place[..., 1] + rows[:, None]) / scale)
    stacked = torch.cat([torch.ones_like(x)[:, None], blocks(values)], dim=1)
    if pixel_filter.splatted:
        return _splat(pixel_filter, x, y, stacked)
    return _distribute(pixel_filter, x, y, stacked, count, generator)


def _splat(pixel_filter: PixelFilter, x: Tensor, y: Tensor, values: Tensor) -> Tensor:
    """Compute each pixel as sum(w L) / sum(w); the first channel of the values is 1."""
    reach, (height, width) = pixel_filter.reach, x.shape[-2:]
    sums = values.new_zeros(values.shape[1], height + 2 * reach, width + 2 * reach)
    across, down = pixel_filter.weights(x), pixel_filter.weights(y)
    for i, w_y in enumerate(down):
        for j, w_x in enumerate(across):
            for k, w in enumerate(w_x * w_y):
                sums[:, i : i + height, j : j + width].addcmul_(w, values[k])
    weight, *rest = sums[:, reach : reach + height, reach : reach + width]
    return torch.stack(rest) / torch.where(weight.abs() > 1e-3, weight, 1e-3)  # negative lobes may leave nothing


def _distribute(
    pixel_filter: PixelFilter, x: Tensor, y: Tensor, values: Tensor,
    count: int | None, generator: torch.Generator | None,
) -> Tensor:  # fmt: skip
    """Count each sample in one pixel, drawn by the filter; the first channel of the values is 1.

    The samples of a pixel are then distributed as the filter divided by the sum of the filters of all pixels there,
    which is nearly the filter itself from a width of two pixels. Pixels that get fewer than ``count`` are the mean of
    those; a pixel that gets none takes the first of its own.
    """
    height, width = x.shape[-2:]

    def moved(position: Tensor) -> Tensor:
        """Draw a pixel offset for every sample."""
        cumulative = pixel_filter.weights(position).cumsum(dim=0)
        drawn = torch.rand(position.shape, generator=generator, device=position.device)
        return (drawn >= cumulative[:-1]).sum(dim=0) - pixel_filter.reach

    column = torch.arange(width, device=x.device) + moved(x)
    row = torch.arange(height, device=x.device)[:, None] + moved(y)
    kept = ((column >= 0) & (column < width) & (row >= 0) & (row < height)).flatten()
    target = (row * width + column).flatten()
    target = torch.where(kept, target, height * width)  # a pixel beyond the others, for samples that leave the image
    chosen = torch.arange(len(target), device=x.device)
    if count is not None:
        # Samples in random order, grouped by their pixel: the first ones of each group count
        shuffled = torch.rand(target.shape, generator=generator, device=x.device, dtype=torch.float64)
        order = (target + shuffled).argsort()
        groups = target[order]
        chosen = order[chosen - torch.searchsorted(groups, groups) < count]
    columns = values.movedim(1, -1)
    sums = values.new_zeros(height * width + 1, columns.shape[-1])
    sums.index_add_(0, target[chosen], columns.reshape(-1, columns.shape[-1])[chosen])
    sums = sums[:-1].reshape(height, width, -1).movedim(-1, 0)
    n, *rest = torch.where(sums[0] > 0, sums, columns[0].movedim(-1, 0))
    return torch.stack(rest) / n


# Reference


def filter_reference(pixel_filter: PixelFilter, cells: Tensor, per_pixel: int) -> Tensor:
    """Filter a reference of R x R cells a pixel, (C, R*H, R*W) to (C, H, W): the expected value of :func:`apply`.

    A cell has the mean weight of the positions in it.
    """
    points = 32  # positions per cell, along each side
    place = (torch.arange(per_pixel * points, device=cells.device) + 0.5) / (per_pixel * points)
    weights = pixel_filter.weights(place.to(cells.dtype)).flip(0)  # of cells -reach ... reach seen from a pixel
    kernel = weights.reshape(-1, points).mean(dim=1)
    kernel = kernel / kernel.sum()
    padding = pixel_filter.reach * per_pixel
    weighted = torch.cat([cells, torch.ones_like(cells[:1])])[:, None]
    for axis, shape in ((2, (1, 1, -1, 1)), (3, (1, 1, 1, -1))):
        stride, padded = [1, 1], [0, 0]
        stride[axis - 2], padded[axis - 2] = per_pixel, padding
        weighted = F.conv2d(weighted, kernel.reshape(shape), stride=stride, padding=padded)
    return weighted[:-1, 0] / weighted[-1:, 0]
