# SPDX-License-Identifier: Apache-2.0
"""Whole models: what they compute before and after their network."""

from __future__ import annotations

import numpy as np
import pytest

from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.contract import NO_DENOISER, SCALES, Contract
from oiio_msspl.model.encoding import MAX_RADIANCE, encode_radiance
from tests.conftest import noisy, picture

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from research.training.encoding import packed  # noqa: E402
from research.training.render_mean import NOISE_GAIN, mean_of_renders  # noqa: E402
from research.training.whole_model import Enter, Leave, example  # noqa: E402
from tests.research.training.extracted import network_of  # noqa: E402


def tensor(image):
    return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]


def test_noise_is_estimated_from_how_far_the_renders_differ():
    """Of the mean of both, on average, whatever either render's share of samples."""
    clean = 0.5 + 0.3 * picture(192, 192)
    aov = tensor(np.ones_like(clean))
    for spp in ((8, 8), (24, 8)):
        lrhs, hrls = (tensor(noisy(clean, n, seed)) for seed, n in enumerate(spp))
        share = torch.tensor(spp[0] / sum(spp))
        colour, noise, *_ = mean_of_renders({"rgb": lrhs}, {"rgb": hrls, "albedo": aov, "normal": aov}, {"rgb": share})
        error = (colour - tensor(encode_radiance(clean, 1.0))).abs().mean()
        assert float(noise.mean()) / NOISE_GAIN == pytest.approx(float(error), rel=0.1)
        assert 0 < noise.min() <= noise.max() <= 1


def test_the_layers_of_the_lrhs_take_noise_out_of_the_means():
    """By as many samples as it has."""
    clean = 0.3 + 0.4 * picture(192, 192).clip(0, 1)
    low, half = box_downsample(clean, 2), torch.tensor(0.5)
    hrls = {"rgb": tensor(clean), "albedo": tensor(noisy(clean, 16)), "normal": tensor(clean)}
    lrhs = {"rgb": tensor(low), "albedo": tensor(box_downsample(noisy(clean, 16, seed=1), 2))}
    errors = []
    for names in (["rgb"], ["rgb", "albedo"]):
        read = {name: lrhs[name] for name in names}
        _, _, albedo, normal = mean_of_renders(read, hrls, dict.fromkeys(names, half))
        errors.append(float((albedo - tensor(low)).square().mean()))
        torch.testing.assert_close(normal, tensor(low))
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.15)


def test_features_are_encoded_as_in_training():
    contract = Contract(name="paper-x2", scale=2, denoiser=NO_DENOISER)
    inputs = example(contract, 8, 12) | {"exposure": torch.tensor(3.0)}
    inputs["hrls.rgb"][..., :4, :4] = 1e9
    lrhs, hrls = Enter(contract)(list(inputs.values()))
    arrays = {name: values[0].permute(1, 2, 0).numpy() for name, values in inputs.items() if values.ndim}
    layers = {name.removeprefix("hrls."): image for name, image in arrays.items() if name.startswith("hrls")}
    np.testing.assert_allclose(hrls[0].permute(1, 2, 0), packed(layers, 3.0), atol=1e-6)
    np.testing.assert_allclose(lrhs[0].permute(1, 2, 0), encode_radiance(arrays["lrhs.rgb"], 3.0), atol=1e-6)


@pytest.mark.parametrize("exposure", [2e-34, 1e-3, 1.0, 1e38])
def test_what_is_encoded_can_be_decoded(exposure):
    linear = torch.logspace(-6, np.log10(MAX_RADIANCE), 300)[None, None, :, None].repeat(1, 3, 1, 1)
    encoded = tensor(encode_radiance(linear[0].permute(1, 2, 0).numpy(), 1.0))
    decoded = Leave()(encoded, torch.tensor(exposure)) * exposure
    torch.testing.assert_close(decoded, linear, rtol=2e-4, atol=1e-7)
    assert torch.isfinite(Leave()(torch.full((1, 3, 2, 2), 1e9), torch.tensor(exposure))).all()


@pytest.mark.parametrize("family", ["paper", "joint"])
@pytest.mark.parametrize("scale", SCALES)
def test_the_network_can_be_taken_out_of_a_model(family, scale):
    """To be part of another one. It has all operators of the network, and no other inputs."""
    model = onnx.load(find_model(scale, family))
    network = network_of(model)
    onnx.checker.check_model(network, full_check=True)
    assert [value.name for value in network.graph.input] == ["lrhs", "hrls"]
    assert network.graph.output[0].name == "fused"
    convolutions = [node for node in model.graph.node if "Conv" in node.op_type]
    inside = [node for node in network.graph.node if "Conv" in node.op_type]
    assert 0 < len(inside) == sum(not node.name.startswith("denoiser.") for node in convolutions)
