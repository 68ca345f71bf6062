# SPDX-License-Identifier: Apache-2.0
"""The model of two renders of one size, which is cut out of a model for pairs."""

import numpy as np
import onnx
import pytest

from oiio_msspl.model.catalogue import WEIGHTS
from oiio_msspl.model.contract import Contract
from oiio_msspl.model.devices import gpu_file
from oiio_msspl.model.session import Session

NAMES = {"mean-x1": "joint-small-x2", "mean-spread-x1": "joint-small-spread-x2"}


@pytest.mark.parametrize("name", NAMES)
def test_the_files_are_those_that_are_cut_from_the_model_for_pairs(name):
    mean_model = pytest.importorskip("research.training.mean_model").mean_model
    for path in (WEIGHTS / f"{NAMES[name]}.onnx", gpu_file(WEIGHTS / f"{NAMES[name]}.onnx")):
        shipped = onnx.load(path.with_name(f"{name}.onnx"), load_external_data=False)
        assert shipped.SerializeToString(deterministic=True) == mean_model(path).SerializeToString(deterministic=True)


@pytest.mark.parametrize("name", NAMES)
def test_both_renders_are_denoised_together(name):
    """Alike on either device, with a contract of scale 1."""
    rng = np.random.default_rng(0)
    clean = np.linspace(0.1, 0.9, 96)[:, None, None] * np.linspace(0.2, 1, 160)[None, :, None] * np.ones(3)
    aov = np.full(clean.shape, 0.5, np.float32)
    renders = [
        {"rgb": (clean * rng.gamma(4, 1 / 4, clean.shape)).astype(np.float32), "albedo": aov, "normal": aov}
        for _ in range(2)
    ]
    path = WEIGHTS / f"{name}.onnx"
    assert Contract.of_file(path).scale == 1
    shares = dict.fromkeys(("rgb", "albedo", "normal"), 0.5)
    on_cpu, on_gpu = (Session(file).run(*renders, 1.0, shares)["fused"] for file in (path, gpu_file(path)))
    mean = (renders[0]["rgb"] + renders[1]["rgb"]) / 2
    assert np.abs(on_cpu - clean).mean() < 0.2 * np.abs(mean - clean).mean()
    assert np.abs(on_cpu - on_gpu).mean() < 0.1 * np.abs(mean - clean).mean()
