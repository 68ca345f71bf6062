# SPDX-License-Identifier: Apache-2.0
"""Guards around the network: it gets no fireflies, lights keep their brightness, and empty regions stay empty."""

from __future__ import annotations

from functools import reduce
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RADIANCE_FEATURES, RGB
from oiio_msspl.errors import MssplError
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.tiles.features import FIREFLY_FACTOR, TileFeatures
from oiio_msspl.image.arrays import FLOAT_MAX, Array, Mask, planes_of
from oiio_msspl.image.filters import all_within, box_downsample, max_around, means_around, neighbours
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.session import Session

T = TypeVar("T", bound=np.generic)

#: LRHS pixels on a side of the squares in which rare light is looked for, and the most of their pixels that it reaches.
_SQUARE, _RARE = 8, 0.25
#: A tile has no noise if its renders differ nowhere by more than this, log-encoded: half a code of an 8-bit picture.
NOISE_FREE = 1 / 512
#: Exposed radiance above which light that both renders show is taken from the HRLS. Noise is hardly ever so bright in
#: both: at a quarter of this, in one of 38 views.
LIGHT = 4096.0
#: Exposed radiance above which a light without noise keeps the pixels of the only render. It has no noise if all of
#: 3 x 3 pixels differ from the one in the middle by this share of it at most.
STEADY_LIGHT, STEADY = 4.0, 0.02
#: For the network, each channel of a pixel has at least this share of what the brightest channel has above ``BRIGHT``
#: (exposed radiance). Half of the share holds at ``DAZZLING`` above it, and less of it in darker light.
LEAST_CHANNEL, BRIGHT, DAZZLING = np.float32(0.1), 0.5, 9.0
#: How much was added to a channel is the mean of the pixels up to this number of rows and columns away. A channel of
#: which a larger share than ``PURE`` was added may have no light of its own.
PURE_REACH, PURE = 3, np.float32(0.94)
#: A surface becomes black if this many LRHS pixels around are black. Networks look as far.
FAR = 15
#: The same for a pass, in HRLS pixels: black passes are common, and a network leaves a trace of light in them.
LAYER_REACH = 16
#: HRLS pixels around an empty pixel that show no surface either. Thin smears have empty samples between them.
SMEAR = 8


def dim_fireflies(tile: TileFeatures) -> tuple[Array, dict[str, Array]]:
    """Limit each render's radiance by the other: return the LRHS's colour (h, w, 3), and the HRLS's features."""
    lrhs_rgb, hrls = tile.lrhs[RGB], tile.hrls
    lrhs_limit = _brightness_limit(box_downsample(hrls[RGB], tile.scale), tile)
    limit = _over_hrls(_brightness_limit(lrhs_rgb, tile))
    blocks = {name: _by_lrhs_pixel(hrls[name], tile.scale) for name in RADIANCE_FEATURES if name in hrls}
    dimmed = {name: np.minimum(values, limit).reshape(hrls[name].shape) for name, values in blocks.items()}
    return np.minimum(lrhs_rgb, lrhs_limit), hrls | dimmed


def without_pure_colours(rgb: Array, exposure: float) -> Array:
    """Return a colour (h, w, 3) in which no bright pixel lacks a channel; itself if none does.

    Networks make pure colours dark, such as the green of a laser: they keep as little as a fifth of its light.
    """
    least = _least_channel(rgb, exposure)
    return np.maximum(rgb, least) if (rgb < least).any() else rgb


def with_pure_colours(fused: Array, rgb: Array, mixed: Array, exposure: float) -> Array:
    """Return a fused picture (h, w, 3) without the light that :func:`without_pure_colours` has added.

    The network has made it of ``mixed``, the colour ``rgb`` of the HRLS with this light.
    """
    if mixed is rgb:
        return fused
    fused, least = fused.copy(), _least_channel(fused, exposure)[..., 0]
    bright = _least_channel(rgb, exposure)[..., 0] > 0
    for plane, pure, changed in zip(*(np.moveaxis(image, -1, 0) for image in (fused, rgb, mixed)), strict=True):
        differs = changed > pure
        if not differs.any():
            continue
        places = (np.flatnonzero(differs.any(axis=axis)) for axis in (1, 0))
        box = tuple(slice(max(used[0] - PURE_REACH, 0), used[-1] + PURE_REACH + 1) for used in places)
        weight = bright[box] / changed[box].max()  # sums of the largest floats would overflow
        own, light = (means_around(image[box] * weight, PURE_REACH) for image in (pure, changed))
        added = 1 - np.divide(own, light, out=np.ones_like(own), where=light > 0)
        # Pixels at the edge have light of what is beside them. Networks change the small channel, and mix it there.
        added = np.maximum(added, np.minimum(2 * added - PURE, 1))
        plane[box] *= 1 - added * np.clip(4 - plane[box] / np.maximum(least[box], np.float32(1e-30)), 0, 1)
    return fused


def _by_lrhs_pixel(hrls: Array, scale: int) -> Array:
    """Return HRLS pixels (s*h, s*w, c) by their LRHS pixel, (h, s, w, s, c)."""
    return hrls.reshape(len(hrls) // scale, scale, -1, scale, hrls.shape[-1])


def _over_hrls(lrhs: Array) -> Array:
    """Return LRHS pixels (h, w, c) as (h, 1, w, 1, c), in the memory layout of :func:`_by_lrhs_pixel`."""
    return np.moveaxis(planes_of(lrhs), 0, -1)[:, None, :, None]


def _least_channel(rgb: Array, exposure: float) -> Array:
    """Return what each channel of a pixel has at least for the network, (h, w, 1)."""
    bright, dazzling = (np.float32(min(value / exposure, FLOAT_MAX)) for value in (BRIGHT, DAZZLING))
    above = np.maximum(_brightest(rgb) - bright, 0)
    return LEAST_CHANNEL * above * (above / (above + dazzling))


def _brightest(rgb: Array) -> Array:
    """Return the brightest channel of each pixel of an image (h, w, 3), (h, w, 1)."""
    return reduce(np.maximum, (rgb[..., channel : channel + 1] for channel in range(3)))


def bright_lights(lrhs_rgb: Array, hrls_rgb: Array, exposure: float) -> Array | None:
    """Return the colour of pixels with radiance above ``LIGHT`` divided by the exposure, where both renders have it.

    Networks average log-encoded radiance, which is clipped for them, so a lamp of a few pixels would lose most of its
    light. Instead, a lamp is as bright as in the HRLS, and at most as bright as the brightest of the 3 x 3 LRHS pixels
    around. If it is smaller than an LRHS pixel, the LRHS has more light than the clipped HRLS. The difference, over
    3 x 3 LRHS pixels because filters move light, is spread over the clipped pixels: evenly, or in the proportions of
    the HRLS, whichever gives a pixel more. Around a firefly in a lamp, a pixel more than twice as bright as the clipped
    ones on average, it is spread evenly.

    Args:
        lrhs_rgb, hrls_rgb: (h, w, 3) and (s*h, s*w, 3), scene linear, without fireflies (:func:`dim_fireflies`).

    Returns:
        (s*h, s*w, 3), scene linear; 0 where all channels are darker. None if no pixel is as bright.
    """
    least = np.float32(LIGHT / exposure)
    if hrls_rgb.max() <= least:
        return None
    scale = len(hrls_rgb) // len(lrhs_rgb)
    coverage = box_downsample((hrls_rgb > least).astype(np.float32), scale)
    clipped = box_downsample(np.minimum(hrls_rgb, least), scale)
    with np.errstate(over="ignore", invalid="ignore"):  # a limit that overflows is no limit
        excesses = [np.maximum(mean - clipped, 0) for mean in (lrhs_rgb, box_downsample(hrls_rgb, scale))]
        light, hrls_light, covered = (reduce(np.add, neighbours(values)) for values in (*excesses, coverage))
        even = least + light / np.maximum(covered, np.float32(1 / scale**2))
        limit = np.maximum(max_around(lrhs_rgb), even)
        factor = np.nan_to_num(np.minimum(light / np.maximum(hrls_light, np.float32(1e-30)), 1))
        blocks = _by_lrhs_pixel(hrls_rgb, scale)
        factor[(max_around(blocks.max(axis=(1, 3))) - least) * covered > 2 * hrls_light] = 0
        # The LRHS pixel must have light, too. Otherwise the HRLS pixel is a firefly beside a lamp.
        most = lrhs_rgb * np.float32(FIREFLY_FACTOR)
    factor, limit, most = map(_over_hrls, (factor, limit, most))
    bound = np.minimum(np.maximum(limit, least + (blocks - least) * factor), most)
    agreed = np.minimum(blocks, bound).reshape(hrls_rgb.shape)
    agreed[np.all(agreed <= least, axis=-1)] = 0
    return agreed


def steady_lights(rgb: Array, exposure: float) -> Array | None:
    """Return the colour of bright areas of a render (h, w, 3) that have no noise, such as lamps and windows.

    Networks in 8 bits have no codes for very bright light, and it loses most of its energy. Two renders tell what is
    missing, one render does not. Without noise, there is nothing to remove.

    Returns:
        (h, w, 3), scene linear; 0 elsewhere. None if there is no such area.
    """
    brightest = _brightest(rgb)[..., 0]
    least = np.float32(STEADY_LIGHT / exposure)
    rows, columns = np.nonzero(brightest > least)
    if not rows.size:
        return None
    padded = np.pad(rgb, ((1, 1), (1, 1), (0, 0)), mode="edge")
    own, limit = rgb[rows, columns], np.float32(STEADY) * brightest[rows, columns, None]
    with np.errstate(over="ignore"):
        around = (padded[rows + y, columns + x] for y, x in np.ndindex(3, 3))
        alike = reduce(np.logical_and, ((np.abs(pixels - own) <= limit).all(axis=1) for pixels in around))
    steady = np.zeros(brightest.shape, dtype=bool)
    steady[rows, columns] = alike
    return rgb * max_around(steady)[..., None] if alike.any() else None


def _brightness_limit(rgb: Array, tile: TileFeatures) -> Array:
    """Return the largest values that the other render may have, (h, w, 3): infinity where this render is black."""
    brightest = max_around(rgb)
    with np.errstate(over="ignore"):  # a limit that overflows is no limit
        limit = brightest * np.float32(FIREFLY_FACTOR)
        # All 3 x 3 pixels around may have missed light that few samples find. One of s x s samples of it may be s^2
        # times as bright as their mean.
        rare = _rare_light(rgb, tile.lrhs_area.y0 % _SQUARE, tile.lrhs_area.x0 % _SQUARE)
        np.copyto(limit, rare * np.float32(tile.scale**2), where=rare > limit)
        np.copyto(limit, np.float32(np.inf), where=~(brightest > 0))
        return limit


def _rare_light(rgb: Array, top: int, left: int) -> Array:
    """Return the brightness of light that reaches a few pixels in most of the 3 x 3 squares around, (h, w, 3)."""
    # So many rows and columns of the first square lie before the tile, so that tiles have equal squares.
    height, width, channels = rgb.shape
    rows, columns = (-(-side // _SQUARE) for side in (top + height, left + width))
    lines = np.zeros((channels, rows, _SQUARE, columns * _SQUARE), np.float32)
    inside = (slice(None), slice(top, top + height), slice(left, left + width))
    lines.reshape(channels, -1, columns * _SQUARE)[inside] = rgb.transpose(2, 0, 1)
    # The rows of a square are reduced before its columns: NumPy then works on whole rows of the picture.
    sides = channels, rows, columns, _SQUARE
    brightest = lines.max(axis=2).reshape(sides).max(axis=3)
    least = (brightest / np.float32(FIREFLY_FACTOR)).repeat(_SQUARE, axis=2)[:, :, None]
    reached = (lines > least).sum(axis=2, dtype=np.uint8).reshape(sides).sum(axis=3)
    brightest[reached > _RARE * _SQUARE**2] = 0
    nine = np.stack(list(neighbours(brightest.transpose(1, 2, 0))))
    light = planes_of(np.median(nine, axis=0)).repeat(_SQUARE, axis=1).repeat(_SQUARE, axis=2)
    return light[inside].transpose(1, 2, 0)


def is_noise_free(tile: TileFeatures, lrhs_rgb: Array, hrls_rgb: Array, exposure: float) -> bool:
    """Return whether the two renders of a tile, scene linear, agree so well that there is no noise to remove."""
    means = box_downsample(hrls_rgb, tile.scale)[tile.inside]
    difference = encode_radiance(means, exposure) - encode_radiance(lrhs_rgb[tile.inside], exposure)
    return bool(np.abs(difference).max() <= NOISE_FREE)


def check_finite(session: Session, *images: Array) -> None:
    """Raise MssplError if an output of a network is not finite. A frame with repaired holes would look finished."""
    if not all(np.isfinite(image).all() for image in images):
        raise MssplError(
            f"{session.contract.name} on {session.provider} returned NaN or infinite values, so this frame is not "
            "fused; try --device cpu or another --model"
        )


class EmptyRegions:
    """The regions where neither render has light, and that become black, so that a transparent film stays empty.

    A pixel is empty if it and the 3 x 3 LRHS pixels around are black, and no surface is near. Near a dark surface,
    which may have no lit sample by chance, both renders must be black over ``reach`` pixels around.

    In a pass, the latter also holds where light is rare: few samples find a lamp that is out of focus, and the others
    find the empty background behind it. In a beauty, such light is more often that of stars, and the space between them
    stays black.

    Args:
        lrhs_rgb: the whole LRHS (h, w, 3).
        reach: in LRHS pixels. Tiles that overlap by less may differ at their borders.
        of_pass: the renders show a pass in place of the beauty.
    """

    def __init__(self, lrhs_rgb: Array, reach: int = FAR, *, of_pass: bool = False) -> None:
        self._reach = reach
        self._black = _is_zero(lrhs_rgb)
        self._black_far_around = all_within(self._black, reach) if self._black.any() else self._black
        self._has_rare_light = np.zeros_like(self._black)
        if of_pass and self._black.any():
            self._has_rare_light = max_around(_rare_light(_brightest(lrhs_rgb), 0, 0) > 0, _SQUARE)

    def mask(self, tile: TileFeatures, window: tuple[slice, slice]) -> Mask | None:
        """Return the empty HRLS pixels of a tile, (s*h, s*w, 1); None if no LRHS pixel is black.

        ``window``: rows and columns of the tile's area in the whole LRHS.
        """
        if not self._black[window].any():
            return None
        black = _is_zero(tile.hrls[RGB])
        empty = repeated(all_within(self._black[window], 1), tile.scale) & black
        no_surface = all_within(_shows_no_surface(tile.hrls), SMEAR)
        no_surface &= ~repeated(self._has_rare_light[window], tile.scale)
        far = self._black_far_around[window]
        if far.any():
            blocks = black.reshape(len(far), tile.scale, -1, tile.scale, 1)
            far = far & all_within(np.logical_and.reduce(blocks, axis=(1, 3)), self._reach)
        return empty & (no_surface | repeated(far, tile.scale))


def black_in_both(lrhs_rgb: Array, hrls_rgb: Array) -> Mask:
    """Return the HRLS pixels (s*h, s*w, 1) that are black, as are the 3 x 3 LRHS pixels around."""
    scale = len(hrls_rgb) // len(lrhs_rgb)
    return repeated(all_within(_is_zero(lrhs_rgb), 1), scale) & _is_zero(hrls_rgb)


def lit_window(rgb: Array, window: Window, margin: int) -> Window | None:
    """Return the rectangle around all lit pixels (h, w, 3) of a window, and a margin; None if none is lit."""
    values = rgb.reshape(len(rgb), -1)  # NumPy is several times as fast along one axis as along two
    rows = np.flatnonzero(values.any(axis=1))
    if not rows.size:
        return None
    columns = np.flatnonzero(values[rows[0] : rows[-1] + 1].any(axis=0)) // rgb.shape[2]
    x0, y0, x1, y1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    return Window(x0 - margin, y0 - margin, x1 + margin, y1 + margin).shift(window.x0, window.y0)


def repeated(lrhs: NDArray[T], scale: int) -> NDArray[T]:
    """Repeat each pixel s x s times: (h, w, c) to (s*h, s*w, c)."""
    return lrhs.repeat(scale, axis=0).repeat(scale, axis=1)


def _is_zero(values: Array) -> Mask:
    """Return where all channels of an image (h, w, c) are 0, (h, w, 1)."""
    # NumPy reduces short axes, such as that of the channels, slowly.
    return reduce(np.logical_and, (values[..., c : c + 1] == 0 for c in range(values.shape[-1])))


def _shows_no_surface(hrls: dict[str, Array]) -> Mask:
    """Return where alpha or normal is 0, or the albedo if there are neither; everywhere if there is none of these."""
    names = [name for name in ("alpha", NORMAL) if name in hrls] or [name for name in (ALBEDO,) if name in hrls]
    signs = [_is_zero(hrls[name]) for name in names]
    return reduce(np.logical_or, signs) if signs else np.ones((*hrls[RGB].shape[:2], 1), dtype=bool)
