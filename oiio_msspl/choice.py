# SPDX-License-Identifier: Apache-2.0
"""Which model is enough for a pair: what ``--model auto`` means."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from oiio_msspl import schema, tensors, transforms
from oiio_msspl.denoiser import noises
from oiio_msspl.pairing import Pairing, Source, pair
from oiio_msspl.render import Window
from oiio_msspl.session import ALWAYS, AUTO, BEST, FAST, find_model

#: Noise, as :func:`noise_of` measures it, below which ``FAST`` is enough.
QUIET = 0.02
#: The frame is judged by so many bands of so many rows of LRHS pixels.
BANDS, BAND = 8, 32


def choose(lr: Source, hr: Source, name: str | None = None) -> tuple[Path, str]:
    """The model of a name, or for ``auto`` (or None) the smallest one that is enough, and why.

    Raises:
        InputError: there is no such model, or the two are no pair.
    """
    pairing = pair(lr, hr)
    if name not in (None, AUTO):
        return find_model(pairing.scale, name), ""
    if not find_spec("pyoidn"):
        return find_model(pairing.scale, ALWAYS), "auto: without pyoidn"
    noise = noise_of(lr, hr, pairing)
    if noise < QUIET:
        return find_model(pairing.scale, FAST), f"auto: noise {noise:.3f} is below {QUIET:g}"
    return find_model(pairing.scale, BEST), f"auto: noise {noise:.3f} is not below {QUIET:g}"


def noise_of(lr: Source, hr: Source, pairing: Pairing) -> float:
    """Standard deviation of the noise that is left in the mean of both renders at the LRHS's resolution, in network
    values: 0.01 is about what separates two steps of an 8-bit picture at mid-grey."""
    grid, s = pairing.grid, pairing.scale
    tops = np.linspace(grid.y0, max(grid.y1 - BAND, grid.y0), BANDS if grid.height > BANDS * BAND else 1)
    height = BAND if len(tops) > 1 else grid.height
    pairs = []
    for top in tops.astype(int):
        want = Window(grid.x0, int(top), grid.x1, int(top) + height)
        above = Window(want.x0 * s, want.y0 * s, want.x1 * s, want.y1 * s)
        low = tensors.read(lr, want, pairing.lr_data, features=[schema.RGB])[schema.RGB]
        high = tensors.read(hr, above, pairing.hr_data, features=[schema.RGB])[schema.RGB]
        pairs.append((low, transforms.box_downsample(high, s)))
    exposure = transforms.exposure_of(np.concatenate([low for low, _ in pairs]))
    levels = [noises(*(transforms.compress(image, exposure) for image in images)) for images in pairs]
    low, high = np.mean(levels, axis=0)
    return float(np.sqrt(low * high / (low + high)))
