# SPDX-License-Identifier: Apache-2.0
"""The ensemble: joint, Open Image Denoise's large network, and the network that weighs their results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from oiio_msspl.arrays import box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.runtime import load_network
from tests.conftest import noisy, picture

pytest.importorskip("pyoidn")
torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from benchmarks.oidn import run_filter  # noqa: E402
from training import checkpoints, ensemble  # noqa: E402
from training.encoding import from_srgb, srgb  # noqa: E402
from training.ensemble import (  # noqa: E402
    AGREED,
    BandWeights,
    EnsembleFusion,
    PlainMean,
    batches,
    evaluate,
    train,
)
from training.joint import JointFusion  # noqa: E402
from training.large import LargeDenoiser, Training  # noqa: E402
from training.quantise.__main__ import CHECKPOINT  # noqa: E402
from training.whole_model import network_of  # noqa: E402


def tensor(image):
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)[None]))


def arguments(size=64, scale=2):
    """Two results that differ, and a pair whose range holds both."""
    clean = encode_radiance(picture(size, size), 1.0)
    rng = np.random.default_rng(0)
    names = "joint", "large", "albedo", "normal"
    images = {name: clean + np.float32(0.05) * rng.random(clean.shape, np.float32) for name in names}
    low = box_downsample(clean, scale)
    lrhs = np.concatenate([low + np.float32(0.2), low - np.float32(0.2)], axis=-1)
    hrls = np.concatenate([clean, clean, clean], axis=-1)
    hrls[::2, :, :3] += np.float32(0.5)
    hrls[1::2, :, :3] -= np.float32(0.5)
    error = np.full((size, size, 1), -2, np.float32)
    return {
        name: tensor(image) for name, image in (images | {"lrhs": lrhs, "hrls": hrls, "joint_error": error}).items()
    }


def test_new_weights_give_the_mean_of_both_results():
    given = arguments()
    with torch.no_grad():
        fused, log_error = BandWeights()(**given)
    torch.testing.assert_close(fused, (given["joint"] + given["large"]) / 2)
    torch.testing.assert_close(log_error, given["joint_error"])


def test_a_plain_mean_keeps_to_the_range_of_the_renders():
    given = arguments()
    with torch.no_grad():
        fused, log_error = PlainMean()(**given)
        torch.testing.assert_close(fused, (given["joint"] + given["large"]) / 2)
        assert log_error is given["joint_error"]
        brighter, _ = PlainMean()(**given | {"large": given["large"] + 50})
    assert brighter.max() <= max(given["hrls"][:, :3].max(), given["lrhs"].max())


@pytest.mark.parametrize(("bias", "name"), [(-20.0, "joint"), (20.0, "large")])
def test_weights_of_zero_and_one_give_one_of_the_results(bias, name):
    given, network = arguments(), BandWeights()
    with torch.no_grad():
        network.weights.bias.fill_(bias)
        torch.testing.assert_close(network(**given)[0], given[name])


def test_the_result_keeps_to_the_range_of_the_renders():
    given = arguments()
    given["large"] = given["large"] + 5
    with torch.no_grad():
        fused, _ = BandWeights()(**given)
    assert fused.max() <= max(given["hrls"][:, :3].max(), given["lrhs"].max())


def test_details_of_one_result_cannot_darken_what_both_have():
    """Where dark lines of ``large`` are deeper than ``joint`` is bright."""
    given, network = arguments(), BandWeights()
    lines = torch.zeros_like(given["large"])
    lines[..., ::4] = 1
    given["large"], given["joint"] = 4 - 3 * lines, torch.full_like(lines, 0.5)
    # Black samples allow any darkness, and a bright LRHS any brightness.
    given["hrls"], given["lrhs"] = torch.zeros_like(given["hrls"]), torch.full_like(given["lrhs"], 5.0)
    with torch.no_grad():
        network.weights.bias.copy_(torch.tensor([20.0, 20, -20]).repeat_interleave(4))
        assert network(**given)[0].min() >= AGREED[0] * 0.5


def test_srgb_and_its_inverse():
    values = torch.linspace(0, 1, 1001)
    torch.testing.assert_close(from_srgb(srgb(values)), values)


def test_the_second_result_is_open_image_denoise_with_prefiltered_layers():
    """With base networks for albedo and normal, and the large one for colour."""
    import pyoidn

    clean = picture(64, 96)
    colour = noisy(clean, 4)
    albedo = noisy(clean.clip(0, 1), 64, seed=2).clip(0, 1)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape).copy()
    network, taken = EnsembleFusion(JointFusion(), LargeDenoiser(), BandWeights()).eval(), {}
    network.weights.register_forward_pre_hook(
        lambda _, values: taken.update(zip(("joint", "large", "albedo", "normal"), values, strict=False))
    )
    hrls = np.concatenate([encode_radiance(colour, 1.0), albedo, normal], axis=-1)
    with torch.inference_mode():
        network(torch.zeros(1, 6, 32, 48), tensor(hrls))
    large, clean_albedo, clean_normal = (taken[k][0].permute(1, 2, 0).numpy() for k in ("large", "albedo", "normal"))

    def prefiltered(name, image):
        denoiser = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
        denoiser.set_quality(pyoidn.OIDN_QUALITY_BALANCED)
        output = np.empty_like(image)
        for kind, values in ((name, image), (pyoidn.OIDN_IMAGE_OUTPUT, output)):
            denoiser.set_image(kind, values, pyoidn.OIDN_FORMAT_FLOAT3)
        denoiser.commit()
        denoiser.execute()
        return output

    device = pyoidn.Device()
    device.commit()
    layers = {"albedo": prefiltered("albedo", albedo), "normal": prefiltered("normal", normal)}
    np.testing.assert_allclose(clean_albedo, layers["albedo"], atol=1e-3)
    np.testing.assert_allclose(2 * clean_normal - 1, layers["normal"], atol=1e-3)
    expected = run_filter({"color": colour, **layers}, hdr=True, input_scale=1.0, cleanAux=True)
    np.testing.assert_allclose(decode_radiance(large, 1.0), expected, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize(("scale", "noise"), [(2, ""), (4, ""), (2, "-spread")])
def test_the_files_for_cpus_are_close_to_the_network_in_32_bits(scale, noise, tmp_path):
    """To less than a fifth of the noise that it removes."""
    clean = picture(64, 96)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    hrls = np.concatenate([encode_radiance(noisy(clean, 4), 1.0), clean.clip(0, 1), normal], axis=-1)
    low = box_downsample(clean, scale)
    lrhs = np.concatenate([encode_radiance(noisy(low, 4 * scale**2), 1.0), encode_radiance(low, 1.0)], axis=-1)
    ending = noise.replace("-", "_")
    joint, _ = checkpoints.load(CHECKPOINT.with_stem(f"joint{ending}"))
    network, _ = ensemble.load(CHECKPOINT.with_stem(f"ensemble{ending}"), joint)
    with torch.inference_mode():
        exact, log_error, albedo, normal = (image.numpy() for image in network(tensor(lrhs), tensor(hrls)))
    feed = {"lrhs": tensor(lrhs).numpy(), "hrls": tensor(hrls).numpy()}
    outputs = ["fused", "log_error", "albedo", "normal"]
    onnx.save(network_of(onnx.load(find_model(scale, f"ensemble{noise}"))), tmp_path / "network.onnx")
    fused, predicted, *aovs = load_network(tmp_path / "network.onnx").run(outputs, feed)
    assert np.abs(fused - exact).mean() < 0.2 * np.abs(feed["hrls"][:, :3] - exact).mean()
    assert np.abs(predicted - log_error).mean() < 0.3
    for found, expected in zip(aovs, (albedo, normal), strict=True):
        assert np.abs(found - expected).mean() < 0.01


def test_training_learns_which_result_is_right(tmp_path, monkeypatch):
    """``large`` is closer to the target than ``joint``."""
    monkeypatch.setattr(ensemble, "BATCH", 2)
    for index in range(2):
        given = {name: image.numpy() for name, image in arguments().items()}
        given["target"] = (3 * given["large"] + given["albedo"]) / 4
        np.savez(tmp_path / f"x2-{index}.npz", **{name: image.astype(np.float16) for name, image in given.items()})
    files = sorted(tmp_path.glob("*.npz"))
    before = evaluate(None, files)
    after = evaluate(train(files, files, steps=20), files)
    assert after["psnr"] > before["psnr"] + 0.5


def test_the_large_network_learns_from_the_result_of_joint(tmp_path):
    """It starts as Open Image Denoise's: what it also reads has no weight yet."""
    hrls = torch.rand(1, 9, 64, 64, generator=torch.Generator().manual_seed(0))
    images = hrls[:, :3], hrls[:, 3:6], hrls[:, 6:9], hrls.flip(2)[:, :3]
    training = Training(JointFusion().eval(), torch.device("cpu"))
    with torch.inference_mode():
        torch.testing.assert_close(training.large(*images), LargeDenoiser()(*images))
    lrhs = torch.rand(1, 7, 32, 32, generator=torch.Generator().manual_seed(1))
    batch = {"lrhs": lrhs, "hrls": hrls, "target": 0.5 * hrls[:, :3]}
    given = [training.step(batch) for _ in range(3)]
    assert given[-1] < given[0]
    torch.save(training.state({"minutes": 0}), tmp_path / "large.pt")
    network, how = ensemble.load(tmp_path / "large.pt", JointFusion())
    assert network.large.reads_joint and isinstance(network.weights, PlainMean)
    assert how["steps"] == 3
    assert network.large.convs["enc_conv1a"].extra.abs().max() > 0


def test_albedo_and_colour_are_permuted_alike(tmp_path):
    given = {name: image.numpy() for name, image in arguments().items()}
    given["target"] = given["joint"] = given["albedo"]
    np.savez(tmp_path / "x2-0.npz", **given)
    for _, batch in zip(range(4), batches([Path(tmp_path / "x2-0.npz")], np.random.default_rng(0)), strict=False):
        torch.testing.assert_close(batch["target"], batch["albedo"])
        torch.testing.assert_close(batch["joint"], batch["albedo"])
