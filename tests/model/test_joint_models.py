# SPDX-License-Identifier: Apache-2.0
"""The `joint` models: networks of Open Image Denoise that were trained to read both renders."""

from __future__ import annotations

import numpy as np
import pytest

from oiio_msspl import Render, Session, find_model, fuse, fuse_files
from oiio_msspl.aovs.features import ALBEDO, DIFFUSE, NORMAL, RGB, SPECULAR
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.arrays import box_downsample
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.jobs.frame import InputOptions
from oiio_msspl.model import catalogue, oidn_weights
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.oidn import OidnDenoiser
from oiio_msspl.model.quantised import QuantisedDenoiser
from oiio_msspl.model.render_mean import denoiser_images
from tests.conftest import noisy, picture, rgb, write_exr

JOINT = [f"joint-x{scale}" for scale in SCALES]


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
def test_what_it_needs_is_said_and_done_without(trouble, monkeypatch, forget_pyoidn, quantised_networks):
    pytest.importorskip("pyoidn")
    if trouble == "not installed":
        monkeypatch.setattr(oidn_weights, "installed_library", lambda: (_ for _ in ()).throw(ImportError))
        monkeypatch.setattr(catalogue, "find_spec", lambda name: None)
    elif trouble == "other weights":
        monkeypatch.setattr(oidn_weights, "read_weights", lambda network, library: None)
    else:
        plain = QuantisedDenoiser.__call__
        monkeypatch.setattr(QuantisedDenoiser, "__call__", lambda self, **images: plain(self, **images) + 0.02)
    said = {
        "not installed": "pip install pyoidn==2.5.1, or choose another --model",
        "other weights": "has others: pip install pyoidn==2.5.1, or choose another --model",
        "wrong results": "joint-x4 computes in 8 bits, which this processor does wrongly",
    }
    with pytest.raises(InputError, match=said[trouble]):
        Session(find_model(4, "joint"))
    assert find_model(4).stem == ("pyramid-x4" if trouble == "not installed" else "mix-x4")


def test_it_is_the_default_where_it_runs(forget_pyoidn, quantised_networks):
    pytest.importorskip("pyoidn")
    assert find_model(2).stem == "joint-x2"
    assert find_model(2, "auto").stem == "joint-x2"


@pytest.mark.parametrize("spp_of_albedo", [64, 1024])
@pytest.mark.parametrize("scale", SCALES)
def test_it_denoises_no_worse_than_open_image_denoise(scale, spp_of_albedo, quantised_networks):
    """Its error is at most OIDN's, and 1.1 times that at x8, whose LRHS has 17 x 25 pixels, and at x2 with a noisy
    albedo. The sides are no multiples of the alignment, and the result stays in the range of the renders."""
    pytest.importorskip("pyoidn")
    clean = picture(136, 200)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    albedo = noisy(clean.clip(0, 1), spp_of_albedo).clip(0, 1)
    lr = Render.from_arrays("lr", rgb=box_downsample(noisy(clean, 4, seed=1), scale))
    hr = Render.from_arrays("hr", rgb=noisy(clean, 4), albedo=albedo, normal=normal)
    model = Session(find_model(scale, "joint"), threads=1)
    fused = fuse(lr, hr, model, error=True)
    assert fused.rgb.shape == clean.shape
    assert fused.rgb.min() >= 0
    assert fused.rgb.max() <= max(lr.layers["rgb"].max(), hr.layers["rgb"].max())
    layers = denoiser_images(
        np.concatenate([encode_radiance(hr.layers["rgb"], fused.exposure), albedo, normal], axis=-1)
    )
    alone = decode_radiance(OidnDenoiser(threads=1, exact=True).hrls(layers), fused.exposure)

    def error(image):
        return np.abs(encode_radiance(image, 1.0) - encode_radiance(clean, 1.0)).mean()

    assert error(fused.rgb) < (1.1 if scale == 8 or (scale, spp_of_albedo) == (2, 64) else 1.0) * error(alone)
    assert (fused.error > 0).all()


def test_layers_that_it_does_not_read_are_not_read(quantised_networks):
    pytest.importorskip("pyoidn")
    model = Session(find_model(2, "joint"), threads=1)
    assert list(model.contract.features) == [RGB, ALBEDO, NORMAL]
    clean, asked = picture(64, 64), []

    class Watched(Render):
        def read(self, window, features=None):
            asked.append(None if features is None else set(features))
            return super().read(window, features)

    layers = {name: clean for name in (RGB, ALBEDO, DIFFUSE, SPECULAR)}
    lr = Render.from_arrays("lr", rgb=box_downsample(noisy(clean, 4, seed=1), 2))
    fuse(lr, Watched.from_arrays("hr", **layers), model)
    assert {RGB, ALBEDO, NORMAL, "alpha"} in asked
    assert not any(features is None or DIFFUSE in features for features in asked)


def test_what_it_does_not_read_is_said_to_be_unused(tmp_path, quantised_networks):
    pytest.importorskip("pyoidn")
    clean = picture(64, 64)
    write_exr(tmp_path / "lr.exr", rgb(box_downsample(noisy(clean, 4, seed=1), 2)))
    layers = rgb(clean, "albedo.") | rgb(0.5 * clean, "diffuse.")
    write_exr(tmp_path / "hr.exr", rgb(noisy(clean, 4)) | layers)
    report = fuse_files(tmp_path / "lr.exr", tmp_path / "hr.exr", tmp_path / "out.exr", model="joint")
    rows = {row["feature"]: (row["status"], row["source"]) for row in report.aovs()}
    assert rows["albedo"][0] == "found" and rows["normal"][0] == "default"
    assert rows["diffuse"] == ("unused", "diffuse")
    assert rows["variance"] == ("unused", "")


@pytest.mark.parametrize("scale", [2, 4])
def test_albedo_and_normal_of_the_lrhs_are_read_at_x2(tmp_path, scale, quantised_networks):
    """And are said to be; but for what the user maps to a layer of the HRLS."""
    pytest.importorskip("pyoidn")
    clean = picture(64, 64)
    albedo = clean.clip(0, 1)
    low = box_downsample(noisy(clean, 4, seed=1), scale)
    for name, more in (("bare", {}), ("lr", rgb(box_downsample(albedo, scale), "albedo."))):
        write_exr(tmp_path / f"{name}.exr", rgb(low) | more)
    write_exr(tmp_path / "hr.exr", rgb(noisy(clean, 4)) | rgb(noisy(albedo, 16, seed=2).clip(0, 1), "albedo."))

    def fused(name, **mapping):
        report = fuse_files(
            tmp_path / f"{name}.exr",
            tmp_path / "hr.exr",
            tmp_path / "out.exr",
            inputs=InputOptions(mapping),
            model="joint",
            overwrite=True,
        )
        out = open_exr(tmp_path / "out.exr")
        return report.as_dict()["lrhs_aovs"], map_render(out).read(out.parts[0].data_window, ["rgb"])["rgb"]

    (none, bare), (found, helped), (unread, mapped) = fused("bare"), fused("lr"), fused("lr", albedo="albedo")
    assert none == unread == {}
    assert found == ({"albedo": "albedo"} if scale == 2 else {})
    assert (helped != bare).any() == (scale == 2)
    np.testing.assert_array_equal(mapped, bare)
