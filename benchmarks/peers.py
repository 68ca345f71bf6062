# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise (OIDN) on renders: what a user can do without this project's networks."""

from __future__ import annotations

import numpy as np

from benchmarks.oidn import denoise, denoise_prefiltered, run_filter
from benchmarks.scenes import beauty
from oiio_msspl.aovs.features import HRLS_FEATURES
from oiio_msspl.arrays import Array, box_downsample, repair
from oiio_msspl.compare import upsample_bicubic
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.fusion.spread import STRIDE, join, without_grid
from oiio_msspl.fusion.tile_features import read_features
from oiio_msspl.model.encoding import decode_radiance, encode_features, encode_radiance, find_exposure
from oiio_msspl.model.render_mean import denoiser_images, mean_of_renders, useful_lrhs_aovs


def oidn(source: ReadableRender, quality: str = "high") -> Array:
    """OIDN's plain call on a render, with its noisy albedo and normal if it has them."""
    return denoise(**_inputs(source), quality=quality)


def oidn_prefiltered(source: ReadableRender) -> Array:
    """OIDN as its documentation recommends it: the albedo and the normal are denoised first."""
    return denoise_prefiltered(**_inputs(source))


def oidn_split(source: ReadableRender) -> Array:
    """:func:`oidn_prefiltered` on every second pixel, put together as :mod:`oiio_msspl.fusion.spread` does."""
    inputs = _inputs(source)
    exposure = find_exposure(inputs["color"])
    places = [(slice(y, None, STRIDE), slice(x, None, STRIDE)) for y in range(STRIDE) for x in range(STRIDE)]
    pictures = (
        denoise_prefiltered(**{name: np.ascontiguousarray(image[place]) for name, image in inputs.items()})
        for place in places
    )
    height, width = inputs["color"].shape[:2]
    joined = join(zip(places, pictures, strict=True), (height, width))
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
    of four, so the albedo is prefiltered.
    """
    low = beauty(lrhs)
    exposure = find_exposure(low)
    layers = read_features(hrls, hrls.data_window, hrls.data_window)
    packed = encode_features(layers, HRLS_FEATURES, exposure)
    scale = packed.shape[0] // low.shape[0]
    names = useful_lrhs_aovs(scale)
    lrhs_aovs = read_features(lrhs, lrhs.data_window, lrhs.data_window, features=names) if names else {}
    mean = mean_of_renders(encode_radiance(low, exposure), denoiser_images(packed), lrhs_aovs)
    auxiliary = {name: mean[name] for name in ("albedo", "normal") if name in layers and "albedo" in layers}
    if scale == 2 and auxiliary:
        auxiliary["albedo"] = run_filter({"albedo": auxiliary["albedo"]})
    return run_filter(
        {"color": decode_radiance(mean["colour"], exposure), **auxiliary}, hdr=True, cleanAux=bool(auxiliary)
    )


def match_local_means(image: Array, low: Array) -> Array:
    """Multiply an image (h, w, 3) by a smooth ratio that gives it the local means of a smaller one (h/s, w/s, 3)."""
    height, width = image.shape[:2]
    means = box_downsample(image, height // low.shape[0])
    return image * upsample_bicubic(((low + 1e-3) / (means + 1e-3)).astype(np.float32), width, height)
