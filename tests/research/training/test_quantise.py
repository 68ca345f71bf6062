# SPDX-License-Identifier: Apache-2.0
"""Quantisation: the choice of weights and slices, and the graph."""

from __future__ import annotations

import numpy as np
import pytest

from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.runtime import load_network
from tests.conftest import noisy, picture

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from research.training.encoding import pu_encode  # noqa: E402
from research.training.oidn import LARGE, run_unet  # noqa: E402
from research.training.quantise import gptq  # noqa: E402
from research.training.quantise.codes import INPUT_CHANNELS, OUTPUT_SLICES, denoiser_codes  # noqa: E402
from research.training.quantise.graph import COPIES, Graph, Nodes  # noqa: E402
from research.training.quantise.layers import varied  # noqa: E402


def codes_of(image, noise=0.3):
    """Codes of a picture (h, w, 3) with an albedo and a normal."""
    colour, albedo = (
        torch.from_numpy(values).permute(2, 0, 1)[None] for values in (encode_radiance(image, 1.0), image.clip(0, 1))
    )
    normal = torch.tensor([0.6, -0.8, 0.0])[None, :, None, None].expand_as(albedo)
    return denoiser_codes(colour, torch.full_like(albedo[:, :1], noise), albedo, normal)


def test_the_slices_of_a_value_add_up_to_it():
    """Of colours; other values have a code each."""
    clean = picture(16, 32)
    clean[0, 0] = 0, 1, 60000
    codes = codes_of(clean, noise=0.25)
    assert codes.shape == (1, INPUT_CHANNELS, 16, 32) and codes.min() >= 0 and codes.max() <= 255
    slices = codes[0, :9].unflatten(0, (3, 3)).sum(dim=1).permute(1, 2, 0).numpy() / (3 * 255)
    np.testing.assert_allclose(slices, pu_encode(torch.from_numpy(clean).double()).numpy(), atol=0.6 / (3 * 255))
    rest = codes[0, 9:].permute(1, 2, 0).numpy() / 255
    np.testing.assert_allclose(rest[..., :3], clean.clip(0, 1), atol=0.6 / 255)
    np.testing.assert_allclose(rest[..., 3:6] * 2 - 1, np.broadcast_to([0.6, -0.8, 0], clean.shape), atol=1.01 / 255)
    np.testing.assert_allclose(rest[..., 6], 0.25, atol=0.6 / 255)


@pytest.mark.parametrize("shape", [(1, 3, 16, 16), (1, 16, 32, 3)])
def test_a_table_is_looked_up_for_every_pixel(tmp_path, shape):
    table = np.linspace(5, 7, 100, dtype=np.float32)
    entries = np.random.default_rng(0).integers(0, len(table), shape).astype(np.int32)
    assert entries.size % COPIES == 0
    nodes = Nodes()
    nodes.look_up(nodes.constant("table", table), "entries", "found")
    info = onnx.helper.make_tensor_value_info
    kinds = onnx.TensorProto.INT32, onnx.TensorProto.FLOAT
    ends = [info(name, kind, [None] * 4) for name, kind in zip(("entries", "found"), kinds, strict=True)]
    onnx.save(nodes.finished("table", ends[:1], ends[1:]), tmp_path / "table.onnx")
    found = load_network(tmp_path / "table.onnx", 2).run(["found"], {"entries": entries})[0]
    np.testing.assert_array_equal(found, table[entries])


def test_gptq_beats_rounding_to_the_nearest_step():
    random = torch.Generator().manual_seed(0)
    mixing = torch.randn(36, 36, generator=random)
    inputs = (torch.randn(4000, 36, generator=random) @ mixing).relu()
    weights = torch.randn(5, 37, generator=random)
    outputs = inputs @ weights[:, :36].T + weights[:, 36]

    def error(chosen, step, bias):
        return float((inputs @ (chosen * step[:, None]).T + bias - outputs).square().mean())

    x = torch.cat([inputs, torch.ones(len(inputs), 1)], dim=1).double()
    chosen, step, bias = gptq.gptq(x.T @ x / len(x), x.T @ outputs.double() / len(x), len(x), weights)
    assert chosen.abs().max() <= 127
    pairs = chosen.reshape(5, 2, 2, 9)
    assert pairs.clamp_min(0).sum(2).max() <= 128
    assert pairs.clamp_max(0).sum(2).min() >= -128
    torch.testing.assert_close(chosen, chosen.round())
    nearest = (weights[:, :36] / step[:, None]).round()
    assert error(chosen, step, bias) < 0.6 * error(nearest, step, weights[:, 36])


def test_slices_go_to_the_channels_that_make_the_most_noise():
    """They have large values, or the largest weight of a row, which decides how finely the whole row is rounded."""
    weights = torch.full((6, 4, 3, 3), 0.1)
    weights[:, 3] = 0
    tops = torch.tensor([4.0, 1.0, 1.0, 8.0])
    assert gptq.slices_per_channel(tops, weights, torch.ones(6), 3).tolist() == [4, 1, 1, 1]
    weights[0, 1] = 1.0  # one of six rows, and the only one that counts
    gain = torch.tensor([1.0, 0, 0, 0, 0, 0])
    assert gptq.slices_per_channel(torch.ones(4), weights, gain, 6).tolist() == [1, 7, 1, 1]


@pytest.mark.parametrize(("name", "largest"), [("dec_conv2b", 2.0), ("dec_conv1b", 1.0), ("enc_conv2b", 1.0)])
def test_lower_levels_of_the_decoder_have_room_for_brighter_values(name, largest):
    """Twice the brightest value of the calibration fits into their codes. Other layers end at that value."""
    generator = torch.Generator().manual_seed(0)
    weights = {f"{name}.weight": torch.zeros(16, 16, 3, 3), f"{name}.bias": torch.zeros(16)}
    weights[f"{name}.weight"][range(16), range(16), 1, 1] = 1.0
    if name in LARGE.up[-1]:
        weights |= {f"{LARGE.last}.{kind}": torch.ones(size) for kind, size in (("weight", (3, 16, 3, 3)), ("bias", 3))}
    codes = torch.randint(0, 256, (1, 16, 80, 80), generator=generator).float()
    codes[:, :, 0, 0] = 255
    layout = gptq.CodeLayout(torch.full((16,), 1 / 255), torch.arange(16))
    fit = gptq.Fit(LARGE, weights)
    found = fit.conv(name, gptq.Activations([codes / 255], [codes], layout)).layout
    reached = found.dequantise(torch.full((len(found.scale), 1, 1), 255.0))
    torch.testing.assert_close(reached, torch.full_like(reached, largest), rtol=0.02, atol=0)


def test_calibration_sees_bright_and_black_albedos():
    """Other images, colours and normals stay as they are."""
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(1, 9, 8, 8, generator=generator) for _ in range(8)]
    found = varied(images)
    for index, (before, after) in enumerate(zip(images, found, strict=True)):
        torch.testing.assert_close(after[:, :3], before[:, :3])
        torch.testing.assert_close(after[:, 6:], before[:, 6:])
        albedo = after[:, 3:6]
        assert index % 2 == 0 or (albedo >= before[:, 3:6]).all()
        assert (index % 4 == 2) == (not albedo.any())
        assert index % 4 != 0 or (albedo == before[:, 3:6]).all()


def in_integers(layer, codes):
    """A layer whose products are summed in integers, as ONNX Runtime does."""
    source = layer.outputs.source_channel
    steps = layer.step[source]
    bias = (layer.bias / layer.step).round()[source] - (layer.offset / steps).round()
    sums = torch.nn.functional.conv2d(codes.double(), layer.weights[source].double(), bias.double(), padding=1)
    return (sums.float() * (steps / layer.outputs.scale)[:, None, None]).round().clamp(0, 255)


def test_the_graph_computes_what_was_fitted(tmp_path):
    """ONNX Runtime computes the same codes as PyTorch, for a small network."""
    shape, random = LARGE, torch.Generator().manual_seed(0)
    weights: dict[str, torch.Tensor] = {}

    def conv(name, channels):
        out = 3 if name == shape.last else 8
        scale = (2 / (9 * channels)) ** 0.5
        weights[f"{name}.weight"] = torch.randn(out, channels, 3, 3, generator=random) * scale
        weights[f"{name}.bias"] = 0.1 * torch.rand(out, generator=random)
        return out

    def same(channels):
        return channels

    run_unet(shape, [10], conv, same, same, lambda one, other: one + other)
    drawn = [codes_of(noisy(picture(64, 48), 4, seed)) for seed in range(2)]
    fit = gptq.quantise_denoiser(shape, weights, drawn)
    onnx.save(Graph(fit).model(), tmp_path / "base.onnx")
    session = load_network(tmp_path / "base.onnx", 1)
    codes = drawn[0]
    found = session.run(["codes"], {"layers": codes[0].permute(1, 2, 0).numpy().astype(np.uint8)[None]})[0][0]

    expected = run_unet(
        shape,
        [codes],
        lambda name, x: in_integers(fit.layers[name], x),
        lambda x: torch.nn.functional.max_pool2d(x, 2),
        lambda x: torch.nn.functional.interpolate(x, scale_factor=2),
        lambda one, other: torch.cat([one, other], dim=1),
    )
    slices = expected[0, : 3 * OUTPUT_SLICES].unflatten(0, (-1, 3)).sum(dim=0).permute(1, 2, 0).numpy()
    assert np.ptp(slices) > 100
    np.testing.assert_array_equal(found, slices)
