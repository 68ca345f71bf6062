# SPDX-License-Identifier: Apache-2.0
"""Does a pair make sense? Looks into the pixels, once, before any time is spent on fusing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, RGB
from oiio_msspl.arrays import Array, box_downsample
from oiio_msspl.colour import luminance
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import ReadableRender, Window
from oiio_msspl.fusion.alignment import Alignment
from oiio_msspl.fusion.tile_features import read_features
from oiio_msspl.parallel import in_background

#: Correlation of log luminance below which two renders hardly show one frame. Measured with a 1-spp HRLS: 0.83 to 0.99
#: on scenes with clean references, 0.31 where nearly all light is fireflies; between different scenes -0.2 to 0.25.
LOW_CORRELATION = 0.3
#: Ratio of mean luminance, without the brightest percent, above which exposures differ. Measured on matching pairs: at
#: most 1.1 on scenes with clean references, 1.21 where nearly all light is fireflies.
EXPOSURE_RATIO = 4 / 3
#: Shift in HRLS pixels (and at least a fifth of an LRHS pixel) above which framings differ. Noise moves the estimate by
#: up to half a pixel; the nearest-neighbour LRHS of the paper lies half a pixel off by its nature.
SHIFT = 0.75
#: Correlation of the smoothed pictures, once laid over each other, below which a shift explains too little to be one.
SHIFT_CORRELATION = 0.9
#: Steps of log albedo between neighbouring pixels that count as edges, how many of them tell something, and their
#: correlation with the picture's steps below which the albedo is not that of the picture. Of 112 views
#: for training with a 1-spp HRLS 6, 4 and 3 % lie below it (x2, x4, x8; full of glass and lights), with the albedo
#: mirrored 95, 72 and 43 %.
ALBEDO_EDGE, ALBEDO_EDGES, ALBEDO_CORRELATION = 0.2, 200, 0.05
#: Standard errors that an exposure or a shift must lie from none.
CERTAIN = 6.0
#: Sides of blocks in LRHS pixels, and by how many standard errors the renders' means of one must lie apart, as well as
#: by a quarter of their brightness, to show different things. Of 77 views at x2, x4 and x8, with 1 and 4 spp in either
#: render and with the nearest-neighbour LRHS, none has such a block.
PLACES = {8: 6.0, 4: 8.0}
DIFFERENCE = 0.25
#: The frame is cut into that many blocks each way, each left out once, to learn how certain an estimate is.
BLOCKS = 6
#: LRHS pixels each way in the frame's middle that suffice to find a shift.
MIDDLE = 1024
#: Rows of the LRHS grid that are compared at a time.
BAND = 32


def check_pair(lr_rgb: Array, hr: ReadableRender, pairing: Alignment, lr_name: str) -> list[str]:
    """Compare the LRHS (h, w, 3), repaired, over the grid, with the HRLS averaged down to it.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: one of the two is black (a wrong pass, most likely) and the other is not.
    """
    low = luminance(lr_rgb)
    averages = _averaged(hr, pairing)
    high = averages[RGB]
    if not low.any() and not high.any():
        return ["both renders are black (or NaN) everywhere: the result is black"]
    for name, values, other in ((lr_name, low, hr.name), (hr.name, high, lr_name)):
        if not values.any():
            raise InputError(
                f"{name}: the beauty is black (or NaN) everywhere, while that of {other} is not; "
                "check which layer it is (--map rgb=LAYER)"
            )
    warnings = []
    shift = in_background(lambda: _shift(low, high))  # takes as long as all else
    ratio, certain = _ratio(low, high)
    if not 1 / EXPOSURE_RATIO < ratio < EXPOSURE_RATIO and certain:
        warnings.append(f"the HRLS is {ratio:.3g} times as bright as the LRHS: are exposure and view layer the same?")
    correlation = _correlation(low, high)
    if correlation < LOW_CORRELATION:
        warnings.append(
            f"the two renders hardly look alike (correlation {correlation:.2f}): are they the same frame and camera?"
        )
        return warnings
    if ALBEDO in averages and _albedo_correlation(low + high, averages[ALBEDO]) < ALBEDO_CORRELATION:
        warnings.append(
            "the albedo's edges are not in the picture: is it this frame's albedo? (--map albedo=LAYER says which)"
        )
    scale, grid = pairing.scale, pairing.grid
    x, y = shift() * scale
    if max(abs(x), abs(y)) > max(SHIFT, 0.2 * scale):
        warnings.append(
            f"the HRLS's picture lies {abs(x):.1f} pixels {'right' if x > 0 else 'left'} of and {abs(y):.1f} pixels "
            f"{'below' if y > 0 else 'above'} the LRHS's: are camera, crop and overscan the same?"
        )
    if not warnings and (place := _differing(low, high)) is not None:
        x, y = (start + scale * at for start, at in zip((grid.x0 * scale, grid.y0 * scale), place, strict=True))
        warnings.append(
            f"the two renders show different things, most of all around HRLS pixel ({x}, {y}): are they "
            "the same frame, with the same lights and objects?"
        )
    return warnings


def _averaged(hr: ReadableRender, pairing: Alignment) -> dict[str, Array]:
    """Luminance of the HRLS's colour and, if it is there, albedo, averaged over each pixel of the grid."""
    s, grid = pairing.scale, pairing.grid
    rows: dict[str, list[Array]] = {}
    for y0 in range(grid.y0, grid.y1, BAND):
        want = Window(grid.x0 * s, y0 * s, grid.x1 * s, min(y0 + BAND, grid.y1) * s)
        layers = read_features(hr, want, pairing.hr_data, features=[RGB, ALBEDO])
        for name, values in layers.items():
            rows.setdefault(name, []).append(luminance(box_downsample(values, s)))
    return {name: np.concatenate(parts) for name, parts in rows.items()}


def _albedo_correlation(picture: Array, albedo: Array) -> float:
    """How far the steps of log luminance follow those of the log albedo, where that has edges; 1 where it has few.

    What has no albedo is sky, a light or a mirror, and its edges say nothing.
    """
    surface = np.where(albedo > 0.01, np.clip(albedo, 0, 1), np.nan)
    logs = np.log(picture + 0.1 * np.median(picture[picture > 0]) + 1e-20), np.log(surface + 0.05)
    lights, edges = (np.concatenate([np.diff(v, axis=axis).ravel() for axis in (0, 1)]) for v in logs)
    steep = np.abs(edges) > ALBEDO_EDGE
    if steep.sum() < ALBEDO_EDGES:
        return 1.0
    lights, edges = np.clip(lights[steep], -2, 2), edges[steep]
    return float((lights * edges).sum() / np.sqrt(np.square(lights).sum() * np.square(edges).sum() + 1e-20))


def _correlation(a: Array, b: Array) -> float:
    """Pearson correlation of log luminance on blocks of 4 x 4: noise averages out, framing stays."""
    height, width = (a.shape[0] // 4) * 4, (a.shape[1] // 4) * 4
    if height < 16 or width < 16:
        return 1.0
    blocks = [_quarter(v) for v in (a, b)]
    logs = [np.log(v + 1e-3 * v.mean() + 1e-20).ravel() for v in blocks]
    if min(v.std() for v in logs) < 1e-3:
        return 1.0  # a flat frame has no framing to compare
    return float(np.corrcoef(*logs)[0, 1])


def _ratio(low: Array, high: Array) -> tuple[float, bool]:
    """How many times as bright the HRLS is, and whether that is more than noise."""
    # Fireflies rule a plain mean: compare where neither is among the brightest percent of what is lit.
    lit = (low > 0) | (high > 0)
    plain = lit & (low <= np.quantile(low[lit], 0.99)) & (high <= np.quantile(high[lit], 0.99))
    sums = [np.array([block.sum(dtype=np.float64) for block in _blocks(v * plain)]) + 1e-30 for v in (low, high)]
    ratio = np.log(sums[1].sum() / sums[0].sum())
    without = [values.sum() - values for values in sums]
    error = _jackknife(np.log(np.maximum(without[1], 1e-30) / np.maximum(without[0], 1e-30)))
    return float(np.exp(ratio)), bool(abs(ratio) > CERTAIN * error)


def _shift(low: Array, high: Array) -> NDArray[np.float64]:
    """How far the HRLS's picture lies to the right of and below the LRHS's, in LRHS pixels, (2,).

    Zero along an axis where it is not certain. Lucas and Kanade's method, coarse to fine: the shift whose first-order
    effect on the LRHS explains the difference best, beside a gain and an offset. The gradients are the LRHS's, so noise
    of the HRLS makes the estimate vary and does not bend it.
    """
    nothing = np.zeros(2)
    if min(low.shape) < 8 * BLOCKS:
        return nothing
    rows, columns = (slice(max(0, n - MIDDLE) // 2, (n + MIDDLE) // 2) for n in low.shape)
    grey = np.median(low[low > 0]) if low.any() else 1.0
    # Between 0 and 1: neither fireflies nor black pixels rule.
    low, high = (_smoothed(v[rows, columns] / (v[rows, columns] + grey)) for v in (low, high))
    far = 4 * _fit(_smoothed(_quarter(low)), _smoothed(_quarter(high)), nothing).shift
    # From a start half a pixel away, the same would be found again
    starts = [nothing] if np.abs(far).max() < 0.5 else [nothing, np.clip(far, -12, 12)]
    fit = min((_fit(low, high, start) for start in starts), key=lambda fit: fit.residual)
    if fit.correlation < SHIFT_CORRELATION:
        return nothing
    return np.where(np.abs(fit.shift) > CERTAIN * fit.error, fit.shift, 0)


def _differing(low: Array, high: Array) -> tuple[int, int] | None:
    """Where (x, y), in LRHS pixels, the two pictures differ by what noise does not explain; None if nowhere.

    A paired t-test a block: what both pictures show cancels, and a single firefly of any size has a t of about 1.
    """
    floor = 0.05 * np.median(low + high)
    for size, certain in PLACES.items():
        height, width = (n // size for n in low.shape)
        if height == 0 or width == 0:
            continue
        one, other = (
            v[: height * size, : width * size]
            .reshape(height, size, width, size)
            .swapaxes(1, 2)
            .reshape(height, width, -1)
            for v in (low.astype(np.float64), high.astype(np.float64))  # the square of a firefly
        )
        brightness = (one + other).mean(axis=-1) / 2
        difference = np.abs((one - other).mean(axis=-1))
        # Two percent are nothing, even between renders without any noise
        error = (one - other).std(axis=-1) / size + 0.02 * brightness
        t = np.where(difference > DIFFERENCE * (brightness + floor), difference / np.maximum(error, 1e-30), 0)
        if t.max() > certain:
            y, x = np.unravel_index(t.argmax(), t.shape)
            return int(x * size + size // 2), int(y * size + size // 2)
    return None


class _Fit(NamedTuple):
    shift: NDArray[np.float64]
    error: NDArray[np.float64]
    residual: float
    correlation: float


def _fit(low: Array, high: Array, start: NDArray[np.float64]) -> _Fit:
    """Refine a shift (x, y): least squares over shift, gain and offset, repeated with the LRHS moved."""
    shift = start
    for _ in range(6):
        margin = int(np.abs(shift).max()) + 3
        inner = slice(margin, -margin)
        moved = _moved(low, shift)
        gy, gx = np.gradient(moved)
        planes = np.stack([-gx, -gy, moved, np.ones_like(moved), high - moved])[:, inner, inner]
        # Of each block, the products of all planes with all; in double precision, for they are nearly the same plane
        blocks = (block.reshape(len(planes), -1).astype(np.float64) for block in _blocks(planes))
        dots = np.stack([block @ block.T for block in blocks])
        squares, products = dots[:, :4, :4], dots[:, :4, 4]
        total = squares.sum(0) + 1e-9 * squares.sum(0).trace() * np.eye(4)  # solvable without any gradient, too
        step = np.linalg.solve(total, products.sum(0))
        shift = np.clip(shift + np.clip(step[:2], -1, 1), -min(low.shape) / 4, min(low.shape) / 4)
        if np.abs(step[:2]).max() < 0.01:
            break
    without = np.linalg.solve(total - squares, (products.sum(0) - products)[..., None])[:, :2, 0]
    residual = float(dots[:, 4, 4].sum() - step @ products.sum(0)) / planes[0].size
    spread = float(moved[inner, inner].std() * high[inner, inner].std())
    covariance = float(np.mean((moved - moved[inner, inner].mean())[inner, inner] * high[inner, inner]))
    return _Fit(shift, _jackknife(without), residual, covariance / max(spread, 1e-12))


def _blocks(values: Array) -> list[Array]:
    """Of planes (..., h, w)."""
    return [block for rows in np.array_split(values, BLOCKS, -2) for block in np.array_split(rows, BLOCKS, -1)]


def _jackknife(without: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error of an estimate, from the estimates without each of the blocks, (BLOCKS * BLOCKS, ...)."""
    return np.sqrt((len(without) - 1) * without.var(axis=0))


def _moved(values: Array, shift: NDArray[np.float64]) -> Array:
    """A picture moved by (x, y) to the right and down; its edge goes on."""
    for axis, by in ((1, shift[0]), (0, shift[1])):
        size = values.shape[axis]
        position = np.clip(np.arange(size) - by, 0, size - 1)
        before = position.astype(np.int64)
        share = np.asarray(position - before, np.float32).reshape((-1, 1) if axis == 0 else (1, -1))
        after = values.take(np.minimum(before + 1, size - 1), axis)
        values = values.take(before, axis) * (1 - share) + after * share
    return values


def _smoothed(values: Array) -> Array:
    """Binomial filter of 5 x 5 pixels."""
    for axis in (0, 1, 0, 1):
        size = values.shape[axis]
        padded = np.pad(values, [(1, 1) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        around: Array = padded.take(range(size), axis) + padded.take(range(2, size + 2), axis)
        values = (around + 2 * values) / np.float32(4)
    return values


def _quarter(values: Array) -> Array:
    """Mean of 4 x 4 pixels."""
    height, width = (n // 4 for n in values.shape)
    return box_downsample(values[: height * 4, : width * 4], 4)
