# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise (OIDN) on renders: what a user can do without this project's networks."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.compare import upsample_bicubic
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.tiles.features import read_features
from oiio_msspl.image.arrays import Array, clip, repair
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.encoding import decode_radiance, encode_radiance, find_exposure
from oiio_msspl.model.render_mean import find_shares
from research.benchmarks.every_second_pixel import on_every_second_pixel, without_grid
from research.benchmarks.oidn import denoise, denoise_prefiltered, run_filter


def oidn(source: ReadableRender, quality: str = "high") -> Array:
    """OIDN's plain call on a render, with its noisy albedo and normal if it has them."""
    return denoise(**_inputs(source), quality=quality)


def oidn_prefiltered(source: ReadableRender, guides: str = "high") -> Array:
    """OIDN as its documentation recommends it: the albedo and the normal are denoised first, in the quality
    ``guides``."""
    return denoise_prefiltered(**_inputs(source), guides=guides)


def oidn_split(source: ReadableRender) -> Array:
    """:func:`oidn_prefiltered` on every second pixel, see :mod:`research.benchmarks.every_second_pixel`."""
    inputs = _inputs(source)
    exposure = find_exposure(inputs["color"])
    joined = on_every_second_pixel(denoise_prefiltered, inputs)
    return decode_radiance(without_grid(encode_radiance(joined, exposure)), exposure)


def _inputs(source: ReadableRender) -> dict[str, Array]:
    """``color``, ``albedo`` and ``normal`` of a render, as far as it has them. OIDN takes no normal without albedo."""
    layers = source.read(source.data_window)
    layers = {name: np.ascontiguousarray(repair(v, signed=name == "normal")[0]) for name, v in layers.items()}
    auxiliary = ("albedo", "normal") if "albedo" in layers else ()
    return {"color": layers["rgb"]} | {name: layers[name] for name in auxiliary if name in layers}


def oidn_on_average(lrhs: ReadableRender, hrls: ReadableRender) -> Array:
    """OIDN on the weighted mean of both renders at the LRHS's resolution; linear (h / s, w / s, 3).

    Albedo and normal are means of many pixels and have hardly any noise, so ``cleanAux`` is set. At x2 they are means
    of four, so those of the LRHS are averaged in, and the albedo is prefiltered.
    """
    low, high = (
        read_features(render, render.data_window, render.data_window, features=(RGB, ALBEDO, NORMAL))
        for render in (lrhs, hrls)
    )
    for layers in (low, high):
        layers |= {name: clip(layers[name], -1.0, 1.0) for name in (ALBEDO, NORMAL) if name in layers}
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
