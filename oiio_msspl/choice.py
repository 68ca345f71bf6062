# SPDX-License-Identifier: Apache-2.0
"""``--model auto``: the smallest model that is enough for a pair, found by looking at it."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from oiio_msspl import schema, tensors
from oiio_msspl.pairing import Pairing, Source, pair
from oiio_msspl.render import Window
from oiio_msspl.session import find_model, shipped_models
from oiio_msspl.transforms import luminance

#: What chooses, as ``--model`` has it; also what no ``--model`` means.
AUTO = "auto"
#: Noise of the HRLS, see :func:`noise`, below which the plain network's result is as good as with Open Image Denoise.
QUIET = 0.5
#: LRHS rows of each of the bands that are looked at, and how many there are.
BAND, BANDS = 4, 8


def choose(lr: Source, hr: Source, model: str | None = None) -> tuple[Path, str]:
    """The model for a pair, and a few words on why it was chosen; none where ``model`` names it.

    Args:
        lr, hr: files with their layers mapped or renders in memory.
        model: ``auto`` or None, or what :func:`oiio_msspl.session.find_model` takes.

    Raises:
        InputError: the pair does not fit, or there is no such model.
    """
    pairing = pair(lr, hr)
    if model not in (None, AUTO):
        return find_model(pairing.scale, model), ""
    larger = f"pyramid-oidn-x{pairing.scale}"
    if larger not in shipped_models():
        return find_model(pairing.scale), ""
    if find_spec("pyoidn") is None:
        return find_model(pairing.scale), "pyramid-oidn is more accurate: pip install pyoidn"
    level = noise(lr, hr, pairing)
    if level < QUIET:
        return find_model(pairing.scale), f"noise {level:.2f}: as good as with Open Image Denoise"
    return shipped_models()[larger], f"noise {level:.2f}"


def noise(lr: Source, hr: Source, pairing: Pairing) -> float:
    """How noisy the HRLS is: ``s |a - b| / (a + b)`` of its luminance, averaged down to the LRHS, and the LRHS's.

    Median over the lit pixels of some bands of the frame, so that neither fireflies nor edges matter. The factor of s
    makes it about the noise of an HRLS pixel: an LRHS pixel is a mean of s x s. 0 for a black frame.
    """
    s, grid = pairing.scale, pairing.grid
    bands = []
    for y in np.unique(np.linspace(grid.y0, max(grid.y0, grid.y1 - BAND), BANDS).astype(int)):
        low = Window(grid.x0, int(y), grid.x1, min(int(y) + BAND, grid.y1))
        high = Window(low.x0 * s, low.y0 * s, low.x1 * s, low.y1 * s)
        a = luminance(tensors.read(lr, low, pairing.lr_data, features=[schema.RGB])[schema.RGB])
        b = luminance(tensors.read(hr, high, pairing.hr_data, features=[schema.RGB])[schema.RGB])
        b = b.reshape(low.height, s, low.width, s).mean((1, 3))
        lit = a + b > 0
        bands.append(np.abs(a - b)[lit] / (a + b)[lit])
    values = np.concatenate(bands)
    return s * float(np.median(values)) if len(values) else 0.0
