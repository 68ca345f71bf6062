# SPDX-License-Identifier: Apache-2.0
"""How training pairs are drawn from rendered views, and the fixed pairs for validation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from datagen.views import Array, View, as_float32, mean_lrhs, read_hrls, split_features
from oiio_msspl import schema, tensors, transforms

#: Height and width of the HR patch for each scale, as in the paper.
PAPER_PATCH = {2: 96, 4: 192, 8: 256}


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn: the renderings they imitate and the augmentations. Shares are probabilities."""

    hrls_spp: tuple[float, ...] = (0.22, 0.2, 0.12, 0.2, 0.05, 0.06, 0.05, 0.1)
    """Weight of 1, 2, 3, ... spp in the HRLS; low ones are the hard and the useful case."""
    lrhs_passes: tuple[float, ...] = (0.65, 0.2, 0.05, 0.05, 0.05)
    """Weight of 1, 2, 3, ... ``lr`` passes in the LRHS."""
    clip: float = math.inf
    """Radiance is clipped here, before anything else. The log curve can do without."""
    nearest: float = 0.15
    """Share with the paper's nearest-neighbour LRHS instead of the box average that a renderer's pixel filter makes."""
    exposure_stops: float = 0.5
    """Exposure jitter, plus or minus: inference may estimate the exposure from another crop or frame."""
    gain_stops: float = 0.5
    """Colour of the light: a gain per channel, plus or minus. Applied to radiance alone: albedo is no light."""
    permute: float = 0.5
    """Share with shuffled colour channels, albedo included: the same scene with its wavelengths renamed."""
    grey: float = 0.05
    """Share with r = g = b in all radiance; the model also serves single-channel layers."""
    drop_each: float = 0.1
    """Share in which an optional feature is absent, for each on its own."""
    drop_lobes: float = 0.5
    """Share without diffuse and specular: many renderers have neither."""
    drop_variance: float = 0.7
    """Hardly any renderer writes it."""
    drop_all: float = 0.05


#: ``Sampling`` as close to the paper's as its text tells: crops alone, every layer, clipped, nearest-neighbour LRHS.
PAPER_SAMPLING = Sampling(
    hrls_spp=(1.0,) * 8,
    clip=100.0,
    nearest=1.0,
    exposure_stops=0.0,
    gain_stops=0.0,
    permute=0.0,
    grey=0.0,
    drop_each=0.0,
    drop_lobes=0.0,
    drop_variance=0.0,
    drop_all=0.0,
)


# One pair


def random_orthogonal(rng: np.random.Generator, determinant: int) -> Array:
    """Uniformly random 3x3 rotation (determinant 1) or rotation with a mirroring (-1)."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))  # makes the decomposition unique, thereby q uniform
    if np.linalg.det(q) * determinant < 0:
        q[:, 0] *= -1
    return q.astype(np.float32)


def spp_range(view: View, sampling: Sampling, scale: int) -> dict[str, list[int]]:
    """Lowest and highest spp of the pairs that :func:`draw` makes of a view, for the model's contract."""
    samples = scale**2 if sampling.nearest < 1 else 1
    return {
        "hrls": [1, min(len(sampling.hrls_spp), len(view.hr))],
        "lrhs": [max(2, int(view.lr_spp.min()) * samples), int(view.lr_spp.sum()) * samples],
    }


#: What adds to a pair, (h, w, 3) and (s*h, s*w, 16), the further channels that some networks read.
Prepare = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Evaluation:
    """A fixed pair for validation: the paper's (s^2 - 1), one sample per HR pixel in LRHS and HRLS each."""

    lrhs: Array
    """Transformed (h, w, 3), and what :func:`training.networks.preparation` adds."""
    hrls: Array
    """Transformed (s*h, s*w, 16), every layer but the variance, which one sample does not have; and likewise."""
    reference: Array
    """Linear (s*h, s*w, 3)."""
    exposure: float

    @classmethod
    def centre(cls, view: View, scale: int, patch: int, prepare: Prepare | None = None) -> Evaluation:
        """The middle ``patch`` x ``patch`` pixels of a view."""
        height, width, _ = view.ref.shape
        top, left = (height - patch) // 2 // scale * scale, (width - patch) // 2 // scale * scale
        rows, columns = slice(top, top + patch), slice(left, left + patch)
        lrhs = mean_lrhs(view, [0], scale)
        exposure = transforms.exposure_of(lrhs)
        hrls = tensors.pack(split_features(read_hrls(view, [0], rows, columns)[0]), schema.HRLS_FEATURES, exposure)
        lrhs = lrhs[top // scale : (top + patch) // scale, left // scale : (left + patch) // scale]
        lrhs = transforms.compress(lrhs, exposure)
        if prepare is not None:
            lrhs, hrls = prepare(lrhs, hrls)
        return cls(
            lrhs=lrhs,
            hrls=hrls,
            reference=as_float32(view.ref[rows, columns]),
            exposure=exposure,
        )
