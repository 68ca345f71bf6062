# SPDX-License-Identifier: Apache-2.0
"""Checks whether two renders show the same frame, at the LRHS's resolution.

`research.benchmarks.pair_checks` measures how many wrong pairs each check finds, and how many right pairs it doubts.
"""

from __future__ import annotations

import itertools
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import ReadableRender, Window
from oiio_msspl.fusion.checks.colours import different_colours
from oiio_msspl.fusion.checks.edges import foreign_aovs
from oiio_msspl.fusion.checks.framing import central_slices, find_framing, jackknife_error, parts
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.features import TileFeatures, in_hrls_pixels, read_lrhs, read_tile
from oiio_msspl.fusion.tiles.tiling import Tile
from oiio_msspl.image.arrays import Array, planes_of, quantile
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import for_row_blocks, in_background
from oiio_msspl.model.contract import ONE_SIZE

#: Two renders hardly show the same frame if the correlation of their log luminance is below this. Matching pairs with
#: clean references reach 0.83 to 0.99, one lit almost only by fireflies 0.31, different scenes -0.2 to 0.25.
LOW_CORRELATION = 0.3
#: Exposures differ if the ratio of the mean luminances, without the brightest percent, exceeds this. Matching pairs
#: reach 1.21.
EXPOSURE_RATIO = 4 / 3
#: Framings differ if the shift exceeds the first number in HRLS pixels and the second one in LRHS pixels. The paper's
#: nearest-neighbour LRHS is half a pixel off.
MAX_SHIFT = (0.75, 0.5)
#: Framings also differ if the zoom moves the edge of the frame by more LRHS pixels than this.
MAX_ZOOM_AT_EDGE = 0.8
#: A difference of exposure must be this many standard errors from none.
CERTAIN = 6.0
#: Brighter pixels are clipped to this, because sums of squares over a frame would overflow float32.
BRIGHTEST = np.float32(1e15)
#: Groups of blocks that show different things: side of a block in LRHS pixels, blocks along each side of the group, and
#: the mean of t^2 above which the group differs. Groups of matching views reach 12.9, 8.2 and 9.8.
BLOCK_GROUPS = ((4, 2, 16.0), (4, 3, 11.0), (8, 2, 12.0))
#: Largest t of a single block.
LARGEST_T = 6.0
#: Pixel filters of different widths move light across edges, so this fraction of a block's contrast is no difference.
FILTER_FRACTION = 0.1
#: Side of the blocks, in LRHS pixels, over which noise and colours are summed.
BLOCK = 4
#: The LRHS has the noise of the HRLS if, in three of four blocks, they differ by less than this fraction of the HRLS's
#: noise. Independent renders differ by the noise of both, so by more than 1.
SAME_NOISE = 0.75
#: Both renders are equal in a block if they differ by this fraction of its brightness, RMS. Independent renders of
#: thousands of spp differ by more.
EQUAL = 0.002
#: A block has noise if its RMS is this fraction of the block's brightness.
NOISY = 0.01
#: Noise is not compared if there are fewer noisy blocks.
MIN_NOISY_BLOCKS = 64
#: The LRHS consists of HRLS pixels if this fraction of its noisy pixels equal an HRLS pixel.
EQUAL_PIXELS = 0.5
#: A render may be black by chance if at most this many pixels of the other render are lit. Around a rectangle, this
#: fraction of the pixels may be lit as well.
MOST_BY_CHANCE, REGION = 64, 0.05
#: The warning for a pair that is black.
BOTH_BLACK = "both renders are black (or NaN) everywhere: the result is black"
#: Pixels of the HRLS that :func:`check_renders` reads at a time.
PIXELS_PER_READ = 1024 * 1024


class HrlsAverages:
    """The HRLS at the LRHS's resolution, and its difference to the LRHS; filled tile by tile.

    Attributes:
        rgb: luminance (h, w) over the grid of the alignment.
        albedo: luminance over the central area of the grid, where edges are compared; None if the HRLS has none.
        normal_edges: length of the difference of the normals to the next pixels, over the same area, or None.
        normal_noise: root mean square of that difference if the normals were constant, by their noise, or None.
        blocks: sums over blocks of `BLOCK` pixels, (rows, columns, 10): the LRHS's RGB, the HRLS's RGB, the squared
            difference of luminance, that which the noise of the HRLS explains, and the numbers of LRHS pixels over
            which the HRLS is noisy, and of those among them that equal an HRLS pixel.
        is_lost: the HRLS's beauty is NaN in all tiles, so its averages are those of the LRHS.
    """

    def __init__(self, alignment: Alignment) -> None:
        self.alignment = alignment
        grid = alignment.grid
        self.rgb = np.zeros((grid.height, grid.width), np.float32)
        rows, columns = central_slices(self.rgb.shape)
        self._centre = Window(columns.start, rows.start, columns.stop, rows.stop).shift(grid.x0, grid.y0)
        self.albedo: Array | None = None
        self.normal_edges: Array | None = None
        self.normal_noise: Array | None = None
        self.blocks = np.zeros((-(-self.rgb.shape[0] // BLOCK), -(-self.rgb.shape[1] // BLOCK), 10))
        self.is_lost = True

    def add(self, pair: TileFeatures) -> None:
        """Add the core of a tile."""
        self.is_lost &= pair.hrls_is_lost
        rows, columns = pair.core
        area, grid = pair.lrhs_area, self.alignment.grid
        core = Window(columns.start, rows.start, columns.stop, rows.stop).shift(area.x0, area.y0)
        self._add_beauty(pair.lrhs[RGB][pair.core], _hrls_pixels(pair, RGB, core), core.shift(-grid.x0, -grid.y0))
        centre = core.intersect(self._centre)
        if centre.width and centre.height:
            self._add_aovs(pair, centre)

    def _add_aovs(self, pair: TileFeatures, window: Window) -> None:
        """Fill ``albedo`` and ``normal_edges`` over a part of the central area."""
        target, size = window.slices(self._centre), (self._centre.height, self._centre.width)
        if ALBEDO in pair.hrls:
            if self.albedo is None:
                self.albedo = np.zeros(size, np.float32)
            self.albedo[target] = luminance(box_downsample(_hrls_pixels(pair, ALBEDO, window), pair.scale))
        if NORMAL in pair.hrls:
            if self.normal_edges is None or self.normal_noise is None:
                self.normal_edges, self.normal_noise = np.zeros(size, np.float32), np.zeros(size, np.float32)
            pixels = _hrls_pixels(pair, NORMAL, window)
            self.normal_noise[target] = _noise_of_edges(pixels, pair.scale)
            self.normal_edges[target] = _edge_lengths(box_downsample(pixels, pair.scale))

    def _add_beauty(self, low: Array, high: Array, place: Window) -> None:
        """Fill ``rgb`` and sum ``blocks``, given the colours (h, w, 3) and (s*h, s*w, 3) of a ``place`` in the grid."""
        scale = self.alignment.scale
        phases = list(itertools.product(range(scale), repeat=2))
        averages = self.rgb[place.y0 : place.y1, place.x0 : place.x1]
        values = np.empty((10, *low.shape[:2]), np.float32)

        def work(rows: slice) -> None:
            colour = np.minimum(low[rows], BRIGHTEST)
            samples = np.minimum(high[rows.start * scale : rows.stop * scale], BRIGHTEST)
            mean = box_downsample(samples, scale)
            averages[rows] = luminance(mean)
            pixels, grey = luminance(samples), luminance(colour)
            expected = _noise_variance(pixels, scale) / np.float32(scale**2)
            # Black pixels are equal in any two renders where light is rare.
            noisy = (grey > 0) & (expected > np.square(np.float32(5 * NOISY) * grey))
            nearest = reduce(np.minimum, (np.abs(pixels[i::scale, j::scale] - grey) for i, j in phases))
            values[:3, rows], values[3:6, rows] = planes_of(colour), planes_of(mean)
            values[6, rows], values[7, rows] = np.square(averages[rows] - grey), expected
            values[8, rows], values[9, rows] = noisy, noisy & (nearest <= 1e-3 * grey)

        for_row_blocks(work, len(low), high[0].size * scale)
        sums: NDArray[Any] = values
        for axis, (start, stop) in ((1, (place.y0, place.y1)), (2, (place.x0, place.x1))):
            first = np.maximum(np.arange(start // BLOCK * BLOCK, stop, BLOCK) - start, 0)
            sums = np.add.reduceat(sums, first, axis).astype(np.float64)
        top, left = place.y0 // BLOCK, place.x0 // BLOCK
        self.blocks[top : top + sums.shape[1], left : left + sums.shape[2]] += sums.transpose(1, 2, 0)


def _edge_lengths(normal: Array) -> Array:
    """Return the length of the difference of normals (h, w, 3) to the next pixels, to the right and down, (h, w)."""
    squares = np.zeros(normal.shape[:2], np.float32)
    for plane in planes_of(normal):
        squares[:-1] += np.square(np.diff(plane, axis=0))
        squares[:, :-1] += np.square(np.diff(plane, axis=1))
    return np.sqrt(squares)


def _noise_of_edges(pixels: Array, scale: int) -> Array:
    """Return :func:`_edge_lengths` of constant normals with the noise of the HRLS's (s*h, s*w, 3), RMS, (h, w)."""
    variance = reduce(np.add, planes_of(_noise_variance(pixels, scale)))
    # Means over scale x scale pixels, in two differences of two of them each.
    noise: Array = np.sqrt(variance) * np.float32(2 / scale)
    return noise


def _noise_variance(pixels: Array, scale: int) -> Array:
    """Estimate the variance of noise (h, w, ...) of the HRLS's pixels (s*h, s*w, ...) from 2 x 2 pixels each."""
    # Gradients and straight edges cancel out of a diagonal difference. Its variance is four times that of the noise.
    if scale == ONE_SIZE:  # each pixel, with those to the right and below
        pixels = np.pad(pixels, [(0, 1), (0, 1), *[(0, 0)] * (pixels.ndim - 2)], mode="edge")
        a, b, c, d = (pixels[i : len(pixels) - 1 + i, j : pixels.shape[1] - 1 + j] for i in (0, 1) for j in (0, 1))
    else:
        a, b, c, d = (pixels[i::2, j::2] for i in (0, 1) for j in (0, 1))
    variance: Array = np.square(a - b - c + d) / np.float32(4)
    return box_downsample(variance, scale // 2) if scale > 2 else variance


def _hrls_pixels(pair: TileFeatures, feature: str, window: Window) -> Array:
    """Return a feature of the HRLS over a window of LRHS pixels inside the tile."""
    return pair.hrls[feature][in_hrls_pixels(window, pair.scale).slices(pair.hrls_area)]


def check_renders(lr: ReadableRender, hr: ReadableRender) -> list[str]:
    """Check whether two renders show the same frame, without fusing them. Return warnings of :func:`check_pair`.

    Raises:
        InputError: the pair does not fit together, or can't be read.
    """
    alignment = align(lr, hr)
    grid = alignment.grid
    lrhs = read_lrhs(lr, alignment, grid, [RGB])
    averages = HrlsAverages(alignment)
    for band in grid.bands(max(1, PIXELS_PER_READ // (grid.width * alignment.scale**2))):
        averages.add(read_tile(Tile(band, band), lrhs, grid, hr, alignment, [RGB, ALBEDO, NORMAL]))
    return check_pair(bounded_luminance(lrhs[RGB]), averages, lr.name, hr.name)


def bounded_luminance(rgb: Array) -> Array:
    """Return the luminance of repaired colours, at most `BRIGHTEST`: (..., 3) to (...)."""
    return np.minimum(luminance(rgb), BRIGHTEST)


def check_pair(low: Array, hrls: HrlsAverages, lr_name: str, hr_name: str) -> list[str]:
    """Check whether two renders show the same frame. Return warnings, one sentence each.

    Args:
        low: luminance of the LRHS (h, w) over the grid of the alignment, see :func:`bounded_luminance`.
        hrls: averages of all tiles.

    Raises:
        InputError: one render is black, most likely a wrong layer, and the other one is lit by more than chance. Or two
            renders of one size have the same noise, so that there is nothing to gain from the second one.
    """
    warnings = _find_doubts(low, hrls, lr_name, hr_name)
    if hrls.alignment.scale != ONE_SIZE:
        return warnings
    return [text.replace("LRHS", "first render").replace("HRLS", "second render") for text in warnings]


def _find_doubts(low: Array, hrls: HrlsAverages, lr_name: str, hr_name: str) -> list[str]:
    """Return the warnings of :func:`check_pair`, which call the renders LRHS and HRLS."""
    high, alignment = hrls.rgb, hrls.alignment
    if not low.any() and not high.any():
        return [BOTH_BLACK]
    if hrls.is_lost:
        raise _black_beauty(hr_name, lr_name)
    for black_name, black, lit_name, lit in ((lr_name, low, hr_name, high), (hr_name, high, lr_name, low)):
        if not black.any():
            if np.count_nonzero(lit) > min(MOST_BY_CHANCE, lit.size // 2):
                raise _black_beauty(black_name, lit_name)
            return []  # a dark frame in which few samples find the light
    warnings = [
        f"the {black_name} is black outside of a rectangle, where the {lit_name} is lit: was a render region on?"
        for black_name, black, lit_name, lit in (("HRLS", high, "LRHS", low), ("LRHS", low, "HRLS", high))
        if _is_region(black, lit)
    ]
    foreign = in_background(lambda: foreign_aovs(low, high, hrls.albedo, hrls.normal_edges, hrls.normal_noise))
    scale, places = alignment.scale, (low, high)
    if scale == ONE_SIZE and min(low.shape) > 1:  # means over 2 x 2 pixels have less noise than renders of full size
        height, width = (side // 2 * 2 for side in low.shape)
        scale, places = 2, (box_downsample(low[:height, :width], 2), box_downsample(high[:height, :width], 2))
    framing = in_background(lambda: find_framing(*places))
    if _has_same_noise(hrls):
        if alignment.scale == ONE_SIZE:
            raise InputError(f"{lr_name} and {hr_name} have the same noise; render each with a noise seed of its own")
        warnings.append(
            "the LRHS has the noise of the HRLS, so fusing can't remove it: an LRHS is rendered at the smaller size "
            "with more spp, and not made by scaling the HRLS down"
        )
    ratio, certain = _brightness_ratio(low, high)
    if not 1 / EXPOSURE_RATIO < ratio < EXPOSURE_RATIO and certain:
        warnings.append(f"the HRLS is {ratio:.3g} times as bright as the LRHS: are exposure and view layer the same?")
    correlation = _log_correlation(hrls)
    if correlation < LOW_CORRELATION:
        warnings.append(
            f"the two renders hardly look alike (correlation {correlation:.2f}): are they the same frame and camera?"
        )
        return warnings
    colours = different_colours(hrls.blocks[..., :3].reshape(-1, 3), hrls.blocks[..., 3:6].reshape(-1, 3))
    if colours is not None:
        warnings.append(f"{colours}: write both in the same colour space")
    warnings += [
        f"the {aov}'s edges are not in the picture: is it this frame's {aov}? (--map {aov}=LAYER says which)"
        for aov in foreign()
    ]
    grid, difference = alignment.grid, framing()
    x, y = difference.x * scale, difference.y * scale
    if max(abs(x), abs(y)) > max(MAX_SHIFT[0], MAX_SHIFT[1] * scale):
        warnings.append(
            f"the HRLS is shifted against the LRHS by {abs(x):.1f} pixels to the {'right' if x > 0 else 'left'} and "
            f"{abs(y):.1f} pixels {'down' if y > 0 else 'up'}: are camera, crop and overscan the same?"
        )
    if abs(difference.zoom_at_edge) > MAX_ZOOM_AT_EDGE:
        tighter = "HRLS" if difference.zoom > 0 else "LRHS"
        warnings.append(
            f"the {tighter} is framed {100 * abs(difference.zoom):.1f} % tighter than the other render: are focal "
            "length, crop and overscan the same?"
        )
    if not warnings and (place := _different_place(*places)) is not None:
        start = grid.x0 * alignment.scale, grid.y0 * alignment.scale
        x, y = (first + scale * at for first, at in zip(start, place, strict=True))
        warnings.append(
            f"the two renders show different things, most of all around HRLS pixel ({x}, {y}): are they "
            "the same frame, with the same lights and objects?"
        )
    return warnings


def _black_beauty(name: str, lit_name: str) -> InputError:
    return InputError(
        f"{name}: the beauty is black (or NaN) everywhere, while that of {lit_name} is not; "
        "check which layer it is (--map rgb=LAYER)"
    )


def _is_region(black: Array, lit: Array) -> bool:
    """Return whether a picture (h, w) is black around a rectangle where the second one is lit."""
    rows, columns = (np.flatnonzero(black.any(axis=axis)) for axis in (1, 0))
    outside = np.ones(black.shape, np.bool_)
    # The pixel filter of the other render may reach further.
    outside[max(rows[0] - 2, 0) : rows[-1] + 3, max(columns[0] - 2, 0) : columns[-1] + 3] = False
    lit_pixels = np.count_nonzero(lit[outside])
    return bool(lit_pixels > max(MOST_BY_CHANCE, REGION * np.count_nonzero(outside)))


def are_not_independent(hrls: HrlsAverages) -> bool:
    """Return whether the LRHS equals the means of the HRLS where the HRLS varies, so that it shows no noise."""
    brightness, difference, expected = hrls.blocks[..., :6].sum(axis=-1) / 6, hrls.blocks[..., 6], hrls.blocks[..., 7]
    varied = expected * BLOCK**2 > np.square(NOISY * brightness)
    equal = varied & (difference * BLOCK**2 < np.square(EQUAL * brightness))
    count = int(np.count_nonzero(varied))
    return count >= MIN_NOISY_BLOCKS and 4 * int(np.count_nonzero(equal)) > 3 * count


def _has_same_noise(hrls: HrlsAverages) -> bool:
    """Return whether the LRHS is the HRLS scaled down, by averaging pixels or by keeping some of them."""
    colours, difference, expected = hrls.blocks[..., :6], hrls.blocks[..., 6], hrls.blocks[..., 7]
    brightness = colours.sum(axis=-1) / 6
    noisy = expected * BLOCK**2 > np.square(NOISY * brightness)
    if int(np.count_nonzero(noisy)) < max(MIN_NOISY_BLOCKS, int(np.count_nonzero(brightness)) // 4):
        return False
    scaled_down = float(np.quantile(difference[noisy] / expected[noisy], 0.75)) < SAME_NOISE
    noisy_pixels, equal_pixels = hrls.blocks[..., 8:].sum(axis=(0, 1))
    return scaled_down or bool(equal_pixels > EQUAL_PIXELS * max(noisy_pixels, 1))


def _log_correlation(hrls: HrlsAverages) -> float:
    """Return the Pearson correlation of the log brightness of blocks: noise averages out, framing stays.

    It is 1 if the blocks of either render differ by little more than noise, so that there is no framing to compare.
    """
    low, high = hrls.blocks[..., :3].sum(axis=-1), hrls.blocks[..., 3:6].sum(axis=-1)
    logs = [np.log(v + 1e-3 * v.mean() + 1e-20).ravel() for v in (low, high)]
    noise = float(np.mean(9 * hrls.blocks[..., 7] / np.square(high + 1e-3 * high.mean() + 1e-20)))
    if low.size < MIN_NOISY_BLOCKS or min(v.var() for v in logs) < max(1e-6, 5 * noise):
        return 1.0
    return float(np.corrcoef(*logs)[0, 1])


def _brightness_ratio(low: Array, high: Array) -> tuple[float, bool]:
    """Return by which factor the HRLS is brighter, and whether that is more than noise."""
    # Fireflies dominate a plain mean, so pixels in the brightest percent of either render do not count.
    lit = (low > 0) | (high > 0)
    ordinary = lit & (low <= quantile(low[lit], 0.99)) & (high <= quantile(high[lit], 0.99))
    low_sums, high_sums = (
        np.array([part.sum(dtype=np.float64) for part in parts(v * ordinary)]) + 1e-30 for v in (low, high)
    )
    log_ratio = np.log(high_sums.sum() / low_sums.sum())
    without_part = [sums.sum() - sums for sums in (low_sums, high_sums)]
    error = jackknife_error(np.log(np.maximum(without_part[1], 1e-30) / np.maximum(without_part[0], 1e-30)))
    return float(np.exp(log_ratio)), bool(abs(log_ratio) > CERTAIN * error)


def _different_place(low: Array, high: Array) -> tuple[int, int] | None:
    """Return the place (x, y), in LRHS pixels, where the pictures differ by more than noise; None if there is none.

    Each block gets a paired t-test: the picture cancels out, and a single firefly has a t of about 1, however bright it
    is. The mean of t^2 over neighbouring blocks is 1 for noise. A thing that moved exceeds it, and also the median of
    the frame, which a difference of the whole frame raises.
    """
    floor = 0.05 * quantile((low + high).ravel(), 0.5)
    means = {size: _block_means(low, high, size) for size in {size for size, _, _ in BLOCK_GROUPS}}
    for size, side, different in BLOCK_GROUPS:
        if min(low.shape) < size * side:
            continue
        low_mean, high_mean, low_square, difference_square = means[size]
        difference = low_mean - high_mean
        deviation = np.sqrt(np.maximum(difference_square - np.square(difference), 0))
        contrast = np.sqrt(np.maximum(low_square - np.square(low_mean), 0))
        # Two percent of the brightness are no difference, even between renders without noise.
        unimportant = 0.02 * ((low_mean + high_mean) / 2 + floor)
        error = (deviation + FILTER_FRACTION * contrast) / size + unimportant
        t = np.minimum(np.abs(difference) / np.maximum(error, 1e-30), LARGEST_T)
        groups = np.lib.stride_tricks.sliding_window_view(np.square(t), (side, side))
        scores = groups.mean(axis=(-2, -1))
        if scores.max() > different * max(1.0, float(np.median(scores))):
            row, column = np.unravel_index(scores.argmax(), scores.shape)
            y, x = np.unravel_index(groups[row, column].argmax(), (side, side))
            return int((column + x) * size + size // 2), int((row + y) * size + size // 2)
    return None


def _block_means(low: Array, high: Array, size: int) -> NDArray[np.float64]:
    """Average blocks of size x size pixels: LRHS, HRLS, square of the LRHS and of the difference, 4 x (h/s, w/s).

    In double precision, because a squared firefly overflows float32. Incomplete blocks at the end are left out.
    """
    height, width = (n // size for n in low.shape)
    means = np.empty((4, height, width))

    def work(rows: slice) -> None:
        a, b = (v[rows, : width * size].astype(np.float64) for v in (low, high))
        for mean, values in zip(means, (a, b, np.square(a), np.square(a - b)), strict=True):
            row_sums = reduce(np.add, (values[y::size] for y in range(size)))
            sums = reduce(np.add, (row_sums[:, x::size] for x in range(size)))
            np.divide(sums, size**2, out=mean[rows.start // size : rows.stop // size])

    for_row_blocks(work, height * size, 4 * width * size, multiple=size)
    return means
