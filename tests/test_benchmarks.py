# SPDX-License-Identifier: Apache-2.0
"""What models are judged by, and how the result is drawn."""

import numpy as np
import pytest

pytest.importorskip("torch")

from benchmarks import scenes
from oiio_msspl import transforms
from tests.conftest import downsample, picture, rgb, write_exr
from training import views


def test_views_for_testing_are_scenes(tmp_path):
    """Exposed for display; an LRHS holds the average samples that it was asked for, an HRLS its spp."""
    rng = np.random.default_rng(0)
    clean = picture(64, 64)
    hr = np.concatenate(
        [clean * rng.gamma(1, 1, (views.HR_PASSES, 64, 64, 1)), np.ones((views.HR_PASSES, 64, 64, 12))], -1
    )
    lr = np.stack([np.full((64, 64, 3), float(i + 1)) for i in range(len(views.LR_SPP))])
    for name in ("test", "train"):
        for quality in (25, 35):
            meta = {"split": name, "seed": f"cycles-{name}", "ref_psnr": quality}
            arrays = views.pack(hr, {1: lr}, clean, np.random.default_rng(1), meta)
            views.save(tmp_path / f"{name}-{quality}.npz", arrays)
    (scene,) = scenes.load(tmp_path)  # the one that is held out and has a clean reference
    assert scene.name == "cycles-test"
    assert transforms.exposure_of(scene.reference) == pytest.approx(1, rel=1e-3)
    scale = scene.reference.mean() / clean.mean()
    one, four = (scene.hrls(spp).read(scene.hrls(spp).data_window) for spp in (1, 4))
    assert np.abs(four["rgb"] - scene.reference).mean() < 0.6 * np.abs(one["rgb"] - scene.reference).mean()
    assert (one["albedo"] == 1).all()
    # The first pass of so many spp; 64 / 8 pixels
    for spp, value in ((1, 1), (2, 3), (4, 4)):
        low = scene.lrhs(8, spp)
        assert low.data_window.width == 8
        np.testing.assert_allclose(scenes.beauty(low), value * scale, rtol=2e-3)
    # 4 spp are those of the fourth pass, 16 those of all five; more there are not
    for factor, spp, value in ((2, 1, 4), (2, 4, (1 + 2 + 2 * 3 + 4 * 4 + 8 * 5) / 16)):
        low = scene.nearest(factor, spp)
        assert low.data_window.width == 32
        np.testing.assert_allclose(scenes.beauty(low), value * scale, rtol=2e-3)
    assert scene.nearest(4, 2) is None


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


def test_the_page_has_a_chart_a_scene_with_and_without_the_render(tmp_path):
    pytest.importorskip("matplotlib")
    from benchmarks import chart

    methods = [*chart.PEERS, "pyramid-x4"]
    rows = [
        {"scene": scene, "spp": spp, "method": method, "psnr": 30.0 + i, "relmse": 0.01 / (i + 1)}
        for scene in ("lamp", "tire")
        for spp in (2, 4)
        for i, method in enumerate(methods)
    ]
    runs = {run for _, run in chart.PEERS.values()} | {"pyramid-x4"}
    timings = chart.Timings(dict.fromkeys(runs, 0.5), {"lamp": 2.0, "tire": 4.0})
    assert timings.of_a_sample(None) == 3.0
    page = chart.page(rows, timings)
    assert page.count("<svg") == page.count("</svg>") == 6
    assert all(f"<h2>{name}</h2>" in page for name in ("Mean of the scenes", "lamp", "tire"))


def test_pages_have_the_figures_that_were_measured():
    """`python -m benchmarks.tables` brings README.md and docs/results.md up to date."""
    from benchmarks import tables

    for path, of_page in tables.TABLES.items():
        text = path.read_text()
        assert tables.laid_out(text, of_page) == text, path.name
        with pytest.raises(SystemExit, match="no <!-- begin: "):
            tables.laid_out("", of_page)


def test_curves_of_a_log_go_on_from_run_to_run(tmp_path):
    from benchmarks import curves

    lines = ["run,step,minutes,loss,psnr", "a,0,0,0,20", "a,5,2,0.5,21", "b,0,0,0,19", "b,9,3,0.4,22"]
    (tmp_path / "training_x.csv").write_text("\n".join(lines) + "\n")
    assert curves.read(tmp_path / "training_x.csv") == {
        "a": (([0, 2], [0, 1]), ([2], [0.5])),
        "b": (([2, 5], [0, 3]), ([5], [0.4])),
    }
    pytest.importorskip("matplotlib")
    curves.draw([tmp_path / "training_x.csv"], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000
