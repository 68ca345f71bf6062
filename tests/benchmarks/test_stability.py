# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks import results
from benchmarks.stability import analytic, cases, measures, report
from benchmarks.stability.__main__ import enlarged, ours, run
from benchmarks.stability.bases import Analytic
from benchmarks.stability.gallery import Gallery
from oiio_msspl.colour import luminance
from oiio_msspl.model.session import Session
from tests.conftest import downsample

SIZE = 32

SCENES = {
    "room": analytic.room,
    "lights": lambda size: analytic.small_lights(size, 100.0),
    "emitters": analytic.emitters,
    "defocused": analytic.defocused,
    "moving": analytic.moving,
    "hairy": analytic.hairy,
    "glassy": analytic.glassy,
}
FOOTPRINTS = {"box": analytic.box(), "Blackman-Harris": analytic.blackman_harris()}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("footprint", FOOTPRINTS)
def test_renders_converge_to_the_reference(name, footprint):
    """The mean luminance of many samples is that of the reference, as closely as the render's own variance promises."""
    scene, used = SCENES[name](SIZE), FOOTPRINTS[footprint]
    made = analytic.render(scene, 100, np.random.default_rng(1), footprint=used)
    error = luminance(made.layers["rgb"] - analytic.reference(scene, used))
    promised = made.layers["variance"][..., 0]
    assert abs(error.mean()) < 4 * np.sqrt(promised.sum()) / error.size


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_the_lrhs_is_the_box_mean_of_the_frame(scale):
    scene = analytic.room(SIZE)
    low = analytic.reference(scene, scale=scale)
    np.testing.assert_allclose(low, downsample(analytic.reference(scene), scale), rtol=1e-5)
    point = analytic.reference(scene, analytic.point(scale), scale)
    centre = slice(scale // 2, None, scale)
    np.testing.assert_allclose(point, analytic.reference(scene)[centre, centre], rtol=1e-5)


def test_a_moved_scene_is_the_moved_picture():
    scene = analytic.hairy(SIZE)
    moved = analytic.reference(analytic.moved(scene, 3, 2))
    np.testing.assert_allclose(moved[2:, 3:], analytic.reference(scene)[:-2, :-3], rtol=1e-5)


def test_every_case_runs_and_stays_finite(bilinear_models, tmp_path):
    """All cases, measures, pictures and tables, with a model that reads only the LRHS."""
    methods = {report.ENLARGED: enlarged, "bilinear": ours(Session(bilinear_models[4]))}
    gallery = Gallery()
    measured = run(None, 4, methods, SIZE, gallery)
    assert {row["group"] for row in measured} == {*cases.ANYWHERE, *cases.MADE}
    for row in measured:
        figures = [value for value in row.values() if isinstance(value, float)]
        assert np.isfinite(figures).all(), row
        assert row["finite"]
    mine = [row for row in measured if row["method"] == "bilinear"]
    assert max(row.get("deviation", 0) for row in mine) < 1e-3
    assert max(row["range"] for row in mine) < measures.EXCESS

    rows = report.judged(measured)
    assert len(rows) == len(measured)
    results.write(tmp_path / "stability.csv", rows)
    text = report.document(results.read(tmp_path / "stability.csv"))
    assert all(row["case"] in text and row.get("sentence", "") in text for row in rows)
    gallery.write_worst(tmp_path / "worst.png", rows)
    gallery.write_groups(tmp_path / "groups")
    assert (tmp_path / "worst.png").stat().st_size > 1000
    assert len(list((tmp_path / "groups").glob("x4-*.png"))) == len(cases.ANYWHERE) + len(cases.MADE)


def test_several_views_are_one_row():
    """The range is the worst of all views, PSNR is their mean, and the verdict is on these."""
    key = {"scale": 4, "scenes": "views", "group": "x", "case": "y", "method": "z"}
    view = {"finite": True, "worst_pixel": 1.0, "relmse": 0.1, "relmse_trimmed": 0.1, "relmse_enlarged": 0.2}
    view |= {"outside": 0.0, "warnings": []}
    (row,) = report.judged([{**key, **view, "psnr": 20.0, "range": 1.0}, {**key, **view, "psnr": 30.0, "range": 2.0}])
    assert (row["psnr"], row["range"], row["verdict"]) == (25.0, 2.0, "suffers")


def test_the_verdict_names_what_is_wrong():
    """A converged result holds; one that rings, glows or drifts does not, and says why."""
    pair = Analytic("room", analytic.room(SIZE)).pair(4, 64)
    case = cases.Case("x", pair, pair)
    small = enlarged(pair)[0]

    clean = pair.hr.layers["rgb"]

    def said(image):
        row = measures.measure(case, image, clean, small, [])
        return measures.verdict({**row, "group": "x"})

    assert said(clean)[0] == "holds"
    bright = clean.copy()
    bright[8, 8] = 1e4
    assert "leaves the inputs' range by up to x" in said(bright)[1].lower()
    assert said(bright * np.nan) == ("fails", "NaN or Inf comes out.")
    assert "worse than the LRHS merely enlarged" in said(clean * 2)[1]
