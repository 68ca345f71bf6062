# SPDX-License-Identifier: Apache-2.0
"""Is a camera worth rendering, and how noisy is a reference?"""

from __future__ import annotations

import numpy as np

from oiio_msspl.image.colour import luminance, srgb
from oiio_msspl.model.encoding import KEY


def shows_something(probe: np.ndarray, lit_share: float = 0.6) -> bool:
    """Whether a small render (n, n, 15) is neither black nor mostly background nor a bare wall.

    The channels are those of ``hr`` in :mod:`research.datagen.views`. At least ``lit_share`` of the pixels must have
    light.
    """
    light = luminance(probe[..., :3])
    albedo, normal = probe[..., 3:6], probe[..., 6:9]

    def edges(x: np.ndarray, threshold: float) -> float:
        return float((np.abs(np.diff(x, axis=0)).max(-1) > threshold).mean())

    # Dark regions are wanted. A view that is dark everywhere is not.
    lit = (light > 3e-3 * max(float(np.percentile(light, 90)), 1e-9)).mean() >= lit_share
    background = (np.abs(normal).max(-1) == 0).mean() > 0.6
    return bool(
        lit and not background and edges(normal, 0.3) >= 0.06 and edges(normal, 0.3) + edges(albedo, 0.08) >= 0.15
    )


def log_mean(color: np.ndarray) -> float:
    """Return the log-mean luminance of linear colour (..., 3)."""
    light = luminance(color)
    return float(np.exp(np.log(light + 1e-4 * light.mean() + 1e-12).mean()))


def psnr_of_mean(a: np.ndarray, b: np.ndarray) -> float:
    """Estimate the sRGB PSNR, in dB, of the mean of two independent renders (H, W, 3) of equal spp.

    The difference of the two renders has four times the variance of the error of their mean.
    """
    exposure = KEY / log_mean((a + b) / 2)
    shown = [srgb(np.asarray(image * exposure)) for image in (a, b)]
    error = np.square(shown[0] - shown[1]).mean() / 4
    return float(-10 * np.log10(max(error, 1e-12)))
