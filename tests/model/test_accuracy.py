# SPDX-License-Identifier: Apache-2.0
"""Every shipped model removes noise from a real frame, as well as it did when it was shipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from oiio_msspl import Render, Session, find_model, fuse
from oiio_msspl.image.metrics import psnr, relmse
from oiio_msspl.model.catalogue import shipped_models
from oiio_msspl.model.contract import ONE_SIZE

#: PSNR in dB and RelMSE that each model had on the frame of ``tests/data``, whose HRLS has 2 spp.
SCORES = {
    "joint-clean-x1": (22.43, 0.0331),
    "joint-clean-x2": (22.89, 0.0308),
    "joint-clean-x4": (22.59, 0.0325),
    "joint-clean-x8": (22.40, 0.0332),
    "joint-large-clean-x1": (24.41, 0.0239),
    "joint-large-clean-x2": (24.82, 0.0247),
    "joint-large-clean-x4": (24.54, 0.0256),
    "joint-large-clean-x8": (24.33, 0.0255),
    "joint-large-spread-clean-x2": (24.09, 0.0273),
    "joint-large-spread-clean-x4": (24.06, 0.0272),
    "joint-large-spread-clean-x8": (24.10, 0.0267),
    "joint-large-spread-x1": (23.99, 0.0276),
    "joint-large-spread-x2": (24.56, 0.0255),
    "joint-large-spread-x4": (24.23, 0.0273),
    "joint-large-spread-x8": (24.01, 0.0287),
    "joint-large-x1": (24.39, 0.0241),
    "joint-large-x2": (24.81, 0.0255),
    "joint-large-x4": (24.46, 0.0267),
    "joint-large-x8": (24.24, 0.0262),
    "joint-small-spread-x1": (23.56, 0.0309),
    "joint-small-spread-x2": (23.94, 0.0293),
    "joint-small-spread-x4": (23.69, 0.0312),
    "joint-small-spread-x8": (23.50, 0.0326),
    "joint-small-x1": (23.65, 0.0306),
    "joint-small-x2": (24.22, 0.0287),
    "joint-small-x4": (23.93, 0.0304),
    "joint-small-x8": (23.74, 0.0309),
    "joint-spread-clean-x2": (23.96, 0.0282),
    "joint-spread-clean-x4": (23.92, 0.0283),
    "joint-spread-clean-x8": (23.94, 0.0273),
    "joint-spread-x1": (23.86, 0.0284),
    "joint-spread-x2": (24.36, 0.0267),
    "joint-spread-x4": (24.07, 0.0281),
    "joint-spread-x8": (23.90, 0.0285),
    "joint-x1": (23.99, 0.0271),
    "joint-x2": (24.67, 0.0251),
    "joint-x4": (24.35, 0.0246),
    "joint-x8": (24.14, 0.0241),
    "paper-x2": (23.39, 0.0357),
    "paper-x4": (22.60, 0.0427),
    "paper-x8": (21.74, 0.0555),
}


def test_no_shipped_model_is_missing():
    assert SCORES.keys() == shipped_models().keys()


@pytest.mark.parametrize("name", SCORES)
def test_a_real_frame_is_as_clean_as_it_was(name):
    """Within 0.2 dB and a tenth of the RelMSE. Enlarging the LRHS, or the only render, is at least 1.5 dB worse."""
    with np.load(Path(__file__).parents[1] / "data" / "pair.npz") as file:
        images = {key: values.astype(np.float32) for key, values in file.items()}
    model = Session(find_model(0, name), threads=1)
    hr = Render.from_arrays("hr", **{k.removeprefix("hrls_"): v for k, v in images.items() if k.startswith("hrls_")})
    scale = model.contract.scale
    lr = hr if scale == ONE_SIZE else Render.from_arrays("lr", rgb=images[f"lrhs_x{scale}"])
    fused = fuse(lr, hr, model).rgb
    floor, ceiling = SCORES[name]
    assert psnr(fused, images["reference"]) > floor - 0.2
    assert relmse(fused, images["reference"]) < 1.1 * ceiling
    enlarged = lr.layers["rgb"].repeat(scale, 0).repeat(scale, 1)
    assert psnr(enlarged, images["reference"]) < floor - 1.5
