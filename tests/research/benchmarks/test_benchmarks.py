# SPDX-License-Identifier: Apache-2.0
"""Scenes, result tables, the pages and the chart that are made of them."""

import re

import numpy as np
import pytest

pytest.importorskip("torch")

from oiio_msspl import Render, Session
from oiio_msspl.model.encoding import find_exposure
from research.benchmarks import accuracy, chart, peers, scenes, tables
from research.benchmarks.peers import on_every_second_pixel, without_grid
from research.datagen import views
from tests.browser import BROWSER, dump_dom
from tests.conftest import downsample, picture, rgb, write_exr


def test_views_for_testing_are_scenes(tmp_path):
    """Exposed for display; an LRHS holds the average samples that it was asked for, an HRLS its spp."""
    rng = np.random.default_rng(0)
    clean = picture(64, 64)
    hr = np.concatenate(
        [clean * rng.gamma(1, 1, (views.HR_PASSES, 64, 64, 1)), np.ones((views.HR_PASSES, 64, 64, 12))], -1
    )
    lr = np.stack([np.full((64, 64, 3), float(i + 1)) for i in range(len(views.LR_SPP))])
    for name in ("test", "train"):
        for psnr in (25, 35):
            meta = {"split": name, "seed": f"cycles-{name}", "ref_psnr": psnr}
            arrays = views.pack(hr, {1: lr}, clean, np.random.default_rng(1), meta)
            views.save(tmp_path / f"{name}-{psnr}.npz", arrays)
    (scene,) = scenes.load(tmp_path)  # the one that is held out and has a clean reference
    assert scene.name == "cycles-test"
    assert find_exposure(scene.reference) == pytest.approx(1, rel=1e-3)
    scale = scene.reference.mean() / clean.mean()
    one, four = (scene.hrls(spp).read(scene.hrls(spp).data_window) for spp in (1, 4))
    assert np.abs(four["rgb"] - scene.reference).mean() < 0.6 * np.abs(one["rgb"] - scene.reference).mean()
    assert (one["albedo"] == 1).all()
    # The first pass of so many spp; 64 / 8 pixels
    for spp, value in ((1, 1), (2, 3), (4, 4)):
        low = scene.lrhs(8, spp)
        assert low.data_window.width == 8
        np.testing.assert_allclose(scenes.beauty(low), value * scale, rtol=2e-3)


def test_folders_of_renders_are_scenes(tmp_path):
    folder = tmp_path / "lamp"
    folder.mkdir()
    clean = picture(32, 32)
    for name, image in (("ref", clean), ("hr_2spp", 2 * clean), ("lr_x4_32spp", 3 * downsample(clean, 4))):
        write_exr(folder / f"{name}.exr", rgb(image))
    (scene,) = scenes.load(tmp_path)
    assert scene.name == "lamp"
    np.testing.assert_array_equal(scene.reference, clean)
    np.testing.assert_array_equal(scenes.beauty(scene.hrls(2)), 2 * clean)
    np.testing.assert_allclose(scenes.beauty(scene.lrhs(4, 2)), 3 * downsample(clean, 4), rtol=1e-6)


def test_a_folder_without_scenes_is_refused(tmp_path):
    with pytest.raises(SystemExit, match=r"neither scenes with a .* nor views for testing"):
        scenes.load(tmp_path)


def test_accuracy_measures_only_the_methods_that_are_asked_for(tmp_path, bilinear_models):
    """The HRLS is the reference here, so its PSNR is infinite."""
    clean = picture(32, 32)
    source = Render.from_arrays("HRLS", rgb=clean)
    low = {scale: Render.from_arrays("LRHS", rgb=downsample(clean, scale)) for scale in (2, 4, 8)}
    scene = scenes.Scene("a", clean, lambda spp: source, lambda scale, spp: low[scale])
    sessions = [Session(bilinear_models[scale]) for scale in low]
    rows = accuracy.measure(scene, sessions, pattern="[Hb]*")
    assert {row["method"] for row in rows if ":" not in row["method"]} == {"HRLS", *(f"bilinear-x{s}" for s in low)}
    assert {row["spp"] for row in rows} == set(accuracy.AVERAGES)
    assert all(row["psnr"] > 60 for row in rows if row["method"] == "HRLS")
    assert accuracy.load_models([str(bilinear_models[4])], "OIDN*") == []
    (session,) = accuracy.load_models([str(bilinear_models[4])], "*, 3:1")
    assert session.contract.scale == 4


def test_peers_get_all_layers_that_they_can_read(monkeypatch):
    """Both calls of OIDN get the albedo and the normal; without an albedo it takes no normal."""
    layers = {name: picture(32, 32) for name in ("rgb", "albedo", "normal", "diffuse")}
    given = []
    for call in ("denoise", "denoise_prefiltered"):
        monkeypatch.setattr(peers, call, lambda **images: given.append(images))
    for names in (layers, ("rgb", "normal"), ("rgb", "albedo")):
        render = Render.from_arrays("hr", **{name: layers[name] for name in names})
        peers.oidn(render)
        peers.oidn_prefiltered(render)
    for plain, prefiltered in zip(given[::2], given[1::2], strict=True):
        assert plain.pop("quality") == "high"
        assert plain.keys() == prefiltered.keys()
    assert [set(images) for images in given[::2]] == [{"color", "albedo", "normal"}, {"color"}, {"color", "albedo"}]


def test_prefiltering_helps_where_the_auxiliary_layers_are_noisy():
    """OIDN with a prefiltered albedo is closer to the truth than its plain call."""
    pytest.importorskip("pyoidn")
    from research.benchmarks import oidn

    rng = np.random.default_rng(0)
    clean = picture(128, 128).clip(0, 1)
    noisy = clean * rng.exponential(size=(128, 128, 1)).astype(np.float32)
    albedo = (clean + rng.normal(0, 0.1, clean.shape)).clip(0, 1).astype(np.float32)
    plain, prefiltered = oidn.denoise(noisy, albedo), oidn.denoise_prefiltered(noisy, albedo)
    assert np.square(prefiltered - clean).mean() < 0.9 * np.square(plain - clean).mean()


def test_the_chart_is_up_to_date():
    """`python -m research.benchmarks.chart -o docs/chart.html` makes it."""
    assert (tables.ROOT / "docs/chart.html").read_text() == chart.page(chart.data())


@pytest.mark.skipif(not BROWSER, reason="needs Chromium")
@pytest.mark.parametrize(
    ("measure", "scene", "time"),
    [("psnr", "mean", "method"), ("relmse", "lamp", "total"), ("flip", "veach-bidir", "method")],
)
def test_the_chart_draws_every_point(measure, scene, time):
    """In the browser each point of the data stands in the page, with its time and its value."""
    shown = chart.data()
    address = f"{(tables.ROOT / 'docs/chart.html').as_uri()}#measure={measure}&scene={scene}&time={time}"
    dom = dump_dom(address)
    drawn = re.findall(r'class="point".*?data-method="(.*?)" data-spp="(\d)" data-x="(.*?)" data-y="(.*?)"', dom)
    column = list(shown["measures"]).index(measure)
    expected = []
    for series in shown["series"]:
        for point in series["points"]:
            if scene in point["values"]:
                seconds = point["seconds"] + (point["spp"] * shown["cost"][scene] if time == "total" else 0)
                expected.append((point["method"], point["spp"], seconds, point["values"][scene][column]))
    assert len(drawn) == len(expected) > 30
    found = {(method, int(spp)): (float(x), float(y)) for method, spp, x, y in drawn}
    for method, spp, seconds, value in expected:
        assert found[method, spp] == (pytest.approx(seconds, rel=1e-3), value)
    assert dom.count("<polyline") > 0


def test_oidn_on_every_second_pixel_gets_four_pictures_of_the_frame():
    image = np.random.default_rng(0).random((8, 10, 3), np.float32)
    seen = []
    joined = on_every_second_pixel(lambda color: seen.append(color.copy()) or color, {"color": image})
    np.testing.assert_array_equal(joined, image)
    np.testing.assert_array_equal(seen[1], image[::2, 1::2])


def test_a_grid_goes_and_an_edge_stays():
    image = np.full((16, 20, 3), 0.4, np.float32)
    image[:, 10:] = 0.9
    grid = np.zeros_like(image)
    grid[::2, ::2], grid[1::2, 1::2] = 0.02, -0.02
    smooth = without_grid(image + grid)
    assert np.abs(smooth - image)[1:-1, 1:-1].max() < 0.005
    assert np.abs(without_grid(image) - image).max() < 1e-5
