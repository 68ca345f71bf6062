# SPDX-License-Identifier: Apache-2.0
"""The shares of both renders in their mean, which `joint` denoises first.

The LRHS and the HRLS are independent samples of one scene. At the LRHS's resolution, a weighted mean of the two has
less noise than either render. This module finds the weights, and the models compute the mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.encoding import encode_radiance

#: Features of one render, (h, w, c), in scene-linear units.
Images = dict[str, Array]
#: Weight of the LRHS in the mean of both renders, in [0, 1], by feature; 0 for features that are absent.
Shares = dict[str, float]

#: The range of each feature in which the models average it.
_RANGES = {RGB: (0.0, np.inf), ALBEDO: (0.0, 1.0), NORMAL: (-1.0, 1.0)}
#: Bounds of the LRHS's share, because an estimate of 0 or 1 may be wrong.
_BOUNDS = (0.05, 0.95)
#: An albedo or normal of the LRHS does not show the same as that of the HRLS if their mean squared difference exceeds
#: this fraction of the latter's variance plus ``_VARIANCE_OFFSET``. At x2 and 1 spp in both renders, one in ten of 60
#: views exceeds 0.2 (albedo) or 0.1 (normal); with the LRHS mirrored, one in twenty is below 0.55.
_DIFFERENT, _VARIANCE_OFFSET = 0.5, 4e-4
#: Every n-th row is compared.
_COMPARED_ROWS = 4


def find_shares(pairs: Sequence[tuple[Images, Images]], exposure: float, share: float | None = None) -> Shares:
    """Decide how both renders of a frame are averaged. A frame has one answer, so that its tiles agree.

    Args:
        pairs: features of the LRHS and of the HRLS for parts of the frame, all equally large: ``rgb``, and ``albedo``
            and ``normal`` of the renders that have them.
        share: of ``rgb``, if it is known.

    Returns:
        The share of ``rgb``, and this share for each AOV of the LRHS that agrees with the HRLS's.
    """
    scale = len(pairs[0][1][RGB]) // len(pairs[0][0][RGB])

    def of_both(name: str) -> Iterator[Array]:
        for render, factor in ((0, 1), (1, scale)):
            images = (np.clip(pair[render][name], *_RANGES[name]) for pair in pairs)
            yield np.stack([box_downsample(image, factor) for image in images])

    if share is None:
        share = lrhs_share(*(encode_radiance(images, exposure) for images in of_both(RGB)))
    shared = pairs[0][0].keys() & pairs[0][1].keys()
    return {RGB: share} | {name: share for name in (ALBEDO, NORMAL) if name in shared and _agree(*of_both(name))}


def lrhs_share(lrhs: Array, hrls: Array) -> float:
    """Return the share of the LRHS in the mean of both renders that has the least noise, in [0.05, 0.95].

    It is 0.5 if both are equally noisy, or not noisy. Both are log-encoded, (..., h, w, 3), at one resolution.
    High-pass filtered, each is picture plus noise. The picture is the same in both and the noise is independent, so
    their covariance is the variance of the picture. The rest of each render's variance is noise.
    """
    a, b = (x[..., 1:, 1:, :] - x[..., 1:, :-1, :] - x[..., :-1, 1:, :] + x[..., :-1, :-1, :] for x in (lrhs, hrls))
    if a.size == 0:  # one row or column
        return 0.5
    covariance = np.mean(a * b)
    lrhs_noise, hrls_noise = (max(float(np.mean(x * x) - covariance), 1e-9) for x in (a, b))
    return float(np.clip(hrls_noise / (lrhs_noise + hrls_noise), *_BOUNDS))


def _agree(lrhs_aov: Array, hrls_aov: Array) -> bool:
    """Return whether two AOVs (..., h, w, 3) differ by no more than noise."""
    lrhs_aov, hrls_aov = (aov[..., ::_COMPARED_ROWS, :, :] for aov in (lrhs_aov, hrls_aov))
    variance = float(hrls_aov.var(axis=tuple(range(hrls_aov.ndim - 1))).mean())
    return float(np.square(lrhs_aov - hrls_aov).mean()) <= _DIFFERENT * (variance + _VARIANCE_OFFSET)
