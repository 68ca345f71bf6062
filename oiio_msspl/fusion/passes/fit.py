# SPDX-License-Identifier: Apache-2.0
"""Estimates layers by a fit of their noisy means, in both renders, to the fused beauty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from oiio_msspl.fusion.passes.bands import Band, estimated_of, in_both
from oiio_msspl.fusion.passes.lines import STEPS
from oiio_msspl.fusion.passes.plan import PassJob
from oiio_msspl.image.arrays import Array

#: A render whose logarithm of light differs by this much from that of the fused beauty has 1/e of the weight.
LIGHT_SPREAD = 1.0


def fit_to_beauty(band: Band, job: PassJob, renders: Sequence[Array], out: Array, missing: Sequence[int]) -> None:
    """Fit layers of a set to the fused beauty.

    Args:
        renders: of :meth:`Band.renders_of`. The first one may be written over.
        out: gets the layers, (layers, 3, h, w) over the core.
        missing: which ones to fit. Black ones stay as they are.
    """
    noisy, *lrhs = renders
    for layers in lrhs:
        weight = _likeness(band, layers)
        for i in np.flatnonzero(in_both(job, len(noisy))):
            noisy[i] += weight * layers[i]
            noisy[i] /= 1 + weight
    noisy = estimated_of(job, noisy)
    if lit := [i for i in missing if noisy[i].any()]:
        fit = band.fit_at(STEPS[band.scale])
        fit.fit_layers([noisy[i] for i in lit], [out[i] for i in lit], few_samples=True)


def _likeness(band: Band, layers: Array) -> Array:
    """Return the weight (h, w) of the LRHS's layers (layers, 3, h, w): 1 where the fused beauty has as much light.

    The pixel filter of the LRHS is wider. Small lights and highlights lose light to the pixels around them, and so do
    their layers.
    """
    lights = (layers.sum(axis=(0, 1), dtype=np.float64), band.low_beauty.sum(axis=0, dtype=np.float64))
    rendered, fused = (np.log(light + 3 * band.sources.dark) for light in lights)
    return np.exp(-np.square((rendered - fused) / LIGHT_SPREAD)).astype(np.float32)
