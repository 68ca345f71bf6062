# SPDX-License-Identifier: Apache-2.0
"""The `joint` models of all sizes, which began as networks of Open Image Denoise."""

from __future__ import annotations

import numpy as np
import pytest

from oiio_msspl import Render, Session, find_model, fuse, fuse_files
from oiio_msspl.aovs.features import ALBEDO, DIFFUSE, NORMAL, RGB, SPECULAR
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.model.catalogue import WEIGHTS, shipped_models
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.encoding import encode_radiance
from tests.conftest import noisy, picture, rgb, write_exr

#: Names of models with the denoiser of both renders' mean.
WITH_DENOISER = [name for name in shipped_models() if name.startswith("joint")]


@pytest.mark.parametrize("name", shipped_models())
def test_weights_that_models_share_lie_beside_them(name):
    """Those of the denoiser, which is another one for spread noise; all scales of the large size share its weights.

    Models for one render with little noise have one that is in several models.

    Files with "shared" in their name hold what several models have (research/training/share.py).
    """
    onnx = pytest.importorskip("onnx")
    model = onnx.load(WEIGHTS / f"{name}.onnx", load_external_data=False)
    files = {entry.value for t in model.graph.initializer for entry in t.external_data if entry.key == "location"}
    noise = "_spread" if "-spread-" in name else ""
    scale = name.rpartition("-x")[2]
    small = "_small" if name.startswith("joint-small") and scale in "12" else ""
    has_denoiser = not name.startswith("paper") and not name.endswith("-clean-x1")
    expected = {f"mean_denoiser{small}{noise}.weights"} if has_denoiser else set()
    if name.startswith("joint-large"):
        expected.add(f"joint-large{noise.replace('_', '-')}.weights")
    assert {file for file in files if "shared" not in file} == expected
    assert all((WEIGHTS / file).is_file() for file in files)


@pytest.mark.parametrize("name", WITH_DENOISER)
def test_products_of_two_channels_fit_into_16_bits(name):
    """So processors without VNNI instructions, which add them in 16 bits, give the same result."""
    onnx = pytest.importorskip("onnx")
    graph = onnx.load(WEIGHTS / f"{name}.onnx").graph
    names = {node.input[3] for node in graph.node if node.op_type == "QLinearConv"}
    found = {t.name: onnx.numpy_helper.to_array(t).astype(int) for t in graph.initializer if t.name in names}
    assert found.keys() == names
    for weights in found.values():
        outputs, inputs, *size = weights.shape
        assert inputs % 4 == 0  # else ONNX Runtime's convolution takes more than twice the memory
        pairs = weights.reshape(outputs, inputs // 2, 2, *size)
        assert 255 * pairs.clip(0).sum(2).max() < 1 << 15
        assert 255 * -pairs.clip(None, 0).sum(2).min() < 1 << 15


def test_it_is_the_default():
    assert find_model(2).stem == find_model(2, "auto").stem == "joint-x2"


@pytest.mark.parametrize("family", ["joint", "joint-large"])
def test_its_file_says_where_its_weights_come_from(family):
    assert "Open Image Denoise 2.5.1" in Session(find_model(2, family)).contract.provenance["initial_weights"]


@pytest.mark.parametrize("spp_of_albedo", [64, 1024])
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("family", ["joint", "joint-large"])
def test_it_denoises_no_worse_than_open_image_denoise(family, scale, spp_of_albedo):
    """Its error is at most OIDN's, and 1.1 times that at x8, whose LRHS has 17 x 25 pixels, and at x2 with a noisy
    albedo. The sides are no multiples of the alignment, and the result stays in the range of the renders."""
    pytest.importorskip("pyoidn")
    from research.benchmarks.oidn import denoise

    clean = picture(136, 200)
    normal = np.broadcast_to(np.float32([0.6, -0.8, 0.0]), clean.shape)
    albedo = noisy(clean.clip(0, 1), spp_of_albedo).clip(0, 1)
    lr = Render.from_arrays("lr", rgb=box_downsample(noisy(clean, 4, seed=1), scale))
    hr = Render.from_arrays("hr", rgb=noisy(clean, 4), albedo=albedo, normal=normal)
    model = Session(find_model(scale, family), threads=1)
    fused = fuse(lr, hr, model, error=True)
    assert fused.rgb.shape == clean.shape
    assert fused.rgb.min() >= 0
    assert fused.rgb.max() <= max(lr.layers["rgb"].max(), hr.layers["rgb"].max())
    alone = denoise(hr.layers["rgb"], albedo, np.ascontiguousarray(normal))

    def error(image):
        return np.abs(encode_radiance(image, 1.0) - encode_radiance(clean, 1.0)).mean()

    assert error(fused.rgb) < (1.1 if scale == 8 or (scale, spp_of_albedo) == (2, 64) else 1.0) * error(alone)
    assert (fused.error > 0).all()


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("family", ["joint", "joint-large"])
def test_rare_light_leaves_no_holes(family, scale):
    """One sample of fifty finds the light, so most pixels around are black in both renders. No pixel of the result is
    below a tenth of the truth, or below a quarter of what is around it."""
    rng = np.random.default_rng(scale)
    y, x = np.mgrid[:128, :192] / 192
    clean = np.float32([1, 0.9, 0.8]) * (0.05 + 0.05 * np.sin(3 * x + 2 * y) + 0.05 * y)[..., None].astype(np.float32)

    def rendered(image, spp):
        return (image * rng.binomial(spp, 0.02, image.shape[:2])[..., None] / (spp * 0.02)).astype(np.float32)

    lr = Render.from_arrays("lr", rgb=rendered(box_downsample(clean, scale), scale**2))
    hr = Render.from_arrays("hr", rgb=rendered(clean, 1), albedo=np.full_like(clean, 0.8))
    fused = fuse(lr, hr, Session(find_model(scale, family), threads=1)).rgb.mean(axis=-1)
    around = box_downsample(fused[..., None], 16).repeat(16, 0).repeat(16, 1)[..., 0]
    assert (fused > 0.1 * clean.mean(axis=-1)).all()
    assert (fused > 0.25 * around).all()


def test_layers_that_it_does_not_read_are_not_read():
    model = Session(find_model(2, "joint"), threads=1)
    assert model.contract.hrls == [RGB, ALBEDO, NORMAL]
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


def test_what_only_the_paper_reads_is_reported_if_the_user_has_mapped_it(tmp_path):
    clean = picture(64, 64)
    write_exr(tmp_path / "lr.exr", rgb(box_downsample(noisy(clean, 4, seed=1), 2)))
    layers = rgb(clean, "albedo.") | rgb(0.5 * clean, "diffuse.")
    write_exr(tmp_path / "hr.exr", rgb(noisy(clean, 4)) | layers)
    files = tmp_path / "lr.exr", tmp_path / "hr.exr", tmp_path / "out.exr"

    def rows_of(**options):
        report = fuse_files(*files, model="joint", overwrite=True, **options)
        assert [row["feature"] for row in report.as_dict()["aovs"]] == [row["feature"] for row in report.aovs()]
        assert "variance" not in open_exr(files[2]).metadata["msspl/aovs"]
        return {row["feature"]: (row["status"], row["source"]) for row in report.aovs()}

    rows = rows_of()
    assert rows["albedo"][0] == "found" and rows["normal"][0] == "default"
    assert list(rows) == ["rgb", "albedo", "normal", "alpha"]
    rows = rows_of(inputs=InputOptions(mapping={"specular": "diffuse"}))
    assert rows["specular"] == ("unused", "diffuse") and "diffuse" not in rows


@pytest.mark.parametrize("scale", [2, 4])
def test_albedo_and_normal_of_the_lrhs_are_read_at_x2(tmp_path, scale):
    """And are said to be; but for what the user maps to a layer of the HRLS."""
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
