# SPDX-License-Identifier: Apache-2.0
"""The weighted mean of both renders at the LRHS's resolution: the input of the low-resolution denoiser.

The LRHS and the HRLS are independent samples of one scene. At the LRHS's resolution, the mean of the LRHS and of the
box-averaged HRLS therefore has less noise than either, and the box-averaged albedo and normal of the HRLS have hardly
any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, HRLS_FEATURES, NORMAL, RGB
from oiio_msspl.arrays import Array, box_downsample, clip
from oiio_msspl.model.encoding import decode_in_place, decode_radiance, encode_radiance

#: Images that a denoiser reads: ``colour`` (h, w, 3), log-encoded at exposure 1; ``albedo`` (h, w, 3) in [0, 1];
#: ``normal`` (h, w, 3) in [-1, 1]; ``noise`` (h, w, 1) in [0, 1].
Images = dict[str, Array]
NO_IMAGES: Images = {}

#: Factor that brings the estimated noise into [0, 1].
NOISE_GAIN = 2.0

#: Bounds of the LRHS's weight, because an estimate of "all" or "nothing" may be wrong.
_WEIGHT_BOUNDS = (0.05, 0.95)
#: An albedo or normal of the LRHS shows something else than that of the HRLS if their mean squared difference exceeds
#: this share of the latter's variance plus ``_VARIANCE_OFFSET``. At x2 and 1 spp in both renders, one in ten of 60
#: views exceeds 0.2 (albedo) or 0.1 (normal); with the LRHS mirrored, one in twenty is below 0.55.
_DIFFERENT, _VARIANCE_OFFSET = 0.5, 4e-4
#: Of so many rows, one is compared.
_COMPARED_ROWS = 4

_FIRST_CHANNEL = dict(zip(HRLS_FEATURES, np.cumsum([0, *HRLS_FEATURES.values()]), strict=False))


def useful_lrhs_aovs(scale: int) -> tuple[str, ...]:
    """AOVs of the LRHS that are worth reading at a scale.

    At x2 the average of four HRLS pixels still has noise, and the LRHS's AOVs halve it. At x4 and x8 the average of 16
    or 64 pixels has little, and the LRHS's AOVs differ from it where the pixel filter is not a box.
    """
    return (ALBEDO, NORMAL) if scale == 2 else ()


def denoiser_images(hrls: Array) -> Images:
    """Colour, albedo and normal of an encoded HRLS, (h, w, 9 or more). An absent AOV is its default."""
    return {
        "colour": _feature(hrls, RGB),
        ALBEDO: clip(_feature(hrls, ALBEDO), 0.0, 1.0),
        NORMAL: _feature(hrls, NORMAL),
    }


@dataclass(frozen=True)
class MeanSettings:
    """How both renders are averaged. A frame has one, so that its tiles agree."""

    lrhs_weight: float
    """See :func:`lrhs_weight`."""
    lrhs_aovs: tuple[str, ...]
    """AOVs of the LRHS that are averaged in: those that show the same as the HRLS's."""


def mean_settings(samples: Sequence[tuple[Array, Array, Images]]) -> MeanSettings:
    """Decide how both renders of a frame are averaged, from parts of the frame that are equally large.

    Args:
        samples: ``lrhs``, encoded HRLS (:func:`denoiser_images`) and ``lrhs_aovs`` of each part, see
            :func:`mean_of_renders`.
    """
    lrhs = np.stack([light for light, _, _ in samples])
    means = [_box_averages(denoiser_images(hrls), len(hrls) // len(light))[1] for light, hrls, _ in samples]
    hrls_means = {name: np.stack([images[name] for images in means]) for name in means[0]}
    lrhs_aovs = {name: np.stack([aovs[name] for _, _, aovs in samples]) for name in samples[0][2]}
    return _settings(lrhs, hrls_means, lrhs_aovs)


def mean_of_renders(
    lrhs: Array, hrls_images: Images, lrhs_aovs: Images = NO_IMAGES, settings: MeanSettings | None = None
) -> Images:
    """Average both renders at the LRHS's resolution, weighted so that the colour has the least noise.

    Args:
        lrhs: (h, w, 3), log-encoded at exposure 1.
        hrls_images: see :func:`denoiser_images`, at s times the size.
        lrhs_aovs: the LRHS's own ``albedo`` and ``normal``, (h, w, 3), encoded, as far as it has them.
        settings: those of the frame; decided from these images if None.

    Returns:
        ``colour``; ``albedo`` and ``normal`` as far as the HRLS has them; and ``noise``, the estimated standard
        deviation of the log-encoded colour times ``NOISE_GAIN``, at most 1.
    """
    scale = hrls_images["colour"].shape[0] // lrhs.shape[0]
    hrls_radiance, hrls = _box_averages(hrls_images, scale)
    if settings is None:
        settings = _settings(lrhs, hrls, lrhs_aovs)
    weight = settings.lrhs_weight
    mean = weight * decode_radiance(lrhs, 1.0) + (1 - weight) * hrls_radiance
    result = {"colour": encode_radiance(mean, 1.0)}
    # Scale |LRHS - HRLS| to the standard deviation of the weighted mean.
    gain = np.float32(NOISE_GAIN * (weight * (1 - weight)) ** 0.5)
    result["noise"] = np.minimum(gain * np.abs(lrhs - hrls["colour"]).mean(axis=-1, keepdims=True), 1)
    for name in (ALBEDO, NORMAL):
        if name in hrls:
            result[name] = hrls[name]
            if name in settings.lrhs_aovs:
                result[name] += weight * (_clipped(lrhs_aovs[name]) - result[name])
    return result


def _box_averages(hrls_images: Images, scale: int) -> tuple[Array, Images]:
    """The HRLS at the LRHS's resolution: its radiance at exposure 1, and all images."""
    radiance = box_downsample(hrls_images["colour"], scale, lambda rows: decode_in_place(rows, 1.0))
    aovs = {name: box_downsample(hrls_images[name], scale) for name in (ALBEDO, NORMAL) if name in hrls_images}
    return radiance, {"colour": encode_radiance(radiance, 1.0), **aovs}


def _settings(lrhs: Array, hrls: Images, lrhs_aovs: Images) -> MeanSettings:
    """Settings from images (..., h, w, 3), all at the LRHS's resolution."""
    same = (name for name in lrhs_aovs if name in hrls and _show_the_same(_clipped(lrhs_aovs[name]), hrls[name]))
    return MeanSettings(lrhs_weight(lrhs, hrls["colour"]), tuple(same))


def _clipped(lrhs_aov: Array) -> Array:
    """An encoded AOV of the LRHS in the range of :data:`Images`: an encoded albedo may reach 2."""
    return clip(lrhs_aov, -1.0, 1.0)


def lrhs_weight(lrhs: Array, hrls: Array) -> float:
    """Weight of the LRHS in the mean of both renders that has the least noise.

    High-pass filtered, each render is picture plus noise. The picture is the same in both and the noise is independent,
    so their covariance is the variance of the picture. What each variance exceeds it by is noise.

    Args:
        lrhs, hrls: (..., h, w, 3), log-encoded, at one resolution.

    Returns:
        A weight in [0.05, 0.95]; 0.5 if both are equally noisy, or not noisy.
    """
    a, b = (x[..., 1:, 1:, :] - x[..., 1:, :-1, :] - x[..., :-1, 1:, :] + x[..., :-1, :-1, :] for x in (lrhs, hrls))
    covariance = np.mean(a * b)
    lrhs_noise, hrls_noise = (max(float(np.mean(x * x) - covariance), 1e-9) for x in (a, b))
    return float(np.clip(hrls_noise / (lrhs_noise + hrls_noise), *_WEIGHT_BOUNDS))


def _show_the_same(lrhs_aov: Array, hrls_aov: Array) -> bool:
    """Whether two AOVs (..., h, w, 3) differ by no more than noise."""
    lrhs_aov, hrls_aov = (aov[..., ::_COMPARED_ROWS, :, :] for aov in (lrhs_aov, hrls_aov))
    variance = float(hrls_aov.var(axis=tuple(range(hrls_aov.ndim - 1))).mean())
    return float(np.square(lrhs_aov - hrls_aov).mean()) <= _DIFFERENT * (variance + _VARIANCE_OFFSET)


def _feature(hrls: Array, name: str) -> Array:
    first = _FIRST_CHANNEL[name]
    return hrls[..., first : first + HRLS_FEATURES[name]]
