# SPDX-License-Identifier: Apache-2.0
"""Denoise renders with Open Image Denoise (OIDN): what a user can do without this project's networks."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.compare import upsample_bicubic
from oiio_msspl.fusion.tiles.features import read_features
from oiio_msspl.image.arrays import Array, repair
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.model.encoding import decode_radiance, encode_radiance, find_exposure
from oiio_msspl.model.render_mean import find_shares
from research.benchmarks.oidn import denoise, denoise_prefiltered, run_filter

#: Log-encoded pixels that differ by this much count 0.6 times as much in the filter that removes the grid.
SIMILAR = 0.07


def oidn(source: ReadableRender, quality: str = "high") -> Array:
    """Denoise by the plain call, with the noisy albedo and normal if the render has them."""
    return denoise(**_inputs(source), quality=quality)


def oidn_prefiltered(source: ReadableRender) -> Array:
    """Denoise as OIDN's documentation recommends: albedo and normal first."""
    return denoise_prefiltered(**_inputs(source))


def oidn_split(source: ReadableRender) -> Array:
    """Denoise every second pixel of a render as recommended, four times, for noise that a pixel filter has spread.

    The noise of neighbouring pixels is then alike, and OIDN takes it for detail. But pixels two apart share little. So
    the picture is split into four, and the results are put together again. They differ a little, which shows as a fine
    grid; a filter over 3 x 3 pixels removes it. No tool that we know of calls OIDN like this.
    """
    inputs = _inputs(source)
    exposure = find_exposure(inputs["color"])
    joined = on_every_second_pixel(denoise_prefiltered, inputs)
    return decode_radiance(without_grid(encode_radiance(joined, exposure)), exposure)


def _inputs(source: ReadableRender) -> dict[str, Array]:
    """Read those of color, albedo and normal that a render has. OIDN takes no normal without albedo."""
    layers = source.read(source.data_window)
    layers = {name: np.ascontiguousarray(repair(v, signed=name == "normal")[0]) for name, v in layers.items()}
    auxiliary = ("albedo", "normal") if "albedo" in layers else ()
    return {"color": layers["rgb"]} | {name: layers[name] for name in auxiliary if name in layers}


def oidn_on_average(lrhs: ReadableRender, hrls: ReadableRender) -> Array:
    """Denoise the weighted mean of both renders at the LRHS's resolution; linear (h / s, w / s, 3).

    Albedo and normal are means of many pixels and have hardly any noise, so ``cleanAux`` is set. At x2 they are means
    of four, so those of the LRHS are averaged in, and the albedo is prefiltered.
    """
    low, high = (
        read_features(render, render.data_window, render.data_window, features=(RGB, ALBEDO, NORMAL))
        for render in (lrhs, hrls)
    )
    for layers in (low, high):
        layers |= {name: layers[name].clip(-1.0, 1.0) for name in (ALBEDO, NORMAL) if name in layers}
    scale = len(high[RGB]) // len(low[RGB])
    shares = find_shares([(low if scale == 2 else {RGB: low[RGB]}, high)], find_exposure(low[RGB]))
    means = {name: box_downsample(image, scale) for name, image in high.items()}
    means |= {name: means[name] + np.float32(share) * (low[name] - means[name]) for name, share in shares.items()}
    auxiliary = {name: means[name] for name in (ALBEDO, NORMAL) if name in high and ALBEDO in high}
    if scale == 2 and auxiliary:
        auxiliary[ALBEDO] = run_filter({ALBEDO: auxiliary[ALBEDO]})
    return run_filter({"color": means[RGB], **auxiliary}, hdr=True, cleanAux=bool(auxiliary))


def match_local_means(image: Array, low: Array) -> Array:
    """Multiply an image (h, w, 3) by a smooth ratio that gives it the local means of a smaller one (h/s, w/s, 3)."""
    height, width = image.shape[:2]
    means = box_downsample(image, height // low.shape[0])
    return image * upsample_bicubic(((low + 1e-3) / (means + 1e-3)).astype(np.float32), width, height)


def on_every_second_pixel(denoise: Callable[..., Array], images: dict[str, Array]) -> Array:
    """Call ``denoise`` with every second pixel of the images (h, w, c), four times; join the results (h, w, 3)."""
    height, width = next(iter(images.values())).shape[:2]
    result = np.empty((height, width, 3), np.float32)
    for y, x in itertools.product(range(2), repeat=2):
        place = slice(y, None, 2), slice(x, None, 2)
        result[place] = denoise(**{name: np.ascontiguousarray(image[place]) for name, image in images.items()})
    return result


def without_grid(encoded: Array) -> Array:
    """Remove the differences between the four pictures from their log-encoded result (h, w, 3).

    A binomial filter over 3 x 3 pixels gives each of the four pictures the same weight, so it removes all of a grid. It
    is a bilateral filter (Tomasi and Manduchi 1998), so edges stay: a pixel counts less the more it differs.
    """
    padded = np.pad(encoded, ((1, 1), (1, 1), (0, 0)), mode="symmetric")
    result = np.empty_like(encoded, order="C")
    width = encoded.shape[1]

    def work(rows: slice) -> None:
        centre = encoded[rows]
        height = len(centre)
        total, weights = np.zeros_like(centre, order="C"), np.zeros((height, width, 1), np.float32)
        for y, x in itertools.product(range(3), repeat=2):
            neighbour = padded[rows.start + y : rows.start + y + height, x : x + width]
            squared = np.square(neighbour - centre).mean(axis=-1, keepdims=True)
            weight = np.exp(squared * np.float32(-0.5 / SIMILAR**2))
            weight *= (1, 2, 1)[y] * (1, 2, 1)[x]
            total += weight * neighbour
            weights += weight
        np.divide(total, weights, out=result[rows])

    for_row_blocks(work, len(encoded), encoded[0].size)
    return result
