# SPDX-License-Identifier: Apache-2.0
"""The mix network. Needs PyTorch, but no OIDN."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: E402

from oiio_msspl.aovs.features import channel_names  # noqa: E402
from oiio_msspl.model.contract import SCALES, Contract, network_inputs  # noqa: E402
from training import train  # noqa: E402
from training.encoding import log_encode  # noqa: E402
from training.mix import MixFusion, distillation_loss, mixed  # noqa: E402

HEIGHT, WIDTH = 64, 96
#: Indices of the candidates in FINER and in COARSEST.
RESCALED, DENOISED, LIGHT, HRLS = range(4)
DENOISED_MEAN, DENOISED_HRLS, HRLS_MEAN, LRHS = range(4, 8)


@pytest.fixture
def network() -> MixFusion:
    torch.manual_seed(0)
    return MixFusion(channels=(16, 16, 16, 16)).eval()


def pair(scale: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(scale)
    return (
        torch.rand(1, 6, HEIGHT // scale, WIDTH // scale, generator=generator),
        torch.rand(1, 19, HEIGHT, WIDTH, generator=generator),
    )


def prefer(network: MixFusion, finer: int, coarsest: int = DENOISED_MEAN) -> None:
    """Set the logits so that every pixel takes one candidate, and the albedo colours all light."""
    for level, head in enumerate(network.heads):
        head.weight.data.zero_()
        choice = torch.full((8,), -40.0)
        choice[[finer, coarsest]] = 40.0
        head.bias.data = choice if level else torch.cat([choice[:4], torch.full((1,), 40.0)]).repeat_interleave(4)


@torch.inference_mode()
@pytest.mark.parametrize("scale", SCALES)
def test_one_network_serves_every_scale(network: MixFusion, scale: int) -> None:
    fused, log_error = network(*pair(scale))
    assert (fused.shape, log_error.shape) == ((1, 3, HEIGHT, WIDTH), (1, 1, HEIGHT, WIDTH))
    assert torch.isfinite(fused).all()


@torch.inference_mode()
def test_weights_are_those_of_a_softmax() -> None:
    logits = 30 * torch.randn(2, 3, 4, 5)
    images = [torch.rand(2, 3, 4, 5) for _ in range(3)]
    expected = (torch.softmax(logits, 1).unsqueeze(2) * torch.stack(images, 1)).sum(1)
    torch.testing.assert_close(mixed(logits, images), expected)


@torch.inference_mode()
@pytest.mark.parametrize("scale", SCALES)
def test_every_fine_candidate_can_be_chosen(network: MixFusion, scale: int) -> None:
    """With noisy renders of even light, a denoised HRLS that is 1.5 times too dark, and a striped albedo."""
    lrhs, hrls = pair(scale)
    stripes = 0.4 + 0.2 * (torch.arange(WIDTH) % 2).expand(1, 3, HEIGHT, WIDTH)
    light = 0.5 * torch.ones(1, 3, HEIGHT, WIDTH)
    hrls[:, 3:6] = stripes
    hrls[:, 16:] = log_encode(stripes * light / 1.5)
    lrhs[:, 3:] = log_encode(F.avg_pool2d(stripes * light, scale))
    expected = {
        RESCALED: log_encode(stripes * light),
        DENOISED: hrls[:, 16:],
        LIGHT: log_encode(stripes * light),
        HRLS: hrls[:, :3],
    }
    for choice, image in expected.items():
        prefer(network, choice)
        torch.testing.assert_close(network(lrhs, hrls)[0], image, atol=0.01, rtol=0)


@torch.inference_mode()
@pytest.mark.parametrize("scale", SCALES)
def test_every_coarse_candidate_can_be_chosen(network: MixFusion, scale: int) -> None:
    """The coarsest candidate sets the brightness of the result, if finer levels follow it."""
    lrhs, hrls = pair(scale)
    hrls[:, :3], hrls[:, 16:], lrhs[:, :3], lrhs[:, 3:] = 0.2, 0.3, 0.4, 0.35
    for choice, value in {DENOISED_MEAN: 0.35, DENOISED_HRLS: 0.3, HRLS_MEAN: 0.2, LRHS: 0.4}.items():
        prefer(network, RESCALED, choice)
        torch.testing.assert_close(network(lrhs, hrls)[0], torch.full((1, 3, HEIGHT, WIDTH), value), atol=0.01, rtol=0)


@torch.inference_mode()
def test_it_never_leaves_the_range_of_its_inputs(network: MixFusion) -> None:
    """Even with random weights and a wrong denoised HRLS, the result stays in the range of the renders around it."""
    for parameter in network.parameters():
        parameter.copy_(3 * torch.randn_like(parameter))
    lrhs, hrls = pair(4)
    hrls[:, 16:], lrhs[:, 3:] = 4.0 * hrls[:, 16:], 4.0 * lrhs[:, 3:]
    lrhs[:, :3, :8], hrls[:, :3, :32] = 0.1, 0.2
    fused, _ = network(lrhs, hrls)
    assert fused[:, :, :20].min() >= 0.1 and fused[:, :, :20].max() <= 0.2
    assert fused.max() <= 1.0


def test_distillation_loss_is_least_for_the_teachers_logits(network: MixFusion) -> None:
    """It is 0 for equal logits, ignores logits that a scale does not use, and has no gradient into the teacher."""
    lrhs, hrls = pair(4)
    logits, _ = network.predict_logits(lrhs, hrls)
    assert distillation_loss(logits, logits, coarsest=2).item() == pytest.approx(0, abs=1e-6)
    others = [logits[0] + 1, logits[1] + torch.randn(8, 1, 1), *logits[2:]]
    output, loss = train.fuse_and_distil(network, network, lrhs, hrls)
    torch.testing.assert_close(output, network(lrhs, hrls)[0])
    assert loss.item() == pytest.approx(0, abs=1e-6)
    assert distillation_loss(logits, others, coarsest=2) > 0.01
    unused = [*logits[:3], torch.randn_like(logits[3])]
    assert distillation_loss(logits, unused, coarsest=2).item() == pytest.approx(0, abs=1e-6)
    distillation_loss(logits, [each.detach() for each in others], coarsest=2).backward()
    assert network.heads[1].weight.grad.abs().max() > 0
    assert network.heads[3].weight.grad is None or not network.heads[3].weight.grad.any()


def test_its_onnx_file_agrees_with_it(network: MixFusion, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    onnx = pytest.importorskip("onnx")
    from training import export

    for head in network.heads:
        torch.nn.init.normal_(head.weight, std=0.3)
    for scale in SCALES:
        lrhs, hrls = (channel_names(features) for features in network_inputs("high"))
        contract = Contract("tiny", scale, network.multiple // scale, 32, lrhs=lrhs, hrls=hrls, denoiser="high")
        onnx.save(export.to_onnx(network, contract), tmp_path / "tiny.onnx")
        assert export.parity(network, scale, tmp_path / "tiny.onnx") < 1e-4
