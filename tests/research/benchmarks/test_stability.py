# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl.image.colour import luminance
from oiio_msspl.model.session import Session
from research.benchmarks import results
from research.benchmarks.stability import analytic, cases, measures
from research.benchmarks.stability.__main__ import enlarged, ours, run
from research.benchmarks.stability.cases import Base
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
    """All cases and measures, with a model that reads only the LRHS."""
    methods = {"bilinear": ours(Session(bilinear_models[4]))}
    measured = run(4, methods, SIZE)
    assert {row["group"] for row in measured} == {*cases.GROUPS}
    for row in measured:
        figures = [value for value in row.values() if isinstance(value, float)]
        assert np.isfinite(figures).all(), row
        assert row["finite"]
    mine = [row for row in measured if row["method"] == "bilinear"]
    assert max(row.get("deviation", 0) for row in mine) < 1e-3
    assert max(row["range"] for row in mine) < measures.EXCESS

    rows = measures.judged(measured)
    assert len(rows) == len(measured)
    results.write(tmp_path / "stability.csv", rows)
    assert [row["verdict"] for row in results.read(tmp_path / "stability.csv") if row["method"] == "bilinear"]


def test_the_verdict_names_what_is_wrong():
    """A converged result holds; one that rings, glows or drifts does not, and says why."""
    pair = Base("room", analytic.room(SIZE)).pair(4, 64)
    case = cases.Case("x", pair, pair)
    small = enlarged(pair)

    clean = pair.hr.layers["rgb"]

    def said(image):
        row = measures.measure(case, image, clean, small, [])
        return measures.verdict({**row, "group": "x"})

    assert said(clean)[0] == "holds"
    bright = clean.copy()
    bright[8, 8] = 1e4
    assert "outside the inputs' range" in said(bright)[1]
    assert said(bright * np.nan)[0] == "fails"
    assert "worse than the LRHS merely enlarged" in said(clean * 2)[1]


def _counts(image, truth, scale, floor=1e-3):
    return measures.holes(image, truth, floor, scale).sum(), measures.stamps(image, truth, floor)


def _textured(shape=(96, 96)):
    """Return a reference (h, w, 3) with soft and hard edges, one of them to a tenth of the brightness."""
    y, x = np.mgrid[: shape[0], : shape[1]] / shape[1]
    grey = 0.3 + 0.2 * np.sin(9 * x + 5 * y) + 0.3 * (x > 0.6)
    return np.float32(np.where(y > 0.8, 0.05, 1) * grey)[..., None] * np.float32([1, 0.9, 0.8])


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_holes_and_stamps_are_counted(scale):
    """On a picture with a grain of 5 %, in which some pixels and some LRHS pixels are too dark or too bright."""
    truth = _textured()
    rng = np.random.default_rng(3)
    grain = truth * rng.normal(1, 0.05, truth.shape[:2])[..., None].astype(np.float32)
    for image in (truth, grain, 0.5 * truth, np.roll(grain, scale // 2, axis=1)):
        assert _counts(image, truth, scale) == (0, 0)

    image = grain.copy()
    for row, column in ((20, 20), (20, 40), (50, 33)):
        image[row, column] = 0
    assert _counts(image, truth, scale) == (3, 0)

    def stamped(row, column, factor, high=1, wide=1):
        image = grain.copy()
        image[row * scale : (row + high) * scale, column * scale : (column + wide) * scale] *= factor
        return _counts(image, truth, scale)

    assert stamped(4, 5, 0.05) == (scale**2, 1)  # a stamp that is black is a hole of s x s pixels, too
    assert stamped(4, 5, 0.3) == (0, 1)
    assert stamped(4, 5, 3) == (0, 1)
    assert stamped(4, 4, 0.3, high=2, wide=3) == (0, 1)  # one of six LRHS pixels
    image = grain.copy()
    for row, column in ((2, 2), (4, 6), (8, 4)):
        image[row * scale :, column * scale :][:scale, :scale] *= 0.3
    assert _counts(image, truth, scale) == (0, 3)
    off = grain.copy()
    off[21 : 21 + scale, 21 : 21 + scale] *= 0.3  # dark, but not along the grid
    assert _counts(off, truth, scale) == (0, 0)


def test_what_is_dark_in_the_reference_is_no_hole():
    truth = _textured()
    truth[40, 40], truth[41, 41] = 1e-5, 0.02
    assert _counts(truth, truth, 4) == (0, 0)
    image = truth.copy()
    image[40, 40], image[41, 41] = 0, 0.0005
    assert _counts(image, truth, 4) == (1, 0)  # the first one is below the floor


def test_holes_and_stamps_are_faults():
    row = {"finite": True, "relmse_trimmed": 0.1, "relmse_enlarged": 0.2, "range": 1.0, "warnings": []}
    row |= {"psnr": 30.0, "group": "x", "holes": 3, "stamps": 1}
    assert measures.verdict(row) == ("suffers", "holes; stamps")
    assert measures.verdict(row | {"holes": 0, "stamps": 0})[0] == "holds"


@pytest.mark.parametrize("made", [lambda size: analytic.door_ajar(size, 1 / 50), analytic.dark_room])
def test_light_is_rare(made):
    """Few HRLS samples are lit, and their mean is the reference."""
    rendered = analytic.render(made(SIZE), 1, np.random.default_rng(1)).layers["rgb"]
    truth = analytic.reference(made(SIZE))
    lit = luminance(rendered) > 0.3 * luminance(truth).mean()
    assert 0.005 < lit.mean() < 0.15
    many = analytic.render(made(SIZE), 300, np.random.default_rng(1)).layers["rgb"]
    assert many.mean() == pytest.approx(truth.mean(), rel=0.05)


def test_a_slit_is_thinner_than_a_pixel():
    """A quarter of the samples of its column hit the lamp behind it."""
    scene = analytic.slit(64, 100.0)
    truth = luminance(analytic.reference(scene))
    column = truth[30, :].argmax()
    assert truth[30, column] == pytest.approx(25 * 0.91, rel=0.05)
    assert truth[30, [column - 1, column + 1]].max() < 1
