# SPDX-License-Identifier: Apache-2.0
"""Finds the shift and zoom of one picture against another, by least squares.

The method is Lucas and Kanade 1981, coarse to fine: shift and zoom whose first-order effect on the LRHS explains the
difference best. A tone curve, since noise changes the mean of display values, and a blur, since pixel filters differ,
are fitted along with them, as a polynomial of the LRHS and its Laplacian. The gradients are those of the LRHS, so noise
of the HRLS does not bias the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.fusion.checks.likeness import BETTER, Fit, fine_fits, fits_at_all, fits_better, mirrored, tone_mapped
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import blurred, box_downsample, interpolate

#: A framing counts if the pictures, moved by it, fit clearly better: with few edges, noise looks like a shift. A little
#: better is enough if it explains this fraction, or this many pixels, of the difference that tone curve and blur leave.
MIN_EXPLAINED, MIN_EXPLAINED_PIXELS = 0.2, 3000
#: It also counts if it explains this fraction: smooth pictures have no fine structure that could fit better.
OBVIOUS = 0.5
#: A difference must be this many standard errors from none.
CERTAIN = 8.0
#: The frame is cut into this many parts along each side. Each part is left out once to estimate standard errors.
JACKKNIFE_PARTS = 6
#: Side of the central area, in LRHS pixels, in which the framing is compared.
AREA = 1024
#: Pictures with a shorter side, in LRHS pixels, have too few edges to judge.
SMALLEST = 44
#: Smaller pictures are not searched for shifts of several pixels: at a quarter of their size little is left.
SMALLEST_COARSE = 80
#: Largest zoom that is looked for.
LARGEST_ZOOM_SEARCHED = 0.1


@dataclass(frozen=True)
class Framing:
    """The shift and zoom of the HRLS against the LRHS. All numbers are 0 if the difference is not certain."""

    x: float = 0.0
    """Shift to the right in LRHS pixels."""
    y: float = 0.0
    """Shift down in LRHS pixels."""
    zoom: float = 0.0
    """Growth of the HRLS's picture: 0.03 for 3 %."""
    zoom_at_edge: float = 0.0
    """Pixels of the LRHS by which the zoom moves the edge of the area in which it was measured."""
    mirrored: str | None = None
    """How one of the two is mirrored; None if it is not."""
    judged: bool = False
    """Enough structure is common to both for a difference to be seen."""


def find_framing(low: Array, high: Array) -> Framing:
    """Find the framing of the HRLS against the LRHS, both luminance (h, w), finite."""
    low, high = tone_mapped(central_area(low), central_area(high))
    before = fine_fits(low, high)
    if (how := mirrored(before)) is not None:
        return Framing(mirrored=how, judged=True)
    if min(low.shape) < SMALLEST:
        return Framing()
    smooth_low, smooth_high = blurred(low, 2), blurred(high, 2)
    fits = [_fit(smooth_low, smooth_high, start) for start in _starts(smooth_low, smooth_high, before)]
    fit = max(fits, key=lambda fit: fit.explained)
    certain = np.abs(fit.estimate) > CERTAIN * fit.error
    if not certain.any():
        return Framing(judged=fits_at_all(before))
    after = fine_fits(_move(low, fit.estimate / (1, 1, max(low.shape) / 2)), high)
    explains = fit.explained >= min(MIN_EXPLAINED, MIN_EXPLAINED_PIXELS / low.size)
    obvious = fit.explained >= OBVIOUS and fits_at_all(after)
    if not obvious and not fits_better(before, after, certain=not explains):
        return Framing(judged=fits_at_all(before))
    x, y, at_edge = np.where(certain, fit.estimate, 0)
    return Framing(float(x), float(y), float(at_edge / (max(low.shape) / 2)), float(at_edge), judged=True)


def _starts(low: Array, high: Array, fits: list[Fit]) -> list[NDArray[np.float64]]:
    """Return estimates to start from: none, the shifts that fit best, and an estimate at a quarter of the size."""
    starts = [np.zeros(3), *(np.array([*fit.best, 0.0]) for fit in fits if fit.best_fit >= BETTER)]
    if min(low.shape) >= SMALLEST_COARSE:
        low_4, high_4 = (blurred(box_downsample(v, 4), 2) for v in (low, high))
        starts.append(np.clip(_fit(low_4, high_4, np.zeros(3)).estimate * 4, -12, 12))
    # Starts less than half a pixel from each other lead to the same result.
    chosen: list[NDArray[np.float64]] = starts[:1]
    for start in starts[1:]:
        if min(np.abs(start - other).max() for other in chosen) >= 0.5:
            chosen.append(start)
    return chosen


@dataclass(frozen=True)
class _Fit:
    estimate: NDArray[np.float64]
    """Shift x, y, and the zoom's displacement at the edge of the longer side; in pixels."""
    error: NDArray[np.float64]
    """Standard error of ``estimate``."""
    explained: float
    """Fraction of the squared difference left by tone curve and blur that shift and zoom explain."""


def _fit(low: Array, high: Array, start: NDArray[np.float64]) -> _Fit:
    """Refine an estimate by repeated least squares, each time with the LRHS moved by the last estimate."""
    height, width = low.shape
    half = max(low.shape) / 2
    across, down = ((np.arange(n, dtype=np.float32) - (n - 1) / 2) / np.float32(half) for n in (width, height))
    # Shift and zoom together leave some rows and columns to compare.
    largest = np.full(3, (min(low.shape) / 2 - 5) / 2).clip(max=(np.inf, np.inf, LARGEST_ZOOM_SEARCHED * half))
    estimate = np.clip(start, -largest, largest)
    for _ in range(8):
        moved = _move(low, estimate / (1, 1, half))
        margin = int(np.abs(estimate[:2]).max() + abs(estimate[2])) + 3
        inner = slice(margin, -margin)
        gy, gx = np.gradient(moved)
        zoom = gx * across + gy * down[:, None]
        blur = blurred(moved, 2) - moved
        terms = [-gx, -gy, -zoom, moved, np.square(moved), blur, np.ones_like(moved)]
        planes = np.stack([*terms, high - moved])[:, inner, inner]
        # For each part of the frame, the products of all planes with all planes. Double precision, because the planes
        # are nearly linearly dependent.
        flat = (part.reshape(len(planes), -1).astype(np.float64) for part in parts(planes))
        dots = np.stack([part @ part.T for part in flat])
        squares, products = dots[:, :-1, :-1], dots[:, :-1, -1]
        total = squares.sum(0) + 1e-9 * squares.sum(0).trace() * np.eye(len(terms))  # solvable without any gradient
        step = np.linalg.pinv(total, hermitian=True) @ products.sum(0)
        estimate = np.clip(estimate + np.clip(step[:3], -1, 1), -largest, largest)
        if np.abs(step[:3]).max() < 0.01:
            break
    inverses = np.linalg.pinv(total - squares, hermitian=True)
    without_part = (inverses @ (products.sum(0) - products)[..., None])[:, :3, 0]
    error = jackknife_error(without_part)
    residual = float(dots[:, -1, -1].sum() - step @ products.sum(0))
    explained = 1 - residual / max(_unmoved_residual(low, high, inner), 1e-30)
    return _Fit(estimate, error, explained)


def _unmoved_residual(low: Array, high: Array, inner: slice) -> float:
    """Return the squared difference inside ``inner`` that a tone curve and a blur of the LRHS leave."""
    terms = [low, np.square(low), blurred(low, 2) - low, np.ones_like(low)]
    planes = np.stack([*terms, high - low])[:, inner, inner].reshape(5, -1).astype(np.float64)
    dots = planes @ planes.T
    coefficients = np.linalg.lstsq(dots[:4, :4], dots[:4, 4], rcond=None)[0]
    return float(dots[4, 4] - coefficients @ dots[:4, 4])


def _move(values: Array, by: NDArray[np.float64]) -> Array:
    """Move a picture (h, w) by (x, y) to the right and down, zoomed around its centre; the edge pixel is repeated."""
    for axis, distance in ((1, by[0]), (0, by[1])):
        middle = (values.shape[axis] - 1) / 2
        positions = (np.arange(values.shape[axis]) - middle - distance) / (1 + by[2]) + middle
        values = interpolate(values, positions, axis)
    return values


def central_area(values: Array) -> Array:
    """Return the middle of a picture (h, w), at most `AREA` pixels wide and high."""
    return values[central_slices(values.shape, AREA)]


def central_slices(shape: tuple[int, int], side: int) -> tuple[slice, slice]:
    """Return rows and columns of the middle of a picture, at most ``side`` of each."""
    rows, columns = (slice(max(0, n - side) // 2, min(n, (n + side) // 2)) for n in shape)
    return rows, columns


def parts(values: Array) -> list[Array]:
    """Cut planes (..., h, w) into the parts for the jackknife."""
    rows = np.array_split(values, JACKKNIFE_PARTS, -2)
    return [part for row in rows for part in np.array_split(row, JACKKNIFE_PARTS, -1)]


def jackknife_error(without_part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard error of an estimate, from n estimates (n, ...) that leave out one of n parts each."""
    return np.sqrt((len(without_part) - 1) * without_part.var(axis=0))
