# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise on both renders, for models that read its results: the only module that imports pyoidn, which is
optional.

The HRLS is denoised as anyone would, with its albedo and normal. The LRHS has neither; but its light and the HRLS's are
independent samples of the same scene, so at the LRHS's resolution their mean has less noise than either, and the
HRLS's albedo and normal, averaged over s x s pixels, have hardly any: Open Image Denoise may be told that they are
clean, which is worth 0.8 to 1.5 dB (at x2, where but four pixels are averaged, the LRHS's own are, too, and the albedo
is denoised first, or nothing is told). What it makes of these is
better at that resolution than its result on the HRLS, for a fraction of the time. A network of ours that was made of
Open Image Denoise's does the same without its help.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, DEFAULTS, HRLS_FEATURES, NORMAL, RGB
from oiio_msspl.arrays import Array, box_downsample, clip
from oiio_msspl.model.encoding import decode_radiance, encode_radiance

if TYPE_CHECKING:
    pass


#: A picture to denoise: ``colour`` in network values, ``albedo`` in [0, 1] and ``normal`` in [-1, 1]; (h, w, 3) each.
Layers = dict[str, Array]
NO_LAYERS: Layers = {}
_FIRST = dict(zip(HRLS_FEATURES, np.cumsum([0, *HRLS_FEATURES.values()]), strict=False))


#: Bounds of the LRHS's share in what is denoised at its resolution: an estimate that wants all or none may be wrong.
_SHARE = (0.05, 0.95)
#: Mean squared difference of an LRHS's layer from the HRLS's, as a share of the latter's variance (and so much more),
#: above which it is another one. Of 60 views with 1 spp in either render one in ten has more than 0.2 (albedo) and 0.1
#: (normal) at x2; with the LRHS's mirrored one in twenty is below 0.55.
_OTHER, _NOTHING = 0.5, 4e-4
#: What the noise of both renders' mean is written in.
NOISE_GAIN = 2.0


def mean_of_renders(lrhs: Array, layers: Layers, low_aovs: Layers = NO_LAYERS) -> Layers:
    """The mean of both renders that has the least noise, at the LRHS's resolution.

    Args:
        lrhs: (h, w, 3), transformed.
        layers: of the HRLS, see :func:`layers_of`.
        low_aovs: the LRHS's own ``albedo`` and ``normal``, transformed, as far as they are there.

    Returns:
        ``colour``; the means of ``albedo`` and ``normal``, as far as the HRLS has them, with the LRHS's share in them;
        and ``noise`` (h, w, 1), what the colour's is estimated to be: how far the renders differ there, in network
        values times ``NOISE_GAIN``, at most 1.
    """
    scale = layers["colour"].shape[0] // lrhs.shape[0]
    radiance = box_downsample(decode_radiance(layers["colour"], 1.0), scale)
    other = encode_radiance(radiance, 1.0)
    share = lrhs_share(lrhs, other)
    mean = share * decode_radiance(lrhs, 1.0) + (1 - share) * radiance
    low = {"colour": encode_radiance(mean, 1.0)}
    # Of a difference, which has both renders' noise, so much is what their mean has
    gain = np.float32(NOISE_GAIN * (share * (1 - share)) ** 0.5)
    low["noise"] = np.minimum(gain * np.abs(lrhs - other).mean(axis=-1, keepdims=True), 1)
    for name in ("albedo", "normal"):
        if name in layers:
            low[name] = box_downsample(layers[name], scale)
            if name in low_aovs:
                other = clip(low_aovs[name], -1.0, 1.0)  # there are albedos beyond 1
                if _shows_the_same(other, low[name]):
                    low[name] += share * (other - low[name])
    return low


def _shows_the_same(layer: Array, of_hrls: Array) -> bool:
    """Whether a layer of the LRHS can be that of the HRLS, both (h, w, 3)."""
    variance = float(of_hrls.var(axis=(0, 1)).mean())
    return float(np.square(layer - of_hrls).mean()) <= _OTHER * (variance + _NOTHING)


def lrhs_aovs_read(scale: int) -> tuple[str, ...]:
    """Layers of the LRHS that are of use at a scale.

    At x2 they are worth up to 0.3 dB. At x4 and x8 the HRLS's, as means of s x s pixels, have little noise, and where
    the renderer's pixel filter is no box, the LRHS's show other means.
    """
    return (ALBEDO, NORMAL) if scale == 2 else ()


def denoiser_layers(hrls: Array, *, complete: bool = False) -> Layers:
    """What Open Image Denoise reads of a transformed HRLS: colour, and albedo and normal as far as they are there.

    Args:
        complete: all of them; where one is absent, its default.
    """
    colour, normal = {"colour": _feature(hrls, RGB)}, _feature(hrls, NORMAL)
    albedo = clip(_feature(hrls, ALBEDO), 0.0, 1.0)
    if complete:
        return colour | {"albedo": albedo, "normal": normal}
    # A layer that is absent has its default everywhere; Open Image Denoise takes no normals without an albedo.
    if normal.any():
        return colour | {"albedo": albedo, "normal": normal}
    return colour | ({"albedo": albedo} if (albedo != DEFAULTS[ALBEDO]).any() else {})


def lrhs_share(lrhs: Array, hrls: Array) -> float:
    """Share of the LRHS in the mean of both renders that has the least noise.

    What one pixel differs by from its neighbours is picture and noise. The picture is the same in both renders, the
    noise is not: their covariance is the picture's part, and what each has beyond that is its noise.

    Args:
        lrhs, hrls: (h, w, 3) at the same resolution, transformed.

    Returns:
        The share, within 0.05 and 0.95; 0.5 for equal noise, and for none.
    """
    one, other = (x[1:, 1:] - x[1:, :-1] - x[:-1, 1:] + x[:-1, :-1] for x in (lrhs, hrls))
    common = np.mean(one * other)
    noise, other_noise = (max(float(np.mean(x * x) - common), 1e-9) for x in (one, other))
    return float(np.clip(other_noise / (noise + other_noise), *_SHARE))


def _feature(hrls: Array, name: str) -> Array:
    return hrls[..., _FIRST[name] : _FIRST[name] + HRLS_FEATURES[name]]
