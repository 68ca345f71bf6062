# SPDX-License-Identifier: Apache-2.0
"""Scenes, result tables, the pages and the chart that are made of them."""

import re

import numpy as np
import pytest

pytest.importorskip("torch")

from oiio_msspl import Render
from oiio_msspl.model.encoding import find_exposure
from research.benchmarks import chart, paper, peers, quality, results, runtime, scenes, tables, versus
from research.benchmarks.every_second_pixel import on_every_second_pixel, without_grid
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


def test_a_table_keeps_four_digits_and_leaves_out_empty_cells(tmp_path):
    path = tmp_path / "table.csv"
    results.write(path, [{"method": "a, b", "psnr": 31.05678}, {"method": "2^-10", "relmse": 0.0012346, "count": 3}])
    assert path.read_text() == 'method,psnr,relmse,count\n"a, b",31.06,,\n2^-10,,0.001235,3\n'
    rows = [{"method": "a, b", "psnr": 31.06}, {"method": "2^-10", "relmse": 0.001235, "count": 3}]
    assert results.read(path) == rows
    results.merge(path, [{"method": "2^-10", "relmse": 1.0}, {"method": "c", "psnr": 1.0}], ("method",))
    assert results.read(path) == [rows[0], {"method": "2^-10", "relmse": 1}, {"method": "c", "psnr": 1.0}]


def test_means_leave_out_noisy_references_and_methods_that_were_not_measured_everywhere():
    def row(scene, method, psnr):
        return {"scene": scene, "spp": 2, "method": method, "psnr": psnr}

    noisy = next(iter(scenes.NOISY_REFERENCE))
    rows = [row("a", "x", 10.0), row("a", "x", 20.0), row("b", "x", 25.0), row(noisy, "x", 99.0), row("a", "y", 1.0)]
    mean, *of_scenes = quality.with_means(rows)
    assert mean == row("mean", "x", 20.0)  # the two views of "a" count once
    assert of_scenes == [row("a", "x", 15.0), *rows[2:]]
    left_out = f"Left out, because the reference is noisy: {noisy}."
    assert quality.mean_note(of_scenes) == f"Means are over 2 scenes: a, b. {left_out}"


def test_quality_measures_only_the_methods_that_are_asked_for(tmp_path, bilinear_models):
    """The HRLS is the reference here, so it scores an infinite PSNR; "LRHS x4 nearest" does not."""
    clean = picture(32, 32)
    source = Render.from_arrays("HRLS", rgb=clean)
    low = {scale: Render.from_arrays("LRHS", rgb=downsample(clean, scale)) for scale in (2, 4, 8)}
    scene = scenes.Scene("a", clean, lambda spp: source, lambda scale, spp: low[scale])
    rows = quality.measure(scene, [], pattern="[HL]R[HL]S*")
    assert {row["method"] for row in rows} == {"HRLS", *(f"LRHS x{s} {m}" for s in low for m in ("nearest", "bicubic"))}
    assert {row["spp"] for row in rows} == set(quality.AVERAGES)
    psnr = {row["method"]: row["psnr"] for row in rows}
    assert psnr["HRLS"] > 60 > psnr["LRHS x2 bicubic"] > psnr["LRHS x8 bicubic"]
    assert quality.load_models([str(bilinear_models[4])], "OIDN*") == []
    (session,) = quality.load_models([str(bilinear_models[4])], "*, 3:1")
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
        assert plain.pop("quality") == prefiltered.pop("guides") == "high"
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


def test_every_table_can_be_laid_out():
    """Each line has as many cells as its head, and what was measured is in it."""
    functions = [make for of_page in tables.TABLES.values() for make in of_page]
    for make in functions:
        text = make()
        blocks = [block.splitlines() for block in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)]
        assert blocks, make.__name__
        for head, rule, *body in blocks:
            assert rule.replace(" ", "") == "|" + "---|" * (head.count("|") - 1)
            assert body and {line.count("|") for line in body} == {head.count("|")}, make.__name__
    body = tables.when_it_pays().split("\n\n")[0].splitlines()[2:]
    assert len(body) == len(tables.WHEN_IT_PAYS) <= 9
    for method, line in zip(tables.WHEN_IT_PAYS, body, strict=True):
        cells = [cell.strip() for cell in line.split("|")[3:7]]
        assert all(re.fullmatch(r"\d+\.\d+", cell) for cell in cells), method
    assert "# The paper's tables" in paper.page()


def _rows(method, psnr, relmse=None):
    """A row of a scene for each value; the first scene is the easy one, and a noisy one comes last."""
    names = [versus.TOO_EASY, *"abcdefgh"[: len(psnr) - 1], *scenes.NOISY_REFERENCE]
    relmse = relmse or [0.01] * len(psnr)
    values = zip(names, [*psnr, 0.0], [*relmse, 9.0], strict=True)
    return [{"scene": name, "spp": 2, "method": method, "psnr": p, "relmse": r} for name, p, r in values]


def test_a_lead_that_one_scene_carries_is_open():
    """The interval over scenes decides, not the mean; the scene with a noisy reference does not count."""
    other = _rows("OIDN", [30.0] * 5)
    carried = versus.compare(_rows("ours", [36.0, 29.9, 29.8, 30.1, 29.9]) + other, "ours", "OIDN", 2)
    assert carried.psnr[0] == pytest.approx(1.14)
    assert carried.psnr[1] < 0 < carried.psnr[2]
    assert carried.verdicts[0] == "open"
    assert carried.without_too_easy == pytest.approx(-0.075)
    assert carried.wins == "2 of 5"
    ahead = versus.compare(_rows("ours", [30.2, 30.5, 30.3, 30.2, 30.4], [0.008] * 5) + other, "ours", "OIDN", 2)
    assert ahead.verdicts == ("ahead", "ahead")
    assert ahead.relmse == pytest.approx((0.8, 0.8, 0.8))
    behind = versus.compare(_rows("ours", [29.8, 29.5, 29.7, 29.8, 29.6], [0.02] * 5) + other, "ours", "OIDN", 2)
    assert behind.verdicts == ("behind", "behind")
    assert versus.compare(_rows("ours", [36.0])[:1] + other, "ours", "OIDN", 2) is None  # four scenes are missing


def test_the_interval_is_that_of_the_mean_over_drawn_scenes():
    """For many scenes, the bootstrap's interval is the normal one: 1.96 standard errors to each side."""
    values = np.random.default_rng(4).normal(1, 2, 400)
    mean, low, high = versus.with_interval(values)
    error = values.std() / np.sqrt(values.size)
    assert mean == values.mean()
    assert (mean - low, high - mean) == (pytest.approx(1.96 * error, rel=0.05), pytest.approx(1.96 * error, rel=0.05))
    assert versus.with_interval(values) == (mean, low, high)


def test_a_finding_that_the_measures_dispute_is_no_agreement():
    """Two of the paper's findings hold by PSNR and not by RelMSE."""
    text = paper.page()
    (disputed,) = (line for line in text.splitlines() if "the LRHS's do not" in line)
    assert "PSNR and RelMSE disagree" in disputed
    (agreed,) = (line for line in text.splitlines() if "an HRLS beats super-resolution" in line)
    assert agreed.endswith("| agrees |")
    table3 = text.split("## Table 3")[1].split("## Table 4")[0]
    assert "paper, " not in table3  # it is measured otherwise there


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        ("flags\t\t: fpu avx2", "X without VNNI"),
        ("flags\t\t: fpu avx_vnni", "X with VNNI"),
        ("flags\t\t: fpu avx_vnni amx_int8", "X with AMX"),
        ("", "X"),
    ],
)
def test_a_time_says_what_the_processor_has_for_networks(flags, name):
    assert runtime.named(f"model name\t: X\n{flags}\n") == name


def test_times_of_different_machines_are_not_mixed():
    """Times of methods and of rendering come from the same machine, and each line of the comparison names it."""
    table = tables.total()
    for methods, _ in tables.MACHINES.values():
        (machine,) = {row["machine"] for row in results.read(methods)}
        assert f"\n| {machine} |" in table
    assert "OIDN prefiltered" in {row["method"] for row in results.read("runtime")}


def test_a_page_has_its_tables_replaced():
    def table():
        return "| new |\n"

    page = "a\n<!-- begin: table -->\nold\n<!-- end -->\nb\n"
    made = "a\n<!-- begin: table -->\n\n| new |\n\n<!-- end -->\nb\n"
    assert tables.laid_out(page, [table]) == made
    assert tables.laid_out(made, [table]) == made
    with pytest.raises(SystemExit, match="no <!-- begin: table"):
        tables.laid_out("", [table])


@pytest.mark.parametrize("path", tables.TABLES, ids=lambda path: path.name)
def test_pages_have_the_figures_that_were_measured(path):
    """`python -m research.benchmarks.tables` brings the pages up to date."""
    text = path.read_text()
    assert tables.laid_out(text, tables.TABLES[path]) == text


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


def test_curves_of_a_log_go_on_from_run_to_run(tmp_path):
    from research.benchmarks import curves

    lines = ["run,step,minutes,loss,psnr", "a,0,0,0,20", "a,5,2,0.5,21", "b,0,0,0,19", "b,9,3,0.4,22"]
    (tmp_path / "training_x.csv").write_text("\n".join(lines) + "\n")
    assert curves.read(tmp_path / "training_x.csv") == {
        "a": (([0, 2], [0, 1]), ([2], [0.5])),
        "b": (([2, 5], [0, 3]), ([5], [0.4])),
    }
    pytest.importorskip("matplotlib")
    curves.draw([tmp_path / "training_x.csv"], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


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
