# SPDX-License-Identifier: Apache-2.0
"""The joint network and its denoiser of both renders' mean: Open Image Denoise's networks, fine-tuned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from oiio_msspl.arrays import box_downsample
from oiio_msspl.model.contract import MEAN_DENOISER, SMALL_MEAN_DENOISER, Contract
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.mean_denoiser import WEIGHTS
from oiio_msspl.model.mean_denoiser import MeanDenoiser as QuantisedMeanDenoiser
from oiio_msspl.model.render_mean import denoiser_images, mean_of_renders
from oiio_msspl.model.runtime import load_network
from tests.conftest import noisy, picture

pytest.importorskip("pyoidn")
torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from benchmarks.oidn import run_filter  # noqa: E402
from training import average, checkpoints, export, prune  # noqa: E402
from training.joint import JointFusion, with_mean  # noqa: E402
from training.mean_denoiser import STARTS, MeanDenoiser  # noqa: E402
from training.oidn import BASE  # noqa: E402
from training.quantise.__main__ import CHECKPOINT  # noqa: E402

#: Open Image Denoise's quality whose networks each size starts from.
QUALITY = {"small": "fast", "usual": "high"}


def pairs(scale, prepare, count=2, size=64):
    """Noisy input pairs of a network."""
    result = []
    for seed in range(count):
        clean = picture(size, size)
        values = [encode_radiance(noisy(clean, 4, seed + i), 1.0) for i in range(2)]
        normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
        hrls = np.concatenate([values[0], clean.clip(0, 1), normal], axis=-1)
        images = prepare(box_downsample(values[1], scale), hrls)
        result.append(tuple(torch.from_numpy(np.ascontiguousarray(i.transpose(2, 0, 1)[None])) for i in images))
    return result


def open_image_denoise(images, **flags):
    """OIDN on encoded images, with their exposure: log-encoded (h, w, 3)."""
    colour = decode_radiance(images["colour"], 1.0)
    return encode_radiance(
        run_filter(
            {"color": colour, "albedo": images["albedo"], "normal": images["normal"]},
            hdr=True,
            input_scale=1.0,
            **flags,
        ),
        1.0,
    )


@pytest.mark.parametrize("size", QUALITY)
def test_a_new_network_is_open_image_denoise(size):
    network = JointFusion(size=size).eval()
    for head in network.heads:  # blend with the U-Net's result only
        head.weight.data.zero_()
        head.bias.data[1] = 60.0
    ((lrhs, hrls),) = pairs(2, QuantisedMeanDenoiser(threads=1), count=1)
    with torch.inference_mode():
        fused = network.fuse(lrhs, hrls)[0][0].permute(1, 2, 0).numpy()
    expected = open_image_denoise(denoiser_images(hrls[0].permute(1, 2, 0).numpy()), quality=QUALITY[size])
    assert np.abs(fused - expected).mean() < 1e-3
    assert not any(parameter.any() for parameter in network.differences())


@pytest.mark.parametrize(("scale", "size"), [(8, "usual"), (2, "small")])
def test_the_graph_computes_what_the_network_does(scale, size, tmp_path):
    """With random differences and pruned channels."""
    torch.manual_seed(0)
    ups = [name for level in BASE.up for name in level]
    network = JointFusion(kept={name: list(range(i, 16 + i)) for i, name in enumerate(ups)}, size=size).eval()
    for name, parameter in network.named_parameters():
        parameter.data += (0.003 if name.startswith("convs") else 0.02) * torch.randn_like(parameter)
    state = {"architecture": "joint", "training_spp": {str(scale): {}}, "provenance": {}}
    contract = export.contract_of(network, scale, f"joint-x{scale}", 128 // scale, state)
    drawn = pairs(scale, QuantisedMeanDenoiser(threads=1))
    path = tmp_path / "joint.onnx"
    onnx.save(export.joint_to_onnx(network, contract, drawn), path)
    contract = Contract.of_file(path)
    assert (contract.denoiser, contract.alignment) == (network.denoiser(scale), 16)
    assert "Open Image Denoise" in contract.provenance["initial_weights"]
    model = load_network(path)
    for lrhs, hrls in drawn:
        fused, log_error = model.run(["fused", "log_error"], {"lrhs": lrhs.numpy(), "hrls": hrls.numpy()})
        with torch.inference_mode():
            expected = [values.numpy() for values in network.fuse(lrhs, hrls)]
        assert np.abs(fused - expected[0]).mean() < 0.2 * np.abs(hrls[:, :3].numpy() - expected[0]).mean()
        assert np.abs(log_error - expected[1]).mean() < 0.1


def test_pruning_channels_that_nothing_reads_changes_nothing():
    torch.manual_seed(0)
    network = JointFusion().eval()
    idle = torch.tensor([3, 20, 40])
    reader = network.convs["dec_conv1a"]
    reader.weight.data[:, idle] = -reader.pretrained_weight[:, idle]
    head = network.heads[1]
    head.weight.data[:, idle] = 0
    drawn = pairs(2, with_mean, count=1)
    pruned = prune.pruned(network, "dec_conv2b", 61, [{"lrhs": lrhs, "hrls": hrls} for lrhs, hrls in drawn]).eval()
    assert len(pruned.kept["dec_conv2b"]) == 61
    assert pruned.convs["dec_conv2b"].weight.shape[0] == pruned.heads[1].in_channels == 61
    with torch.inference_mode():
        for before, after in zip(network(*drawn[0]), pruned(*drawn[0]), strict=True):
            torch.testing.assert_close(before, after, atol=1e-4, rtol=0)
    with pytest.raises(SystemExit, match="only convolutions on the way up"):
        prune.pruned(network, "enc_conv1", 16, [])


def test_the_mean_may_include_the_initial_state():
    network = JointFusion()
    bias = network.heads[0].bias.detach().clone()
    for parameter in network.parameters():
        parameter.data += 0.5
    state = {"architecture": "joint", "config": network.config, "ema": network.state_dict()}
    mean = average.mean([state | {"provenance": {}}], initial=(0.25, 0.75))
    assert mean["provenance"] == {"share_of_initial_state": [0.25, 0.75]}
    assert (mean["ema"]["convs.enc_conv0.weight"] == 0.375).all()
    assert (mean["ema"]["mean_denoiser.convs.enc_conv1a.extra"] == 0.125).all()
    torch.testing.assert_close(mean["ema"]["heads.0.bias"].float(), bias + 0.375)
    torch.testing.assert_close(mean["ema"]["error.bias"], network.error.bias.half())
    with pytest.raises(SystemExit, match="only a joint network"):
        average.mean([state | {"architecture": "paper", "config": {}, "provenance": {}}], initial=(0.25, 0))


@pytest.mark.parametrize("size", QUALITY)
def test_a_new_mean_denoiser_is_open_image_denoise(size):
    """The weights of the estimated noise start at zero."""
    ((lrhs, hrls),) = pairs(2, lambda lrhs, hrls: (lrhs, hrls), count=1, size=96)
    low, high = (image[0].permute(1, 2, 0).numpy() for image in (lrhs, hrls))
    layers = mean_of_renders(low, denoiser_images(high))
    found = MeanDenoiser(size).eval().denoise(layers)
    del layers["noise"]
    expected = open_image_denoise(layers, cleanAux=True, quality=QUALITY[size])
    assert np.abs(found - expected).mean() < 1e-3


@pytest.mark.parametrize(
    ("checkpoint", "denoiser", "share"),
    [("joint", MEAN_DENOISER, 0.1), ("joint_small", SMALL_MEAN_DENOISER, 0.125)],
)
def test_the_shipped_mean_denoiser_agrees_with_the_checkpoint(checkpoint, denoiser, share):
    """To this share of the noise, also for sides that are no multiple of 16."""
    ((lrhs, hrls),) = pairs(2, lambda lrhs, hrls: (lrhs, hrls), count=1, size=80)
    low, high = (image[0].permute(1, 2, 0).numpy() for image in (lrhs, hrls))
    layers = mean_of_renders(low, denoiser_images(high))
    network, _ = checkpoints.load(CHECKPOINT.with_stem(checkpoint))
    expected = network.mean_denoiser.denoise(layers)
    found = QuantisedMeanDenoiser(threads=1, path=WEIGHTS[denoiser])(low, high)[0][..., 3:]
    assert np.abs(found - expected).mean() < share * np.abs(layers["colour"] - expected).mean()


def test_a_run_starts_from_a_pruned_checkpoint_with_older_names(tmp_path: Path):
    network = JointFusion(kept={"dec_conv1a": list(range(48))})
    network.convs["enc_conv2"].extra.data.fill_(0.5)
    older = {name.replace(".extra", ".more"): value for name, value in network.state_dict().items()}
    torch.save({"ema": older, "config": network.config}, tmp_path / "earlier.pt")
    other = JointFusion(kept=network.kept)
    checkpoints.warm_start(other, tmp_path / "earlier.pt")
    assert (other.convs["enc_conv2"].extra == 0.5).all()
    differences, everything = len(list(other.differences())), len(list(other.parameters()))
    assert differences == 2 * (16 + 19 - len(STARTS["usual"].frozen))
    assert everything == differences + 2 + 2 + 2 * 5


def test_the_predicted_error_has_no_gradient_into_the_features():
    network = JointFusion(size="small")
    ((lrhs, hrls),) = pairs(2, QuantisedMeanDenoiser(threads=1), count=1)
    _, log_error = network.fuse(lrhs, hrls)
    log_error.sum().backward()
    assert {name for name, p in network.named_parameters() if p.grad is not None} == {"error.weight", "error.bias"}
