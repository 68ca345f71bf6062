# SPDX-License-Identifier: Apache-2.0
"""Tells how well two pictures of one frame should correlate, how well they do, and how well by chance.

The noise of two halves of a block is independent, so their correlation tells how well two noisy pictures should
correlate. Fine structure has a control of its own: shifted or mirrored, a picture shows how well it fits by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array, quantile
from oiio_msspl.image.filters import blurred, box_downsample, means_around

#: Side of the blocks, in LRHS pixels, whose brightness is compared; and the fewest blocks.
BLOCK, FEWEST_BLOCKS = 4, 32
#: Sides of the pixels, in LRHS pixels, at which fine structure is compared; and the fewest along each side.
SIDES, FEWEST = (1, 2, 4, 8), 12
#: Smallest and largest shift of the control. With smaller shifts, structures still overlap.
CONTROL = (4, 16)
#: The brightness of one frame correlates by more than this fraction of what is expected, and is not judged if less than
#: ``VISIBLE`` is expected. Of 763 right pairs the least is 0.89.
ALIKE, VISIBLE = 0.7, 0.6
#: Fine structure fits if it correlates by this many standard deviations of the control, and it fits better in another
#: position if it correlates by so many more there. Mirrored, right pairs reach 4.2.
FITS, BETTER = 4.5, 6.0

#: How a picture may be mirrored, and along which axes.
_FLIPS = {"from left to right": (1,), "from top to bottom": (0,), "in both directions (turned by 180 degrees)": (0, 1)}


def tone_mapped(*pictures: Array) -> tuple[Array, ...]:
    """Map luminances (h, w) of one frame to [0, 1], so that neither fireflies nor black pixels dominate."""
    lit = pictures[0][pictures[0] > 0]
    grey = quantile(lit, 0.5) if lit.size else 1.0
    return tuple(values / (values + grey) for values in pictures)


def correlations(low: Array, high: Array) -> tuple[float, float]:
    """Return the correlation of the brightness of two pictures (h, w), and that which their noise lets expect.

    The second is 0 if there are too few blocks.
    """
    halves = [_halves(values) for values in (low, high)]
    if halves[0][0].size < FEWEST_BLOCKS:
        return 0.0, 0.0
    # The halves have twice the noise of the whole (Spearman 1910, Brown 1910).
    shares = [2 * r / (1 + r) for r in (max(_correlation(*pair), 0.0) for pair in halves)]
    return _correlation(*(a + b for a, b in halves)), float(np.sqrt(shares[0] * shares[1]))


def _halves(values: Array) -> tuple[Array, Array]:
    """Return the means of both diagonals of each block."""
    height, width = (side // BLOCK * BLOCK for side in values.shape)
    quarters = box_downsample(values[:height, :width], BLOCK // 2)
    return quarters[::2, ::2] + quarters[1::2, 1::2], quarters[::2, 1::2] + quarters[1::2, ::2]


def _correlation(a: Array, b: Array) -> float:
    first, second = (values.astype(np.float64) for values in (a - a.mean(), b - b.mean()))
    # Sums, because the threads of a long dot product keep a core busy for 0.2 s after it.
    squares = np.sum(np.square(first)) * np.sum(np.square(second))
    return float(np.sum(first * second) / max(np.sqrt(squares), 1e-30))


@dataclass(frozen=True)
class Fit:
    """How well fine structure fits, at one size of pixels, in standard deviations of the control."""

    here: float
    """The pictures as they are."""
    flips: dict[str, float]
    """One of them mirrored."""
    best: tuple[int, int]
    """The shift of ``high`` to the right and down, in LRHS pixels, with which they fit best."""
    best_fit: float
    """How well they fit with that shift."""


def fine_fits(low: Array, high: Array) -> list[Fit]:
    """Return how well the fine structure of two pictures (h, w) fits, at all sizes of pixels that leave enough."""
    sides = [side for side in SIDES if min(low.shape) // side >= FEWEST]
    return [_fit(_normalised(low, side), _normalised(high, side), side) for side in sides]


def mirrored(fits: list[Fit]) -> str | None:
    """Return how one of two pictures is mirrored; None if it is not."""
    gains = [(value - fit.here, how) for fit in fits for how, value in fit.flips.items() if value >= FITS]
    gain, how = max(gains, default=(0.0, ""))
    return how if gain >= BETTER else None


def fits_at_all(fits: list[Fit]) -> bool:
    """Return whether two pictures fit better than by chance."""
    return any(fit.here >= FITS for fit in fits)


def fits_better(before: list[Fit], after: list[Fit], *, certain: bool) -> bool:
    """Return whether two pictures fit, and better than before one was moved, by much or (not ``certain``) a little."""
    gains = [new.here - old.here for old, new in zip(before, after, strict=True)]
    if not certain:
        return fits_at_all(after) and sum(gains) >= BETTER / 3
    return any(new.here >= BETTER and gain >= BETTER / 2 for new, gain in zip(after, gains, strict=True))


def fine_structure(values: Array) -> Array:
    """Return differences (h, w) to the neighbourhood, in units of its RMS, so that no bright corner dominates."""
    fine = values - blurred(values, 4)
    power = means_around(np.square(fine), 4)
    return fine / np.sqrt(power + np.float32(1e-3 * float(np.mean(np.square(fine))) + 1e-20))


def by_shift(spectrum: NDArray[np.complexfloating], shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the correlation of two pictures for each shift, none in the middle; and those that are the control.

    Args:
        spectrum: product of the spectra of the pictures, one of them conjugated.
        shape: of the pictures.
    """
    furthest = min(CONTROL[1], min(shape) // 2 - 1)
    rolled: Array = np.roll(np.fft.irfft2(spectrum, shape), (furthest, furthest), (0, 1))
    window = rolled[: 2 * furthest + 1, : 2 * furthest + 1]
    y, x = np.abs(np.mgrid[-furthest : furthest + 1, -furthest : furthest + 1])
    return window, window[np.maximum(x, y) >= CONTROL[0]]


def _normalised(values: Array, side: int) -> Array:
    """Return the fine structure of pixels of a size, with a mean of 0 and a sum of squares of 1."""
    fine = fine_structure(box_downsample(values, side) if side > 1 else values)
    fine = fine - fine.mean()
    return fine / np.float32(max(float(np.linalg.norm(fine)), 1e-20))


def _fit(low: Array, high: Array, side: int) -> Fit:
    window, control = by_shift(np.conj(np.fft.rfft2(low)) * np.fft.rfft2(high), low.shape)
    deviation, furthest = max(float(control.std()), 1e-6), len(window) // 2
    flips = {how: float(np.sum(low * np.flip(high, axes))) / deviation for how, axes in _FLIPS.items()}
    row, column = np.unravel_index(window.argmax(), window.shape)
    best = int(column - furthest) * side, int(row - furthest) * side
    return Fit(float(window[furthest, furthest]) / deviation, flips, best, float(window.max()) / deviation)
