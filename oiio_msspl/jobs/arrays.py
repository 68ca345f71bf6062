# SPDX-License-Identifier: Apache-2.0
"""Fuses a frame from arrays, and chooses the model itself."""

from __future__ import annotations

import functools

from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.fuse import FusedFrame, fuse
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import Array
from oiio_msspl.jobs.settings import family_for_noise
from oiio_msspl.model.catalogue import DEFAULT_QUALITY, QUALITIES, load_model

_load_once = functools.cache(load_model)


def fuse_arrays(
    hr: Array,
    lr: Array | None = None,
    *,
    albedo: Array | None = None,
    normal: Array | None = None,
    alpha: Array | None = None,
    quality: str = DEFAULT_QUALITY,
    device: str = "cpu",
    threads: int = 0,
) -> FusedFrame:
    """Remove the noise of a render, or of two renders of the same frame together.

    The model is one for renders of these sizes, and for their noise.

    Args:
        hr: (height, width, 3), scene linear.
        lr: a second render with noise of its own: low-resolution with more samples per pixel, (height / s, width / s,
            3) with s = 2, 4 or 8, or one of the same size. None if there is one render.
        albedo, normal: of ``hr``, (height, width, 3); normals from -1 to 1.
        alpha: of ``hr``, (height, width, 1). It is fused if there is one render, and else kept.
        quality: ``fast``, ``balanced`` or ``best``.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`, such as ``cpu`` or ``cuda``.
        threads: CPU threads; 0 for one on each core.

    Returns:
        The fused frame: ``rgb`` (height, width, 3), and warnings.

    Raises:
        InputError: the arrays do not fit together, there is no such quality, or the device can't be used.
    """
    if quality not in QUALITIES:
        raise InputError(f"quality {quality!r}: use one of {', '.join(QUALITIES)}")
    aovs = {name: image for name, image in (("albedo", albedo), ("normal", normal)) if image is not None}
    layers = {"rgb": hr, **aovs} | ({} if alpha is None else {"alpha": alpha})
    high = Render.from_arrays("hr", **layers)
    low = high if lr is None else Render.from_arrays("lr", rgb=lr)
    alignment = align(low, high)
    family = QUALITIES[quality if aovs else min(quality, DEFAULT_QUALITY, key=list(QUALITIES).index)]
    family, _ = family_for_noise(family, low, high, alignment)
    return fuse(low, high, _load_once(alignment.scale, family, device, threads))
