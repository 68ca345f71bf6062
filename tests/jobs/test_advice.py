# SPDX-License-Identifier: Apache-2.0
"""Advice on what more would help, and its figures, which are those of the page of results."""

import re

import numpy as np
import pytest

from oiio_msspl.inspection import inspect_file, inspect_noise
from oiio_msspl.jobs import advice
from oiio_msspl.jobs.fitting import check_files
from oiio_msspl.jobs.inputs import InputOptions, map_pair
from tests.conftest import downsample, noisy, picture, rgb, spread, write_exr
from tests.test_pages import ROOT

RESULTS = (ROOT / "docs/design/results.md").read_text(encoding="utf-8")


def rows(name):
    """The rows of a table of the page of results: {first cells: the others}."""
    table = re.search(rf"<!-- begin: {name} -->\n(.*?)\n\n", RESULTS, re.DOTALL)[1]
    return [[cell.strip().replace("`", "") for cell in line.strip("| ").split(" | ")] for line in table.splitlines()]


def test_the_figures_are_those_of_the_page_of_results():
    # Each PSNR, of 2 to 128 spp, stands before its difference to OIDN's.
    psnr = {tuple(row[:2]): np.array(row[2::2], float) for row in rows("one_render_or_two")[2:]}
    balanced = "--quality balanced"
    one, *two = (psnr[given, balanced] for given in ("one render", "two sizes, x2", "two sizes, x4"))
    gains = np.concatenate([one - pair for pair in two])
    assert pytest.approx((gains.min(), gains.max())) == advice.ONE_OVER_TWO_SIZES
    counts = {row[0]: row[1:] for row in rows("sample_counts")}
    columns = next(iter(counts.values()))
    eight = dict(zip(columns, counts["--quality balanced"], strict=True))
    assert pytest.approx(float(eight["8 spp, 3:1"]) - float(eight["8 spp, 1:1"])) == advice.THREE_QUARTERS
    shots = next(row for row in rows("shots") if row[0] == "--quality balanced, x2")
    assert float(shots[2].split()[0]) == advice.NEIGHBOURS
    detail = {row[0]: row[1:] for row in rows("detail")}
    header = detail["case"]
    lit = dict(zip(header, detail["lit display"], strict=True))
    assert (float(lit["64-16: best, network alone"]), float(lit["64-16: best"])) == advice.BOTH_SHOW
    noise = {row[0]: row[1] for row in rows("spread_noise")}
    ours, oidn = (noise[name] for name in ("--quality balanced", "OIDN at full resolution, prefiltered"))
    assert (float(oidn.split()[0]), float(ours.split()[0])) == advice.SPREAD_NOISE


def write(path, image, *, albedo=True, spp=None):
    layers = rgb(image) | (rgb(np.clip(image, 0, 1), "albedo.") if albedo else {})
    return write_exr(path, layers, **({} if spp is None else {"samplesPerPixel": int(spp)}))


def codes(low, high, **spp):
    lr, hr = map_pair(low or high, high, InputOptions(**spp))
    return {text.code for text in advice.advise(lr, hr, None, in_shot=False)}


def test_one_render_is_told_of_a_second_seed_and_not_of_a_small_render(tmp_path):
    high = write(tmp_path / "hr.exr", noisy(picture(64, 64), 4))
    found = {text.code: text for text in check_files(None, high).advice}
    assert found.keys() == {"second_seed", "no_lrhs"}
    assert "cost no samples" in found["second_seed"] and "0.2 to 1.5 dB" in found["no_lrhs"]


def test_a_pair_is_told_where_its_samples_belong(tmp_path):
    clean = picture(64, 64)
    low, high = write(tmp_path / "lr.exr", downsample(clean, 2)), write(tmp_path / "hr.exr", clean)
    assert codes(low, high) == {"no_lrhs"}
    assert codes(low, high, lr_spp=16, hr_spp=4) == {"no_lrhs", "more_hr_samples"}
    assert codes(low, high, lr_spp=6, hr_spp=4) == {"no_lrhs"}  # as the guide says
    assert codes(low, high, lr_spp=4, hr_spp=1) == {"no_lrhs"}
    text = next(t for t in advice.advise(*map_pair(low, high, InputOptions(lr_spp=16, hr_spp=4)), None, in_shot=False))
    assert "6 spp, and 8 in the small one" in text  # 8 samples a pixel of the frame, as before


def test_two_seeds_are_told_of_missing_layers_alone(tmp_path):
    one, two = (write(tmp_path / f"{seed}.exr", noisy(picture(64, 64), 4, seed), albedo=False) for seed in (1, 2))
    assert codes(one, two) == {"add_albedo"}


def test_frames_of_a_shot_are_told_of_motion_vectors(tmp_path):
    for number in (1, 2):
        high = write(tmp_path / f"hr.{number:04}.exr", noisy(picture(64, 64), 4, number))
    inspections = [inspect_file(tmp_path / "hr.0001.exr", InputOptions())]
    inspect_noise(inspections)
    data = inspections[0].as_dict()["advice"]
    assert [entry["code"] for entry in data] == ["add_motion", "second_seed", "no_lrhs"]
    assert "2.7 dB" in data[0]["text"] and "no samples" in data[0]["text"]
    assert "add_motion" not in check_files(None, high).codes  # no frame follows


def test_a_result_gets_no_advice(tmp_path):
    image = picture(64, 64)
    write_exr(tmp_path / "out.exr", rgb(image), **{"msspl/model": "joint-x1"})
    inspections = [inspect_file(tmp_path / "out.exr", InputOptions())]
    inspect_noise(inspections)
    assert inspections[0].advice == [] == check_files(None, tmp_path / "out.exr").advice
    assert any(fact.startswith("a result, fused with joint-x1") for fact in inspections[0].facts)


def test_spread_noise_is_told_of_a_box_filter(tmp_path):
    clean = picture(128, 128)
    low, high = (write(tmp_path / f"{n}.exr", spread(noisy(clean, 1, n), 0.8)) for n in (1, 2))
    assert {"box_filter"} == check_files(low, high).codes - {"same_noise"}
