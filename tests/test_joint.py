# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's network, taught to read both renders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from oiio_msspl.contract import Contract
from oiio_msspl.denoiser import Denoiser, Together, layers_of
from oiio_msspl.files import Inputs

from oiio_msspl import Render, Session, denoiser, eight_bit, find_model, fuse, fuse_files, schema, session, transforms
from oiio_msspl.aovs import resolve
from oiio_msspl.errors import InputError
from oiio_msspl.exr import open_exr
from tests.conftest import noisy, picture, rgb, write_exr

JOINT = [f"joint-x{scale}" for scale in schema.SCALES]


# The models that ship


@pytest.mark.parametrize("name", JOINT)
def test_the_package_has_no_weights_of_open_image_denoise(name):
    """What a file holds is what differs from them, and what they do not have."""
    onnx = pytest.importorskip("onnx")
    graph = onnx.load(find_model(0, name), load_external_data=False).graph
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    convolutions = [name.removesuffix(".in_codes.more") for name in tensors if name.endswith(".in_codes.more")]
    assert len(convolutions) == 16
    for layer in convolutions:
        assert tensors[layer].data_location == onnx.TensorProto.EXTERNAL
        assert not tensors[layer].raw_data


@pytest.mark.parametrize("trouble", ["not installed", "other weights", "wrong results"])
def test_what_it_needs_is_said_and_done_without(trouble, monkeypatch, forget):
    pytest.importorskip("pyoidn")
    if trouble == "not installed":
        monkeypatch.setattr(denoiser, "installed_library", lambda: (_ for _ in ()).throw(ImportError))
        monkeypatch.setattr(session, "find_spec", lambda name: None)
    elif trouble == "other weights":
        monkeypatch.setattr(eight_bit, "weights_of", lambda name, library: None)
    else:
        plain = eight_bit.EightBit.__call__
        monkeypatch.setattr(eight_bit.EightBit, "__call__", lambda self, **images: plain(self, **images) + 0.02)
    said = {
        "not installed": "pip install pyoidn, or choose another --model",
        "other weights": "has others: install that version of pyoidn, or choose another --model",
        "wrong results": "model joint-x4 is in 8 bits, which this machine computes wrongly; choose another --model",
    }
    with pytest.raises(InputError, match=said[trouble]):
        Session(find_model(4, "joint"))
    assert find_model(4).stem == ("pyramid-x4" if trouble == "not installed" else "mix-x4")


def test_it_is_the_default_where_it_can_be(forget):
    pytest.importorskip("pyoidn")
    assert find_model(2).stem == "joint-x2"
    assert find_model(2, "auto").stem == "joint-x2"


@pytest.mark.parametrize("spp_of_albedo", [64, 1024])
@pytest.mark.parametrize("scale", schema.SCALES)
def test_it_denoises_no_worse_than_open_image_denoise(scale, spp_of_albedo):
    """Nor by a tenth at x8, whose LRHS is 17 x 25 pixels, and at x2 with a noisy albedo; also where sides are no
    multiple of what the network needs, and within the renders' range."""
    pytest.importorskip("pyoidn")
    clean = picture(136, 200)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    albedo = noisy(clean.clip(0, 1), spp_of_albedo).clip(0, 1)
    lr = Render.from_arrays("lr", rgb=transforms.box_downsample(noisy(clean, 4, seed=1), scale))
    hr = Render.from_arrays("hr", rgb=noisy(clean, 4), albedo=albedo, normal=normal)
    model = Session(find_model(scale, "joint"), threads=1)
    fused = fuse(lr, hr, model, error=True)
    assert fused.rgb.shape == clean.shape
    assert fused.rgb.min() >= 0
    assert fused.rgb.max() <= max(lr.layers["rgb"].max(), hr.layers["rgb"].max())
    layers = layers_of(np.concatenate([transforms.compress(hr.layers["rgb"], fused.exposure), albedo, normal], axis=-1))
    alone = transforms.expand(Denoiser(threads=1, exact=True).hrls(layers), fused.exposure)

    def error(image):
        return np.abs(transforms.compress(image, 1.0) - transforms.compress(clean, 1.0)).mean()

    assert error(fused.rgb) < (1.1 if scale == 8 or (scale, spp_of_albedo) == (2, 64) else 1.0) * error(alone)
    assert (fused.error > 0).all()


def test_layers_that_it_does_not_read_are_not_read():
    pytest.importorskip("pyoidn")
    model = Session(find_model(2, "joint"), threads=1)
    assert list(model.contract.features) == [schema.RGB, schema.ALBEDO, schema.NORMAL]
    clean, asked = picture(64, 64), []

    class Watched(Render):
        def read(self, window, features=None):
            asked.append(None if features is None else set(features))
            return super().read(window, features)

    layers = {name: clean for name in (schema.RGB, schema.ALBEDO, schema.DIFFUSE, schema.SPECULAR)}
    lr = Render.from_arrays("lr", rgb=transforms.box_downsample(noisy(clean, 4, seed=1), 2))
    fuse(lr, Watched.from_arrays("hr", **layers), model)
    assert {schema.RGB, schema.ALBEDO, schema.NORMAL, "alpha"} in asked
    assert not any(features is None or schema.DIFFUSE in features for features in asked)


def test_what_it_does_not_read_is_said_to_be_unused(tmp_path):
    pytest.importorskip("pyoidn")
    clean = picture(64, 64)
    write_exr(tmp_path / "lr.exr", rgb(transforms.box_downsample(noisy(clean, 4, seed=1), 2)))
    layers = rgb(clean, "albedo.") | rgb(0.5 * clean, "diffuse.")
    write_exr(tmp_path / "hr.exr", rgb(noisy(clean, 4)) | layers)
    report = fuse_files(tmp_path / "lr.exr", tmp_path / "hr.exr", tmp_path / "out.exr", model="joint")
    rows = {row["feature"]: (row["status"], row["source"]) for row in report.aovs()}
    assert rows["albedo"][0] == "found" and rows["normal"][0] == "default"
    assert rows["diffuse"] == ("unused", "diffuse")
    assert rows["variance"] == ("unused", "")


@pytest.mark.parametrize("scale", [2, 4])
def test_albedo_and_normal_of_the_lrhs_are_read_at_x2(tmp_path, scale):
    """And are said to be; but for what the user maps to a layer of the HRLS."""
    pytest.importorskip("pyoidn")
    clean = picture(64, 64)
    albedo = clean.clip(0, 1)
    low = transforms.box_downsample(noisy(clean, 4, seed=1), scale)
    for name, more in (("bare", {}), ("lr", rgb(transforms.box_downsample(albedo, scale), "albedo."))):
        write_exr(tmp_path / f"{name}.exr", rgb(low) | more)
    write_exr(tmp_path / "hr.exr", rgb(noisy(clean, 4)) | rgb(noisy(albedo, 16, seed=2).clip(0, 1), "albedo."))

    def fused(name, **mapping):
        report = fuse_files(
            tmp_path / f"{name}.exr",
            tmp_path / "hr.exr",
            tmp_path / "out.exr",
            inputs=Inputs(mapping),
            model="joint",
            overwrite=True,
        )
        out = open_exr(tmp_path / "out.exr")
        return report.as_dict()["lrhs_aovs"], resolve(out).read(out.parts[0].data_window, ["rgb"])["rgb"]

    (none, bare), (found, helped), (unread, mapped) = fused("bare"), fused("lr"), fused("lr", albedo="albedo")
    assert none == unread == {}
    assert found == ({"albedo": "albedo"} if scale == 2 else {})
    assert (helped != bare).any() == (scale == 2)
    np.testing.assert_array_equal(mapped, bare)


# Making them


@pytest.fixture(scope="module")
def torch():
    pytest.importorskip("pyoidn")
    return pytest.importorskip("torch")


def pairs(torch, scale, prepare, count=2, size=64):
    """Inputs of a network: pictures with noise."""
    result = []
    for seed in range(count):
        clean = picture(size, size)
        values = [transforms.compress(noisy(clean, 4, seed + i), 1.0) for i in range(2)]
        normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
        hrls = np.concatenate([values[0], clean.clip(0, 1), normal], axis=-1)
        images = prepare(transforms.box_downsample(values[1], scale), hrls)
        result.append(tuple(torch.from_numpy(np.ascontiguousarray(i.transpose(2, 0, 1)[None])) for i in images))
    return result


def test_it_begins_as_open_image_denoise(torch):
    from training.joint import JointFusion

    network = JointFusion().eval()
    for head in network.heads:  # believe what the U-Net makes, and nothing else
        head.weight.data.zero_()
        head.bias.data[1] = 60.0
    ((lrhs, hrls),) = pairs(torch, 2, Together(threads=1), count=1)
    with torch.inference_mode():
        fused = network.fuse(lrhs, hrls)[0][0].permute(1, 2, 0).numpy()
    expected = Denoiser(threads=1, exact=True).hrls(layers_of(hrls[0].permute(1, 2, 0).numpy()))
    assert np.abs(fused - expected).mean() < 1e-3
    assert not any(parameter.any() for parameter in network.retrained())


@pytest.mark.parametrize("scale", [2, 8])
def test_the_graph_computes_what_the_network_does(torch, scale, tmp_path):
    """With weights that have learnt something, some of them left out; and a contract that says what is left open."""
    from training import export
    from training.joint import JointFusion
    from training.unet import SMALLER

    torch.manual_seed(0)
    ups = [name for level in SMALLER.up for name in level]
    network = JointFusion(kept={name: list(range(i, 16 + i)) for i, name in enumerate(ups)}).eval()
    for name, parameter in network.named_parameters():
        parameter.data += (0.003 if name.startswith("convs") else 0.02) * torch.randn_like(parameter)
    state = {"denoiser": "together", "architecture": "joint", "training_spp": {str(scale): {}}, "provenance": {}}
    contract = export.contract_of(network, scale, f"joint-x{scale}", 128 // scale, state)
    drawn = pairs(torch, scale, Together(threads=1))
    path = tmp_path / "joint.onnx"
    export.onnx.save(export.joint_to_onnx(network, contract, drawn), path)
    assert Contract.of_file(path).weights == "usual"
    model = export._loaded(path)
    for lrhs, hrls in drawn:
        fused, log_error = model.run(["fused", "log_error"], {"lrhs": lrhs.numpy(), "hrls": hrls.numpy()})
        with torch.inference_mode():
            expected = [values.numpy() for values in network.fuse(lrhs, hrls)]
        assert np.abs(fused - expected[0]).mean() < 0.2 * np.abs(hrls[:, :3].numpy() - expected[0]).mean()
        assert np.abs(log_error - expected[1]).mean() < 0.1


def test_what_the_next_convolution_does_not_read_can_be_left_out(torch):
    from training import prune
    from training.joint import JointFusion, with_mean

    torch.manual_seed(0)
    network = JointFusion().eval()
    idle = torch.tensor([3, 20, 40])
    reader = network.convs["dec_conv1a"]
    reader.weight.data[:, idle] = -reader.given_weight[:, idle]
    head = network.heads[1]
    head.weight.data[:, idle] = 0
    drawn = pairs(torch, 2, with_mean, count=1)
    pruned = prune.without(network, "dec_conv2b", 61, [{"lrhs": lrhs, "hrls": hrls} for lrhs, hrls in drawn]).eval()
    assert len(pruned.kept["dec_conv2b"]) == 61
    assert pruned.convs["dec_conv2b"].weight.shape[0] == pruned.heads[1].in_channels == 61
    with torch.inference_mode():
        for before, after in zip(network(*drawn[0]), pruned(*drawn[0]), strict=True):
            torch.testing.assert_close(before, after, atol=1e-4, rtol=0)
    with pytest.raises(SystemExit, match="only convolutions on the way up"):
        prune.without(network, "enc_conv1", 16, [])


def test_a_mean_with_what_it_begins_as_lies_between(torch):
    from training import average
    from training.joint import JointFusion

    network = JointFusion()
    bias = network.heads[0].bias.detach().clone()
    for parameter in network.parameters():
        parameter.data += 0.5
    state = {"architecture": "joint", "config": network.config, "ema": network.state_dict(), "denoiser": "together"}
    mean = average.mean([state | {"provenance": {}}], beginning=(0.25, 0.75))
    assert mean["provenance"] == {"share_of_beginning": [0.25, 0.75]}
    assert (mean["ema"]["convs.enc_conv0.weight"] == 0.375).all()
    assert (mean["ema"]["together.convs.enc_conv1a.more"] == 0.125).all()
    torch.testing.assert_close(mean["ema"]["heads.0.bias"].float(), bias + 0.375)
    torch.testing.assert_close(mean["ema"]["error.bias"], network.error.bias.half())
    with pytest.raises(SystemExit, match="only a joint network"):
        average.mean([state | {"architecture": "mix", "config": {}, "provenance": {}}], beginning=(0.25, 0))


def test_what_denoises_both_begins_as_open_image_denoise(torch):
    """Of the estimated noise it makes nothing yet."""
    from training import together

    ((lrhs, hrls),) = pairs(torch, 2, lambda lrhs, hrls: (lrhs, hrls), count=1, size=96)
    low, high = (image[0].permute(1, 2, 0).numpy() for image in (lrhs, hrls))
    layers = denoiser.merged(low, layers_of(high, complete=True))
    found = together.Together().eval().denoised(layers)
    del layers["noise"]
    expected = Denoiser(threads=1, exact=True).both(layers)
    assert np.abs(found - expected).mean() < 1e-3


def test_what_ships_denoises_both_as_the_checkpoint_does(torch):
    """By a tenth of the noise; also where sides are no multiples of what it needs."""
    from training.eight_bit import CHECKPOINT
    from training.together import Together as InTorch

    ((lrhs, hrls),) = pairs(torch, 2, lambda lrhs, hrls: (lrhs, hrls), count=1, size=80)
    low, high = (image[0].permute(1, 2, 0).numpy() for image in (lrhs, hrls))
    layers = denoiser.merged(low, layers_of(high, complete=True))
    expected = InTorch.of(CHECKPOINT).denoised(layers)
    found = Together(threads=1)(low, high)[0][..., 3:]
    assert np.abs(found - expected).mean() < 0.1 * np.abs(layers["colour"] - expected).mean()


def test_it_goes_on_from_an_earlier_run(torch, tmp_path: Path):
    from training.joint import JointFusion
    from training.train import warm_start

    network = JointFusion(kept={"dec_conv1a": list(range(48))})
    network.convs["enc_conv2"].more.data.fill_(0.5)
    torch.save({"ema": network.state_dict(), "config": network.config}, tmp_path / "earlier.pt")
    other = JointFusion(kept=network.kept)
    warm_start(other, tmp_path / "earlier.pt")
    assert (other.convs["enc_conv2"].more == 0.5).all()
    retrained, everything = len(list(other.retrained())), len(list(other.parameters()))
    held = 6
    assert retrained == 2 * (16 + 19 - held)
    assert everything == retrained + 2 + 2 + 2 * 5
