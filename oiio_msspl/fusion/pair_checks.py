# SPDX-License-Identifier: Apache-2.0
"""Checks whether two renders show the same frame, on luminance at the LRHS's resolution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, RGB
from oiio_msspl.arrays import Array, box_downsample, interpolate
from oiio_msspl.colour import luminance
from oiio_msspl.errors import InputError
from oiio_msspl.fusion.alignment import Alignment
from oiio_msspl.fusion.tile_features import TilePair
from oiio_msspl.parallel import in_background

# The thresholds were measured on matching and on wrong pairs with 1 spp in the HRLS.

#: Two renders hardly show the same frame if the correlation of their log luminance is below this. Matching pairs with
#: clean references reach 0.83 to 0.99, one lit almost only by fireflies 0.31, different scenes -0.2 to 0.25.
LOW_CORRELATION = 0.3
#: Exposures differ if the ratio of the mean luminances, without the brightest percent, exceeds this. Matching pairs
#: reach at most 1.21.
EXPOSURE_RATIO = 4 / 3
#: Framings differ if the shift in HRLS pixels exceeds this, and a fifth of an LRHS pixel. Noise moves the estimate by
#: up to half a pixel, and the paper's nearest-neighbour LRHS is half a pixel off by its nature.
MAX_SHIFT = 0.75
#: A shift counts only if the smoothed pictures, moved by it, correlate at least this much.
SHIFT_CORRELATION = 0.9
#: A step of log albedo between neighbouring pixels counts as an edge if it exceeds this.
ALBEDO_EDGE = 0.2
#: An albedo with fewer edges says nothing.
MIN_ALBEDO_EDGES = 200
#: The albedo is not that of the picture if its edges and the picture's steps correlate less than this. Of 112 matching
#: views 6, 4 and 3 % are below (x2, x4, x8); with a mirrored albedo 95, 72 and 43 %.
ALBEDO_CORRELATION = 0.05
#: A difference of exposure, or a shift, must be this many standard errors from none.
CERTAIN = 6.0
#: Brighter pixels count as this bright, because sums over a frame would overflow float32.
BRIGHTEST = 1e30
#: Side of a block in LRHS pixels -> how many standard errors the block's means must differ by to show different things.
#: Of 77 matching views none has such a block.
BLOCK_CERTAINTY = {8: 6.0, 4: 8.0}
#: The means must also differ by this share of their brightness.
BLOCK_DIFFERENCE = 0.25
#: The frame is cut into this many parts along each side. Each part is left out once to estimate standard errors.
JACKKNIFE_PARTS = 6
#: Side of the central area, in LRHS pixels, in which a shift is looked for.
SHIFT_AREA = 1024


class HrlsAverages:
    """Luminance of the HRLS's colour and albedo, averaged over the LRHS's pixels; filled tile by tile.

    Attributes:
        rgb, albedo: (h, w) over the grid of the alignment; ``albedo`` is None if the HRLS has none.
    """

    def __init__(self, alignment: Alignment) -> None:
        self.alignment = alignment
        self.rgb = np.zeros((alignment.grid.height, alignment.grid.width), np.float32)
        self.albedo: Array | None = None

    def add(self, pair: TilePair) -> None:
        """Add the core of a tile."""
        rows, columns = pair.core
        hrls = tuple(slice(part.start * pair.scale, part.stop * pair.scale) for part in (rows, columns))
        origin, grid = pair.lrhs_area, self.alignment.grid
        target = (
            slice(rows.start + origin.y0 - grid.y0, rows.stop + origin.y0 - grid.y0),
            slice(columns.start + origin.x0 - grid.x0, columns.stop + origin.x0 - grid.x0),
        )
        self.rgb[target] = luminance(box_downsample(pair.hrls[RGB][hrls], pair.scale))
        if ALBEDO in pair.hrls:
            if self.albedo is None:
                self.albedo = np.zeros_like(self.rgb)
            self.albedo[target] = luminance(box_downsample(pair.hrls[ALBEDO][hrls], pair.scale))


def check_pair(lrhs_rgb: Array, hrls: HrlsAverages, lr_name: str, hr_name: str) -> list[str]:
    """Check whether two renders show the same frame.

    Args:
        lrhs_rgb: the LRHS (h, w, 3), repaired, over the grid of the alignment.
        hrls: averages of all tiles.
        lr_name, hr_name: what messages call the renders.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: one render is black, most likely a wrong layer, and the other is not.
    """
    low, high = (np.minimum(values, BRIGHTEST) for values in (luminance(lrhs_rgb), hrls.rgb))
    alignment = hrls.alignment
    if not low.any() and not high.any():
        return ["both renders are black (or NaN) everywhere: the result is black"]
    for name, values, other in ((lr_name, low, hr_name), (hr_name, high, lr_name)):
        if not values.any():
            raise InputError(
                f"{name}: the beauty is black (or NaN) everywhere, while that of {other} is not; "
                "check which layer it is (--map rgb=LAYER)"
            )
    warnings = []
    shift = in_background(lambda: _find_shift(low, high))  # takes as long as all other checks
    ratio, certain = _brightness_ratio(low, high)
    if not 1 / EXPOSURE_RATIO < ratio < EXPOSURE_RATIO and certain:
        warnings.append(f"the HRLS is {ratio:.3g} times as bright as the LRHS: are exposure and view layer the same?")
    correlation = _log_correlation(low, high)
    if correlation < LOW_CORRELATION:
        warnings.append(
            f"the two renders hardly look alike (correlation {correlation:.2f}): are they the same frame and camera?"
        )
        return warnings
    if hrls.albedo is not None and _albedo_correlation(low + high, hrls.albedo) < ALBEDO_CORRELATION:
        warnings.append(
            "the albedo's edges are not in the picture: is it this frame's albedo? (--map albedo=LAYER says which)"
        )
    scale, grid = alignment.scale, alignment.grid
    x, y = shift() * scale
    if max(abs(x), abs(y)) > max(MAX_SHIFT, 0.2 * scale):
        warnings.append(
            f"the HRLS is shifted against the LRHS by {abs(x):.1f} pixels to the {'right' if x > 0 else 'left'} and "
            f"{abs(y):.1f} pixels {'down' if y > 0 else 'up'}: are camera, crop and overscan the same?"
        )
    if not warnings and (place := _different_block(low, high)) is not None:
        x, y = (start + scale * at for start, at in zip((grid.x0 * scale, grid.y0 * scale), place, strict=True))
        warnings.append(
            f"the two renders show different things, most of all around HRLS pixel ({x}, {y}): are they "
            "the same frame, with the same lights and objects?"
        )
    return warnings


def _albedo_correlation(picture: Array, albedo: Array) -> float:
    """Correlation of the picture's steps of log luminance with the albedo's steps, at edges of the albedo; 1 if it has
    few.

    Pixels without albedo are sky, lights or mirrors. Their edges say nothing.
    """
    surface = np.where(albedo > 0.01, np.clip(albedo, 0, 1), np.nan)
    logs = np.log(picture + 0.1 * np.median(picture[picture > 0]) + 1e-20), np.log(surface + 0.05)
    steps, edges = (np.concatenate([np.diff(v, axis=axis).ravel() for axis in (0, 1)]) for v in logs)
    steep = np.abs(edges) > ALBEDO_EDGE
    if steep.sum() < MIN_ALBEDO_EDGES:
        return 1.0
    steps, edges = np.clip(steps[steep], -2, 2), edges[steep]
    return float((steps * edges).sum() / np.sqrt(np.square(steps).sum() * np.square(edges).sum() + 1e-20))


def _log_correlation(low: Array, high: Array) -> float:
    """Pearson correlation of the log luminance of blocks of 4 x 4 pixels: noise averages out, framing stays."""
    if min(low.shape) < 16:
        return 1.0
    logs = [np.log(v + 1e-3 * v.mean() + 1e-20).ravel() for v in (_downsample_4(low), _downsample_4(high))]
    if min(v.std() for v in logs) < 1e-3:
        return 1.0  # a flat frame has no framing to compare
    return float(np.corrcoef(*logs)[0, 1])


def _brightness_ratio(low: Array, high: Array) -> tuple[float, bool]:
    """How many times as bright the HRLS is, and whether that is more than noise."""
    # Fireflies dominate a plain mean. So only pixels count that are not in the brightest percent of either render.
    lit = (low > 0) | (high > 0)
    ordinary = lit & (low <= np.quantile(low[lit], 0.99)) & (high <= np.quantile(high[lit], 0.99))
    low_sums, high_sums = (
        np.array([part.sum(dtype=np.float64) for part in _parts(v * ordinary)]) + 1e-30 for v in (low, high)
    )
    log_ratio = np.log(high_sums.sum() / low_sums.sum())
    without_part = [sums.sum() - sums for sums in (low_sums, high_sums)]
    error = _jackknife_error(np.log(np.maximum(without_part[1], 1e-30) / np.maximum(without_part[0], 1e-30)))
    return float(np.exp(log_ratio)), bool(abs(log_ratio) > CERTAIN * error)


def _find_shift(low: Array, high: Array) -> NDArray[np.float64]:
    """How far the HRLS's picture is to the right of and below the LRHS's, in LRHS pixels: (2,), 0 where not certain.

    The method is Lucas and Kanade 1981, coarse to fine. It finds the shift whose first-order effect on the LRHS,
    besides a gain and an offset, explains the difference best. The gradients are those of the LRHS, so noise of the
    HRLS makes the estimate vary and does not bias it.
    """
    no_shift = np.zeros(2)
    if min(low.shape) < 8 * JACKKNIFE_PARTS:
        return no_shift
    rows, columns = (slice(max(0, n - SHIFT_AREA) // 2, (n + SHIFT_AREA) // 2) for n in low.shape)
    grey = np.median(low[low > 0]) if low.any() else 1.0
    # Map radiance to [0, 1], so neither fireflies nor black pixels dominate.
    low, high = (_smooth(v[rows, columns] / (v[rows, columns] + grey)) for v in (low, high))
    coarse = 4 * _fit_shift(_smooth(_downsample_4(low)), _smooth(_downsample_4(high)), no_shift).shift
    # A start less than half a pixel away would lead to the same result.
    starts = [no_shift] if np.abs(coarse).max() < 0.5 else [no_shift, np.clip(coarse, -12, 12)]
    fit = min((_fit_shift(low, high, start) for start in starts), key=lambda fit: fit.residual)
    if fit.correlation < SHIFT_CORRELATION:
        return no_shift
    return np.where(np.abs(fit.shift) > CERTAIN * fit.error, fit.shift, 0)


class _ShiftFit(NamedTuple):
    shift: NDArray[np.float64]
    error: NDArray[np.float64]
    """Standard error of the shift."""
    residual: float
    correlation: float


def _fit_shift(low: Array, high: Array, start: NDArray[np.float64]) -> _ShiftFit:
    """Refine a shift (x, y): repeated least squares over shift, gain and offset, with the LRHS moved each time."""
    shift = start
    for _ in range(6):
        margin = int(np.abs(shift).max()) + 3
        inner = slice(margin, -margin)
        moved = _move(low, shift)
        gy, gx = np.gradient(moved)
        planes = np.stack([-gx, -gy, moved, np.ones_like(moved), high - moved])[:, inner, inner]
        # For each part of the frame, the products of all planes with all planes. Double precision, because the planes
        # are nearly linearly dependent.
        flat = (part.reshape(len(planes), -1).astype(np.float64) for part in _parts(planes))
        dots = np.stack([part @ part.T for part in flat])
        squares, products = dots[:, :4, :4], dots[:, :4, 4]
        total = squares.sum(0) + 1e-9 * squares.sum(0).trace() * np.eye(4)  # solvable even without any gradient
        step = np.linalg.solve(total, products.sum(0))
        shift = np.clip(shift + np.clip(step[:2], -1, 1), -min(low.shape) / 4, min(low.shape) / 4)
        if np.abs(step[:2]).max() < 0.01:
            break
    without_part = np.linalg.solve(total - squares, (products.sum(0) - products)[..., None])[:, :2, 0]
    residual = float(dots[:, 4, 4].sum() - step @ products.sum(0)) / planes[0].size
    spread = float(moved[inner, inner].std() * high[inner, inner].std())
    covariance = float(np.mean((moved - moved[inner, inner].mean())[inner, inner] * high[inner, inner]))
    return _ShiftFit(shift, _jackknife_error(without_part), residual, covariance / max(spread, 1e-12))


def _different_block(low: Array, high: Array) -> tuple[int, int] | None:
    """Where (x, y), in LRHS pixels, the two pictures differ by more than noise explains; None if nowhere.

    A paired t-test for each block. What both pictures show cancels out, and a single firefly has a t of about 1,
    however bright it is.
    """
    floor = 0.05 * np.median(low + high)
    for size, certain in BLOCK_CERTAINTY.items():
        height, width = (n // size for n in low.shape)
        if height == 0 or width == 0:
            continue
        a, b = (
            v[: height * size, : width * size]
            .reshape(height, size, width, size)
            .swapaxes(1, 2)
            .reshape(height, width, -1)
            for v in (low.astype(np.float64), high.astype(np.float64))  # a squared firefly overflows float32
        )
        brightness = (a + b).mean(axis=-1) / 2
        difference = np.abs((a - b).mean(axis=-1))
        # Two percent of the brightness do not count, even between renders without noise.
        error = (a - b).std(axis=-1) / size + 0.02 * brightness
        t = np.where(difference > BLOCK_DIFFERENCE * (brightness + floor), difference / np.maximum(error, 1e-30), 0)
        if t.max() > certain:
            y, x = np.unravel_index(t.argmax(), t.shape)
            return int(x * size + size // 2), int(y * size + size // 2)
    return None


def _parts(values: Array) -> list[Array]:
    """Cut planes (..., h, w) into the parts for the jackknife."""
    rows = np.array_split(values, JACKKNIFE_PARTS, -2)
    return [part for row in rows for part in np.array_split(row, JACKKNIFE_PARTS, -1)]


def _jackknife_error(without_part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error of an estimate, from the estimates (n, ...) that leave out one of n parts each."""
    return np.sqrt((len(without_part) - 1) * without_part.var(axis=0))


def _move(values: Array, shift: NDArray[np.float64]) -> Array:
    """Move a picture (h, w) by (x, y) to the right and down; the edge pixel is repeated."""
    for axis, distance in ((1, shift[0]), (0, shift[1])):
        values = interpolate(values, np.arange(values.shape[axis]) - distance, axis)
    return values


def _smooth(values: Array) -> Array:
    """Binomial filter of 5 x 5 pixels."""
    for axis in (0, 1, 0, 1):
        size = values.shape[axis]
        padded = np.pad(values, [(1, 1) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        neighbours: Array = padded.take(range(size), axis) + padded.take(range(2, size + 2), axis)
        values = (neighbours + 2 * values) / np.float32(4)
    return values


def _downsample_4(values: Array) -> Array:
    """Mean of 4 x 4 pixels; incomplete blocks at the end are left out."""
    height, width = (n // 4 for n in values.shape)
    return box_downsample(values[: height * 4, : width * 4], 4)
