# SPDX-License-Identifier: Apache-2.0
"""The joint network and its denoiser of both renders' mean: Open Image Denoise's networks, fine-tuned."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.runtime import load_network
from tests.conftest import noisy, picture

pytest.importorskip("pyoidn")
torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from research.benchmarks.oidn import run_filter  # noqa: E402
from research.training import CHECKPOINTS, average, checkpoints, export, prune  # noqa: E402
from research.training.denoisers import LOWEST, STARTS, MeanDenoiser, with_denoised_mean  # noqa: E402
from research.training.joint import JointFusion  # noqa: E402
from research.training.oidn import BASE  # noqa: E402
from research.training.quantise.__main__ import CHECKPOINT, run_denoiser  # noqa: E402
from research.training.quantise.codes import denoiser_codes  # noqa: E402
from research.training.render_mean import with_mean  # noqa: E402
from research.training.whole_model import denoiser_file  # noqa: E402
from tests.research.training.extracted import network_of  # noqa: E402

#: Open Image Denoise's quality whose networks each size starts from.
QUALITY = {"small": "fast", "usual": "high", "large": "high"}


def pairs(scale, prepare, count=2, size=64):
    """Noisy input pairs of a network."""
    result = []
    for seed in range(count):
        clean = picture(size, size)
        values = [encode_radiance(noisy(clean, 4, seed + i), 1.0) for i in range(2)]
        normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
        hrls = np.concatenate([values[0], clean.clip(0, 1), normal], axis=-1)
        images = box_downsample(values[1], scale), hrls
        low, high = (torch.from_numpy(np.ascontiguousarray(i.transpose(2, 0, 1)[None])) for i in images)
        result.append((prepare(low, high), high))
    return result


@pytest.fixture(scope="module")
def denoised_mean():
    """Appends the mean of both renders, which `joint` has denoised."""
    return partial(with_denoised_mean, checkpoints.load(CHECKPOINT)[0].mean_denoiser)


def means(size, scale=2):
    """Colour, noise, albedo and normal of both renders' mean, (1, c, size, size)."""
    ((lrhs, hrls),) = pairs(scale, with_mean, count=1, size=scale * size)
    aovs = torch.nn.functional.avg_pool2d(hrls[:, 3:9], scale)
    return lrhs[:, 3:6], lrhs[:, 6:7], aovs[:, :3], aovs[:, 3:]


def open_image_denoise(colour, albedo, normal, **flags):
    """OIDN on encoded images (1, 3, h, w), with their exposure: log-encoded (h, w, 3)."""
    arrays = [np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()) for image in (colour, albedo, normal)]
    images = {"color": decode_radiance(arrays[0], 1.0), "albedo": arrays[1], "normal": arrays[2]}
    return encode_radiance(run_filter(images, hdr=True, input_scale=1.0, **flags), 1.0)


@pytest.mark.parametrize("size", QUALITY)
def test_a_new_network_is_open_image_denoise(size, denoised_mean):
    network = JointFusion(size=size).eval()
    for head in network.heads:  # blend with the U-Net's result only
        head.weight.data.zero_()
        head.bias.data[1] = 60.0
    ((lrhs, hrls),) = pairs(2, denoised_mean, count=1)
    with torch.inference_mode():
        fused = network.fuse(lrhs, hrls)[0][0].permute(1, 2, 0).numpy()
    images = network.prepared(hrls).split(3, dim=1)
    expected = open_image_denoise(*images[:3], quality=QUALITY[size], cleanAux=size == "large")
    assert np.abs(fused - expected).mean() < 1e-3
    assert not any(parameter.any() for parameter in network.differences())


@pytest.mark.parametrize(("scale", "size"), [(8, "usual"), (2, "small"), (4, "large")])
def test_the_graph_computes_what_the_network_does(scale, size, tmp_path, denoised_mean):
    """With random differences and pruned channels."""
    torch.manual_seed(0)
    ups = [name for level in BASE.up for name in level]
    kept = {name: list(range(i, 16 + i)) for i, name in enumerate(ups)} if size != "large" else {}
    network = JointFusion(kept, size).eval()
    for name, parameter in network.named_parameters():
        parameter.data += (0.003 if name.startswith("convs") else 0.02) * torch.randn_like(parameter)
    state = {"architecture": "joint", "training_spp": {str(scale): {}}, "provenance": {}}
    name = {"usual": "joint"}.get(size, f"joint-{size}")
    contract = export.contract_of(network, scale, f"{name}-x{scale}", 128 // scale, state)
    drawn = pairs(scale, denoised_mean, size=16 * scale)
    path = tmp_path / "joint.onnx"
    onnx.save(export.joint_to_onnx(network, [contract], drawn)[0], path)
    assert (contract.denoiser, contract.alignment) == (network.denoiser(scale), 16)
    assert "Open Image Denoise" in contract.provenance["initial_weights"]
    model = load_network(path)
    for lrhs, hrls in drawn:
        fused, log_error = model.run(["fused", "log_error"], {"lrhs": lrhs.numpy(), "hrls": hrls.numpy()})
        with torch.inference_mode():
            expected = [values.numpy() for values in network.fuse(lrhs, hrls)]
        assert np.abs(fused - expected[0]).mean() < 0.2 * np.abs(hrls[:, :3].numpy() - expected[0]).mean()
        assert np.abs(log_error - expected[1]).mean() < 0.1


@pytest.mark.parametrize(
    ("family", "scale"),
    [("joint-small", 2), ("joint-spread", 4), ("joint-large", 2), ("joint-large", 8), ("joint-large-spread", 4)],
)
def test_the_shipped_files_agree_with_their_checkpoint(family, scale, tmp_path, denoised_mean):
    """To a fifth of the noise that is removed."""
    network, _ = checkpoints.load(CHECKPOINT.with_stem(family.replace("-", "_")))
    onnx.save(network_of(onnx.load(find_model(scale, family))), tmp_path / "network.onnx")
    model = load_network(tmp_path / "network.onnx")
    outputs = [output.name for output in model.get_outputs()]
    ((lrhs, hrls),) = pairs(scale, denoised_mean, count=1, size=16 * scale)
    found = dict(zip(outputs, model.run(outputs, {"lrhs": lrhs.numpy(), "hrls": hrls.numpy()}), strict=True))
    with torch.inference_mode():
        fused, log_error = (values.numpy() for values in network.fuse(lrhs, hrls))
        prepared = network.prepared(hrls)
    assert np.abs(found["fused"] - fused).mean() < 0.2 * np.abs(hrls[:, :3].numpy() - fused).mean()
    assert np.abs(found["log_error"] - log_error).mean() < 0.1
    assert (found.keys() == {"fused", "log_error", "albedo", "normal"}) == ("large" in family)
    if "large" in family:
        for name, expected in (("albedo", prepared[:, 3:6]), ("normal", 0.5 * prepared[:, 6:9] + 0.5)):
            assert np.abs(found[name] - expected.numpy()).mean() < 0.01


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
    spread = state | {"config": network.config | {"spread": True}, "provenance": {}}
    assert average.mean([state | {"provenance": {}}, spread])["config"]["spread"]
    with pytest.raises(SystemExit, match="only a joint network"):
        average.mean([state | {"architecture": "paper", "config": {}, "provenance": {}}], initial=(0.25, 0))


@pytest.mark.parametrize("size", STARTS)
def test_a_new_mean_denoiser_is_open_image_denoise(size):
    """The weights of the estimated noise start at zero."""
    colour, noise, albedo, normal = means(48)
    with torch.inference_mode():
        found = MeanDenoiser(size).eval()(colour, noise, albedo, normal)[0].permute(1, 2, 0).numpy()
    expected = open_image_denoise(colour, albedo, normal, cleanAux=True, quality=QUALITY[size])
    assert np.abs(found - expected).mean() < 1e-3


@pytest.mark.parametrize(
    ("checkpoint", "share"),
    [("joint", 0.1), ("joint_small", 0.125), ("joint_spread", 0.1), ("joint_small_spread", 0.125)],
)
def test_the_shipped_mean_denoiser_agrees_with_the_checkpoint(checkpoint, share):
    """To this share of the noise."""
    images = means(48)
    network, _ = checkpoints.load(CHECKPOINT.with_stem(checkpoint))
    with torch.inference_mode():
        expected = network.mean_denoiser(*images)[0].permute(1, 2, 0).numpy()
    found = run_denoiser(CHECKPOINTS / f"{denoiser_file(network.denoiser(2))}.onnx", denoiser_codes(*images))
    noisy_mean = images[0][0].permute(1, 2, 0).numpy()
    assert np.abs(found - expected).mean() < share * np.abs(noisy_mean - expected).mean()


def test_the_shipped_mean_denoiser_is_about_as_good_as_open_image_denoise():
    """In 8 bits its error is at most 1.3 times OIDN's, with prefiltered albedo."""
    size = 96
    images = means(size)
    clean = encode_radiance(box_downsample(picture(2 * size, 2 * size), 2), 1.0)
    found = run_denoiser(CHECKPOINTS / "mean_denoiser.onnx", denoiser_codes(*images))
    theirs = open_image_denoise(images[0], *images[2:], cleanAux=True)
    assert np.abs(found - clean).mean() < 1.3 * np.abs(theirs - clean).mean()


def test_a_run_starts_from_a_pruned_checkpoint_with_older_names(tmp_path: Path):
    network = JointFusion(kept={"dec_conv1a": list(range(48))})
    network.convs["enc_conv2"].extra.data.fill_(0.5)
    older = {name.replace(".extra", ".more"): value for name, value in network.state_dict().items()}
    torch.save({"ema": older, "config": network.config}, tmp_path / "earlier.pt")
    other = JointFusion(kept=network.kept)
    checkpoints.warm_start(other, tmp_path / "earlier.pt")
    assert (other.convs["enc_conv2"].extra == 0.5).all()
    differences, everything = len(other.differences()), len(list(other.parameters()))
    assert differences == 2 * (16 + 19 - len(LOWEST))
    assert everything == differences + 2 + 2 + 2 * 5


def test_the_predicted_error_has_no_gradient_into_the_features(denoised_mean):
    network = JointFusion(size="small")
    ((lrhs, hrls),) = pairs(2, denoised_mean, count=1)
    _, log_error = network.fuse(lrhs, hrls)
    log_error.sum().backward()
    assert {name for name, p in network.named_parameters() if p.grad is not None} == {"error.weight", "error.bias"}
