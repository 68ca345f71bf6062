# SPDX-License-Identifier: Apache-2.0
"""The models for renders of one size and for little noise, which are made out of those for pairs."""

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("pyoidn")

import onnx
import torch

from oiio_msspl.model.catalogue import QUALITIES, WEIGHTS
from oiio_msspl.model.contract import CLEAN, ONE_SIZE, SCALES, SPREAD, Contract
from oiio_msspl.model.devices import gpu_file
from oiio_msspl.model.session import Session
from research.training.encoding import log_decode, log_encode
from research.training.same_size import Draw, clean_pair_model, same_size_model

FAMILIES = [family + noise for family in QUALITIES.values() for noise in ("", SPREAD)]
CLEAN_FAMILIES = [QUALITIES[quality] + CLEAN for quality in ("balanced", "best")]
CLEAN_PAIRS = [*CLEAN_FAMILIES, *(QUALITIES[quality] + SPREAD + CLEAN for quality in ("balanced", "best"))]


@pytest.mark.parametrize("family", [QUALITIES["fast"] + SPREAD, QUALITIES["best"], *CLEAN_FAMILIES])
def test_the_files_are_those_that_are_made_from_the_model_for_pairs(family):
    pairs = WEIGHTS / f"{family.removesuffix(CLEAN)}-x2.onnx"
    for path in (pairs, gpu_file(pairs)):
        _check_equal(path.with_name(f"{family}-x1.onnx"), same_size_model(path, family.endswith(CLEAN)))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("family", CLEAN_PAIRS)
def test_the_files_for_pairs_with_little_noise_are_those_that_are_made(family, scale):
    pairs = WEIGHTS / f"{family.removesuffix(CLEAN)}-x{scale}.onnx"
    for path in (pairs, gpu_file(pairs)):
        at_x2 = path.with_name(f"{family.removesuffix(CLEAN)}-x2.onnx")
        one_size = same_size_model(at_x2, clean=family in CLEAN_FAMILIES)
        _check_equal(path.with_name(f"{family}-x{scale}.onnx"), clean_pair_model(path, one_size))


def _check_equal(file, made):
    shipped = onnx.load(file)
    onnx.load_external_data_for_model(made, str(file.parent))
    assert list(shipped.graph.node) == list(made.graph.node)
    assert list(shipped.graph.input) == list(made.graph.input)
    assert _constants(shipped) == _constants(made)


def _constants(model):
    """Those that lie in a file of weights, and those that lie in the graph."""
    return {tensor.name: onnx.numpy_helper.to_array(tensor).tobytes() for tensor in model.graph.initializer}


@pytest.mark.parametrize("family", [*FAMILIES, *CLEAN_FAMILIES])
def test_two_renders_are_denoised_together(family):
    """Their mean, and better than one of them, which is given as both with shares of 0."""
    rng = np.random.default_rng(0)
    clean = np.linspace(0.1, 0.9, 96)[:, None, None] * np.linspace(0.2, 1, 160)[None, :, None] * np.ones(3)
    aov = np.full(clean.shape, 0.5, np.float32)
    first, second = (
        {"rgb": (clean * rng.gamma(4, 1 / 4, clean.shape)).astype(np.float32), "albedo": aov, "normal": aov}
        for _ in range(2)
    )
    path = WEIGHTS / f"{family}-x1.onnx"
    assert Contract.of_file(path).scale == ONE_SIZE
    session = Session(path, threads=1)
    both = session.run(first, second, 1.0, dict.fromkeys(("rgb", "albedo", "normal"), 0.5))["fused"]
    one = session.run(second, second, 1.0, {})["fused"]
    noise, error, error_of_one = (np.abs(image - clean).mean() for image in (second["rgb"], both, one))
    assert error < error_of_one < 0.3 * noise


@pytest.mark.parametrize(("spread", "powers"), [(False, (1.0, 0.6)), (True, (0.3, 0.15))])
def test_the_brightness_is_drawn_to_that_of_the_mean_by_the_share_of_the_lrhs(spread, powers):
    """It is the mean's where all of its samples are the LRHS's, except if a filter has spread the noise."""
    scale = 2
    mean, hrls = (torch.full((1, 3, 8 * n, 8 * n), value) for n, value in ((1, 0.2), (scale, 0.1)))
    mean[:, :, 4:] = 0.1
    brightness = [
        log_decode(Draw(scale, spread)(log_encode(mean), log_encode(hrls), torch.tensor(share)))[0, 0, 0, 0]
        for share in (1.0, 0.5)
    ]
    np.testing.assert_allclose(brightness, [0.1 * (0.22 / 0.12) ** power for power in powers], rtol=1e-5)
