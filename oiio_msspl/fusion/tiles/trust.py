# SPDX-License-Identifier: Apache-2.0
"""Gives back what both renders show and the network has removed.

Both renders are independent, so their difference is noise alone. Where the picture differs from a render by more than
that noise, a part of the difference is put back: as much as James and Stein's estimator keeps, after a test of
significance (Gu et al. 2022, *Neural James-Stein Combiner*, here without a network; Firmino et al. 2022, *Progressive
Denoising of Monte Carlo Rendered Images*). ``docs/design/trust.md`` has the steps.
"""

from __future__ import annotations

from functools import partial, reduce

import numpy as np

from oiio_msspl.image.arrays import Array, Mask, planes_of
from oiio_msspl.image.filters import blurred, box_downsample, halved, max_around, means_around, upsample_linear
from oiio_msspl.image.parallel import in_parallel, two_at_a_time

#: Reach of the windows in which energies are compared, in cells of each level; and how many levels there are: of cells
#: of 1, 2 and 4 LRHS pixels. Large windows find faint detail, small ones find where it ends. They hold fewer pixels,
#: but also fewer kinds of noise.
WINDOW, LEVELS = 4, 3
#: The t up to which a difference is taken for noise, and the one that leaves no doubt.
DOUBTFUL, CERTAIN = np.float32(3), np.float32(5)
#: Exposed radiance that is added to the local brightness, so that dark noise does not count as much as light.
DARKEST = 0.02
#: Squared difference relative to the local brightness, and to s^2, that counts at most: a firefly is one pixel.
LARGEST = 16.0
#: A pixel is judged by itself where the renders agree on this share of all brighter differences around: scattered
#: points. On fireflies they agree nowhere. It is also judged where its energy is this many times the largest noise
#: around: a lamp alone.
AGREED, ALONE = (0.3, 0.6), 16.0
#: Squared relative difference of an LRHS pixel that is too small for a point, and the sum of those without agreement
#: that counts as well: a few points may agree by chance. ``AROUND`` is how far "around" reaches, in LRHS pixels.
POINT, DOUBT, AROUND = 0.1, 32.0, 15
#: Share of the pixels of a window that are darker than the picture if light may be missing.
MOSTLY = 0.6
#: Noise counts this many times where a pixel is judged by itself.
PIXEL = 4.0
#: Largest exposed radiance that is weighed.
BRIGHTEST = np.float32(1e6)
#: Error of a half float, relative to its value.
ROUNDING = 2.0**-12
#: Reach of the windows of the light's correction, in cells of each level, and its largest factor. The smallest cells
#: have this side in HRLS pixels, unless LRHS pixels are larger.
LIGHT_REACH, LARGEST_FACTOR, CELL = 3, 2.0, 4
#: A pixel of a render does not count for the light around it where the other render is brighter than the picture by
#: this many times the local brightness: a lamp that the network has removed.
LAMP = 1.0


def trust_renders(
    fused: Array, lrhs: Array, hrls: Array, *, share: float, exposure: float, reach: int, correct_light: bool = True
) -> tuple[Array, Array]:
    """Put back detail and light that both renders show.

    Detail is taken from the HRLS, or from the mean of two renders of one size.

    Args:
        fused: the network's picture (s*h, s*w, c), scene linear.
        lrhs, hrls: both renders of the tile, (h, w, c) and (s*h, s*w, c), scene linear, without fireflies.
        share: of the LRHS in the mean of both renders that has the least noise.
        exposure: factor that brings the scene to a log-mean luminance of mid-grey.
        reach: the largest distance, in LRHS pixels, over which a pixel may depend on others.
        correct_light: False for the halves of one render, which say nothing of the light around a rare sample.

    Returns:
        The picture (s*h, s*w, c), >= 0, and how much of the HRLS's difference was put back, (h, w) in [0, 1].
    """
    scale = len(hrls) // len(lrhs)
    render = planes_of(hrls if scale > 1 else hrls + np.float32(share) * (lrhs - hrls))
    # Evidence is weighed at the LRHS's resolution, in exposed units, in which squares neither overflow nor vanish.
    low, high, own = (
        _exposed(planes_of(box_downsample(image, factor)), exposure)
        for image, factor in ((lrhs, 1), (hrls, scale), (fused, scale))
    )
    picture = planes_of(fused).copy()
    if correct_light:
        light = list(zip(own, low, high, strict=True))
        factors = two_at_a_time(lambda planes: _light_factor(*planes, share, scale, reach), light)
        own *= np.stack(factors)
        for plane, factor in zip(picture, factors, strict=True):
            plane *= upsample_linear(factor, scale)
    # For d = LRHS - mean of the HRLS, E d^2 share s^2 is the variance of an HRLS pixel. At scale 1, the variance of
    # the mean of both renders is E d^2 share (1 - share). Both renders are rounded to half floats.
    variance = np.float32(share * (scale**2 if scale > 1 else 1 - share))
    rounding = np.float32(2 * ROUNDING**2) * np.square(np.maximum(low, high))
    noise = variance * (np.square(low - high) + rounding).sum(axis=0)
    # ``change`` is the squared difference to the render that is put back, ``energy`` the same at its own resolution,
    # ``noise`` what noise explains of that, and ``common`` the product of the differences to both renders.
    best = high if scale > 1 else _exposed(render, exposure)
    darker = (best - own).sum(axis=0) < 0
    common = ((low - own) * (high - own)).sum(axis=0)
    energy = change = np.square(best - own).sum(axis=0)
    if scale > 1:
        differences = two_at_a_time(lambda i: _exposed(render[i] - picture[i], exposure), range(len(render)))
        energy = box_downsample(reduce(np.add, map(np.square, differences)), scale)
    relative = len(own) * np.square(_brightness(own.mean(axis=0)))
    energy, noise, common, change = (values / relative for values in (energy, noise, common, change))
    evidence = energy, noise, common, change, darker, scale, reach
    areas, points = in_parallel(partial(_trust_in_areas, *evidence), partial(_trust_in_points, *evidence))
    trust = np.maximum(areas, points)
    # Points are whole LRHS pixels; between areas, trust is interpolated.
    weight = np.maximum(upsample_linear(trust, scale), points.repeat(scale, axis=0).repeat(scale, axis=1))
    for plane, pixels in zip(picture, render, strict=True):
        plane += weight * (pixels - plane)
    return np.moveaxis(picture, 0, -1), trust


def _exposed(values: Array, exposure: float) -> Array:
    """Return radiance times the exposure, limited to ``BRIGHTEST``."""
    with np.errstate(over="ignore"):
        return np.clip(values * np.float32(exposure), -BRIGHTEST, BRIGHTEST)


def _trust_in_areas(
    energy: Array, noise: Array, common: Array, change: Array, darker: Mask, scale: int, reach: int
) -> Array:
    """Return how much of a difference is detail by the means of windows, (h, w) in [0, 1]."""
    most, largest = np.float32(LARGEST * scale**2), np.float32(LARGEST)
    energy, least = np.minimum(energy, most), np.minimum(noise, most)
    common, change = np.clip(common, -largest, largest), np.minimum(change, largest)
    lit: Array = np.where(darker, np.minimum(common, np.float32(0)), common)
    squares, share = (np.square(energy) + np.square(least), common * common), darker.astype(np.float32)
    planes = [energy, least, common, change, lit, *squares, share, noise]
    trust, _ = _trust_in_windows(planes, min(_levels(WINDOW, reach), LEVELS))
    return trust


def _trust_in_windows(values: list[Array], levels: int, cells: int = 1) -> tuple[Array, Array]:
    """Return the trust (h, w) by windows of ``cells`` LRHS pixels a cell and larger ones, and the noise of these."""
    height, width = values[0].shape
    if levels > 1:
        larger = _trust_in_windows([halved(plane) for plane in values], levels - 1, 4 * cells)
        coarser, noise_around = (_enlarge(plane, height, width) for plane in larger)
    else:
        coarser, noise_around = np.zeros_like(values[0]), means_around(values[-1], WINDOW)
    means = two_at_a_time(lambda plane: means_around(plane, WINDOW), values[:-1])
    energy, noise, common, change, lit, squares, squares_of_both, darker = means
    # Windows that lack rare light lack its noise, too, and both renders agree that they are dark. So a darker one has
    # the noise of all around, and also needs brighter pixels on which the renders agree.
    dark, count = darker > MOSTLY, cells * (2 * WINDOW + 1) ** 2
    noise = np.where(dark, np.maximum(noise, noise_around), noise)
    least = np.where(dark, np.minimum(common, lit), common)
    part = np.maximum(
        _certainty(energy - noise, squares, count) * _kept(energy, noise),
        _certainty(least, squares_of_both, count) * _kept(change, change - common),
    )
    return np.maximum(coarser, means_around(part, WINDOW)), noise_around


def _trust_in_points(
    energy: Array, noise: Array, common: Array, change: Array, darker: Mask, scale: int, reach: int
) -> Array:
    """Return how much of a difference is detail pixel by pixel, (h, w) in [0, 1]."""
    size, zero = min(AROUND, reach // 2), np.float32(0)
    is_point = change > np.float32(POINT)
    light, brighter = np.where(darker, zero, energy), np.where(is_point & ~darker, change, zero)
    # A product counts no more than the change of the HRLS, or a firefly of the LRHS would outweigh all pixels around.
    # At scale 1, the change is that of the mean of both renders. It is small where these disagree, which must count.
    # Most pixels with little noise are brighter than the mean in both renders, and so agree by chance. Where one of
    # them is dark they disagree. So darker pixels can only count against.
    least = change if scale > 1 else np.maximum(change, np.float32(LARGEST))
    common = np.clip(common, -least, brighter)
    weight = 1 / np.maximum(change / np.float32(LARGEST), 1)
    agreed, total = (means_around(weight * values, size) for values in (common, brighter))
    share = agreed / (total + np.float32(DOUBT / (2 * size + 1) ** 2))
    scattered = np.clip((share - AGREED[0]) / (AGREED[1] - AGREED[0]), 0, 1)
    alone = _kept(light, np.float32(ALONE) * max_around(noise, size))
    return is_point * np.maximum(scattered, alone).astype(np.float32) * _kept(energy, np.float32(PIXEL) * noise)


def _levels(window: int, reach: int) -> int:
    """Return how many levels see pixels within ``reach``: each averages twice over windows of twice the size."""
    return max(1, (reach // (2 * window)).bit_length())


def _certainty(excess: Array, squares: Array, count: int) -> Array:
    """Return how certain the mean of ``count`` values exceeds 0, from 0 to 1, given the mean of their squares."""
    error = np.sqrt(np.maximum(squares, 0) / np.float32(count))
    t = excess / np.maximum(error, np.float32(1e-12))
    return np.clip((t - DOUBTFUL) / (CERTAIN - DOUBTFUL), 0, 1)


def _kept(energy: Array, noise: Array) -> Array:
    """Return the factor ``1 - noise / energy`` of James and Stein, in [0, 1]."""
    return np.clip((energy - noise) / np.maximum(energy, np.float32(1e-12)), 0, 1)


def _brightness(mean: Array) -> Array:
    """Return the local brightness (h, w) of a picture at the LRHS's resolution."""
    return blurred(mean, 2) + np.float32(DARKEST)


def _light_factor(own: Array, lrhs: Array, mean: Array, share: float, scale: int, reach: int) -> Array:
    """Return the factor (h, w) that gives a picture the light of both renders where they agree that it differs."""
    brightness = _brightness(own)
    low, high = (lrhs - own) / brightness, (mean - own) / brightness
    # Chosen by the other render, or rare light would lose the samples that both have found.
    in_low, in_high = low > LAMP, high > LAMP
    low[in_high] = high[in_low] = 0
    cell = 1
    while cell * scale < CELL:
        low, high, cell = halved(low), halved(high), 2 * cell
    height, width = own.shape
    agreed = _agreed(low, high, np.float32(share), _levels(LIGHT_REACH * cell, reach))
    agreed = upsample_linear(agreed, cell)[:height, :width]
    change = brightness * agreed / np.maximum(own, 0.01 * brightness)
    return np.clip(1 + change, 1 / LARGEST_FACTOR, LARGEST_FACTOR).astype(np.float32)


def _agreed(low: Array, high: Array, share: np.float32, levels: int) -> Array:
    """Return what two noisy differences (h, w) agree on, level by level (a Laplacian pyramid)."""
    height, width = low.shape
    coarser = np.zeros_like(low)
    if levels > 1 and min(height, width) >= 8:
        half_low, half_high = halved(low), halved(high)
        coarser = _enlarge(_agreed(half_low, half_high, share, levels - 1), height, width)
        low, high = low - _enlarge(half_low, height, width), high - _enlarge(half_high, height, width)
    mean = high + share * (low - high)
    most = np.float32(LARGEST)
    product = low * high
    # Over four times the reach, in cells of twice the size.
    squares_around = _enlarge(means_around(halved(np.square(product)), 2 * LIGHT_REACH), height, width)
    product = np.clip(product, -most, most)
    planes = product, product * product, mean * mean
    common, squares, energy = (means_around(plane, LIGHT_REACH) for plane in planes)
    # Most windows lack rare light.
    squares = np.where(mean < 0, np.maximum(squares, squares_around), squares)
    shrink = _certainty(common, squares, (2 * LIGHT_REACH + 1) ** 2) * _kept(energy, energy - common)
    return mean * means_around(shrink, LIGHT_REACH) + coarser


def _enlarge(half: Array, height: int, width: int) -> Array:
    """Return a plane at twice its resolution, without the row or column that made its size even."""
    return upsample_linear(half, 2)[:height, :width]
