# SPDX-License-Identifier: Apache-2.0
"""Scores are what they claim to be, every method gets the samples that it should, and peers are at their best."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")

from oiio_msspl import Render
from oiio_msspl.image.colour import srgb
from research.benchmarks import accuracy, oidn, one_size, passes, peers, results, scenes, tables
from research.benchmarks.layout import Column, Line, Table, clean, ratio_with_interval, with_interval
from tests.conftest import downsample

GREY = np.full((16, 16, 3), 0.25, np.float32)


def scene_of(reference, image):
    source = Render.from_arrays("HRLS", rgb=image)
    return scenes.Scene(
        "a", reference, lambda spp: source, lambda s, spp: Render.from_arrays("", rgb=downsample(image, s))
    )


def test_scores_are_those_of_the_definitions():
    """PSNR is of clipped sRGB values; RelMSE is 0.5 d^2 / (r^2 + 0.01), and with (1, 1e-4) d^2 / (r^2 + 1e-4)."""
    image = np.full_like(GREY, 0.36)
    row = accuracy.measure(scene_of(GREY, image), [], pattern="HRLS")[0]
    assert row["psnr"] == pytest.approx(-20 * np.log10(srgb(image[0, 0, 0]) - srgb(GREY[0, 0, 0])), abs=1e-3)
    assert row["relmse"] == pytest.approx(0.5 * 0.11**2 / (0.25**2 + 0.01), rel=1e-4)
    assert row["relmse_gharbi"] == pytest.approx(0.11**2 / (0.25**2 + 1e-4), rel=1e-4)


def test_two_seeds_are_averaged_by_their_samples(monkeypatch):
    monkeypatch.setattr(one_size, "oidn", scenes.beauty)
    scene = SimpleNamespace(hrls=lambda spp: Render.from_arrays("", rgb=np.full_like(GREY, spp)))
    name, model, picture_of = next(one_size.of_two(scene, (1, 3)))
    assert (name, model) == ("OIDN, two seeds", None) and (picture_of() == (1 * 1 + 3 * 3) / 4).all()


def test_black_references_and_lamps_keep_scores_finite():
    """The constant of RelMSE bounds errors on black; light beyond white counts as white in PSNR."""
    black = np.zeros_like(GREY)
    row = accuracy.measure(scene_of(black, GREY), [], pattern="HRLS")[0]
    assert row["relmse"] == pytest.approx(0.5 * 0.25**2 / 0.01, rel=1e-4)
    lamp = np.full_like(GREY, 50)
    row = accuracy.measure(scene_of(np.ones_like(GREY), lamp * (1 + GREY)), [], pattern="HRLS")[0]
    assert row["psnr"] > 60


def test_flip_gets_the_reference_and_the_picture_in_srgb(monkeypatch):
    given = []
    fake = SimpleNamespace(evaluate=lambda *args, **options: given.append((args, options)) or (None, 0.5, None))
    monkeypatch.setitem(sys.modules, "flip_evaluator", fake)
    assert accuracy.mean_flip(2 * GREY, GREY) == 0.5
    (reference, image, kind), options = given[0]
    np.testing.assert_array_equal(reference, srgb(GREY))
    np.testing.assert_array_equal(image, srgb(2 * GREY))
    assert (kind, options["applyMagma"]) == ("LDR", False)


class Source:
    """A render that only knows its samples, per pixel of the final frame."""

    def __init__(self, hrls=0, lrhs=0, scale=0):
        self.samples, self.scale = (hrls, lrhs), scale


@pytest.fixture
def samples(monkeypatch):
    """Return for an average spp: method -> samples (HRLS, LRHS) of what it read."""
    log = []

    def read(source, *_):
        log.append(source)
        return GREY

    for name in ("oidn", "oidn_prefiltered", "oidn_split", "beauty"):
        monkeypatch.setattr(accuracy, name, read)
    monkeypatch.setattr(accuracy, "oidn_on_average", lambda lr, hr: [read(lr), read(hr)][0])
    monkeypatch.setattr(accuracy, "match_local_means", lambda image, means: image)
    monkeypatch.setattr(accuracy, "fuse", lambda lr, hr, session: SimpleNamespace(rgb=[read(lr), read(hr)][0]))
    session = SimpleNamespace(name="joint-x2", contract=SimpleNamespace(scale=2))
    scene = scenes.Scene("a", GREY, Source, lambda s, n: Source(lrhs=n, scale=s))

    def samples_of(spp):
        read_by = {}
        for method, call in accuracy.methods(scene, [session], spp):
            log.clear()
            call()
            read_by[method] = tuple(np.max([source.samples for source in log], axis=0).tolist()) if log else None
        return read_by

    return samples_of


@pytest.mark.parametrize("spp", accuracy.AVERAGES)
def test_every_method_gets_its_share_of_the_samples(samples, spp):
    """Models read half of the samples in either render, or the division that they name: spp_LRHS / s^2 + spp_HRLS."""
    found = samples(spp)
    half = spp // 2
    for method, (hrls, lrhs) in ((m, s) for m, s in found.items() if s):
        if ":" in method:
            more, less = (int(n) for n in method.rpartition(", ")[2].split(":"))
            assert hrls == spp * more // (more + less), method
            assert lrhs == (spp - hrls if method.startswith("joint") else 0), method
        elif method.endswith("same samples"):
            assert (hrls, lrhs) == (spp, 0), method
        elif method.startswith("joint") or "together" in method:
            assert (hrls, lrhs) == (half, half), method
        else:
            assert (hrls, lrhs) == (half, 0), method
    assert "joint-x2" in found
    assert {f"joint-x2, {a}:{b}" in found for a, b in accuracy.UNEVEN if spp % (a + b) == 0} <= {True}


def test_files_have_the_samples_that_their_names_say(tmp_path, monkeypatch):
    """The LRHS with n samples for every HRLS pixel has n s^2 spp."""
    opened = []
    monkeypatch.setattr(scenes, "open_exr", lambda path: opened.append(path.name))
    monkeypatch.setattr(scenes, "map_render", lambda file: Render.from_arrays("", rgb=GREY))
    scene = scenes._render(tmp_path)
    scene.hrls(4)
    scene.lrhs(8, 2)
    assert opened == ["ref.exr", "hr_4spp.exr", "lr_x8_128spp.exr"]


def test_each_call_of_oidn_is_the_one_that_its_name_says(monkeypatch):
    """ "fast" has the small networks; all others the largest."""
    for call in ("oidn", "oidn_prefiltered", "oidn_split"):
        monkeypatch.setattr(accuracy, call, lambda source, quality="high", call=call: (call, quality))
    monkeypatch.setattr(accuracy, "oidn_on_average", lambda lr, hr: "average")
    monkeypatch.setattr(accuracy, "match_local_means", lambda image, means: (image, means))
    scene = scenes.Scene("a", GREY, Source, lambda s, n: Source(lrhs=n, scale=s))
    made = {name: call() for name, call in accuracy.methods(scene, [], 8) if "OIDN" in name}
    for name, result in made.items():
        call = "oidn_split" if "split" in name else "oidn_prefiltered" if "prefiltered" in name else "oidn"
        quality = "fast" if "fast" in name else "high"
        if "together" in name:
            assert result == ((call, "high"), "average"), name
        else:
            assert result == (call, quality), name


def test_prefiltered_oidn_gets_clean_guides_and_is_told_so(monkeypatch):
    """Albedo and normal are denoised apart at high quality; then the colour, in HDR, with `cleanAux`."""
    calls = []

    def run_filter(images, **options):
        calls.append((images, options))
        return f"clean {next(iter(images))}"

    monkeypatch.setattr(oidn, "run_filter", run_filter)
    peers.oidn_prefiltered(Render.from_arrays("hr", rgb=GREY, albedo=GREY, normal=GREY))
    assert [set(images) for images, _ in calls] == [{"albedo"}, {"normal"}, {"color", "albedo", "normal"}]
    assert [options.get("quality") for _, options in calls[:2]] == ["high", "high"]
    assert calls[2][1] == {"hdr": True, "cleanAux": True}
    assert calls[2][0]["albedo"] == "clean albedo" and calls[2][0]["normal"] == "clean normal"
    calls.clear()
    oidn.denoise_prefiltered(GREY, GREY)
    assert [options for _, options in calls] == [{"quality": "high"}, {"hdr": True, "cleanAux": True}]


def row(scene, method, psnr, relmse=0.01, spp=2):
    return {"scene": scene, "spp": spp, "method": method, "psnr": psnr, "relmse": relmse}


def test_means_leave_out_noisy_references_and_methods_that_were_not_measured_everywhere():
    noisy = next(iter(scenes.NOISY_REFERENCE))
    rows = [row("a", "x", 10.0), row("a", "x", 20.0), row("b", "x", 25.0), row(noisy, "x", 99.0), row("a", "y", 1.0)]
    mean, *by_scene = accuracy.with_means(rows)
    assert mean == row("mean", "x", 20.0)  # the two views of "a" count once
    assert by_scene == [row("a", "x", 15.0), *rows[2:]]
    assert accuracy.mean_note(by_scene).endswith(f"Left out, because the reference is noisy: {noisy}.")


def test_the_interval_is_that_of_the_mean_over_drawn_scenes():
    """For many scenes, the bootstrap's interval is the normal one: 1.96 standard errors to each side."""
    values = np.random.default_rng(4).normal(1, 2, 400)
    mean, low, high = with_interval(values)
    error = 1.96 * values.std() / np.sqrt(values.size)
    assert mean == values.mean()
    assert (mean - low, high - mean) == (pytest.approx(error, rel=0.05), pytest.approx(error, rel=0.05))
    assert with_interval(values) == (mean, low, high)


def test_a_ratio_is_that_of_the_means():
    ours, theirs = np.array([1.0, 6.0]), np.array([2.0, 2.0])
    assert ratio_with_interval(ours, theirs) == pytest.approx((1.75, 0.5, 3.0))
    assert ratio_with_interval(ours, 4 * ours)[0] == 0.25


@pytest.fixture
def cell(monkeypatch):
    """Return the only cell of a table about "ours", whose peer is "theirs"."""
    noisy = next(iter(scenes.NOISY_REFERENCE))
    ours = [
        row("a", "ours", 32.0, 0.01),
        row("b", "ours", 31.0, 0.03),
        row("c", "ours", 30.0, 0.02),
        row("d", "ours", 33.0, 0.08),
    ]
    theirs = [
        row("a", "theirs", 30.0, 0.02),
        row("b", "theirs", 31.0, 0.02),
        row("c", "theirs", 30.5, 0.02),
        row("d", "theirs", 30.5, 0.04),
    ]
    others = [
        row(noisy, "ours", 99.0),
        row(noisy, "theirs", 0.0),
        row("mean", "ours", 31.0),
        row("a", "ours", 1.0, spp=8),
    ]
    rows = [r | results.stamp() for r in [*others, *ours, *theirs]]
    monkeypatch.setattr(results, "read", lambda name: rows)

    def cell_of(how, measure="psnr", **options):
        line = Line(["x"], {"method": "ours", "spp": 2, "scene": clean}, {"method": "theirs"})
        columns = [Column("c", measure, how=how, **options), Column("d", "psnr")]
        text = Table(("t",), tables.BY_SCENE, ("h",), [line], columns).text()
        return text.splitlines()[2].split("|")[2].strip()

    return cell_of


def test_cells_compare_a_method_with_its_peer_by_scene(cell):
    """More is better for PSNR, so a positive difference is a lead; noisy references don't count."""
    assert cell("difference") == "+1.00"
    assert cell("mean") == "31.50"
    assert cell("interval").startswith("+1.00 (-0.2")
    assert cell("ratio interval", "relmse").startswith("1.40 (")
    assert cell("ratio", "relmse") == "1.25"
    assert cell("max") == "33.00" and cell("count") == "4"
    assert cell("quotient", "psnr/relmse", form="{:.0f}") == f"{126 / 0.14:.0f}"
    assert cell("count", "psnr=30.0") == "0"  # names of verdicts are text
    assert cell("mean", "psnr/relmse") == "31.50 / 0.0350"


def test_a_cell_is_empty_if_its_peer_was_not_measured_on_every_scene(cell, monkeypatch):
    rows = [r for r in results.read("t") if (r["scene"], r["method"]) != ("b", "theirs")]
    monkeypatch.setattr(results, "read", lambda name: rows)
    assert cell("mean") == "31.50"
    assert cell("difference") == ""


@pytest.mark.parametrize(
    ("peer", "ending"),
    [
        (tables.ON_HRLS, " on the HRLS"),
        (tables.JOINED, " on both x2, together"),
        (tables.SAME_SAMPLES, ", same samples"),
    ],
)
def test_each_peer_is_the_call_of_oidn_with_the_highest_mean_on_its_input(peer, ending):
    psnr = {}
    for r in results.where(results.read("accuracy"), scene="mean"):
        if r["method"].startswith("OIDN") and r["method"].endswith(ending):
            psnr.setdefault(r["method"], []).append(r["psnr"])
    assert len(psnr) > 1 and max(psnr, key=lambda method: np.mean(psnr[method])) == peer


def test_layers_are_scored_apart():
    """A layer with less than 1 % of the light is not scored."""
    reference = np.stack([GREY, 0.5 * GREY, 1e-4 * GREY])
    layers = reference.copy()
    layers[0] *= 2
    total, first, second = passes.scores(layers, reference, ["a", "b", "faint"])
    assert (first["layer"], second["layer"]) == ("a", "b")
    assert first["psnr"] == pytest.approx(-20 * np.log10(srgb(0.5) - srgb(0.25)), abs=1e-3)
    assert first["relmse"] == pytest.approx(0.5 * 0.25**2 / (0.25**2 + 0.01), rel=1e-4)
    assert total["psnr"] == pytest.approx((first["psnr"] + second["psnr"]) / 2)
