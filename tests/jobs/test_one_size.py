# SPDX-License-Identifier: Apache-2.0
"""Files and shots of one render a frame, and of two renders of one size."""

import json

import numpy as np
import pytest

from oiio_msspl import InputError, InputOptions, WriteOptions, fuse_files, fuse_shot
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.inspection import inspect_file, inspect_noise
from oiio_msspl.jobs.farm.openjd import make_job
from oiio_msspl.jobs.fitting import check_files
from oiio_msspl.jobs.sequence import find_shot
from oiio_msspl.model.encoding import encode_radiance
from tests.conftest import noisy, picture, read_bits, rgb, same_bits, spread, write_exr

HEIGHT, WIDTH = 96, 132


def truth():
    """A picture with clean edges."""
    return box_downsample(picture(4 * HEIGHT, 4 * WIDTH), 4)


def write_render(path, seed=0, spp=4, sigma=0.0, **more):
    clean = truth()
    beauty = noisy(clean, spp, seed)
    beauty = spread(beauty, sigma) if sigma else beauty
    lamps = (
        {f"light{i}.{c}": plane for i in (1, 2) for c, plane in rgb(beauty / 2).items()} if more.pop("lamps", 0) else {}
    )
    albedo = np.full_like(clean, 0.5) if more.pop("plain", 0) else clean.clip(0, 1)
    aovs = rgb(albedo, "albedo.") | rgb(np.full_like(clean, 0.5), "N.", "XYZ")
    depth = {"Z": np.full((HEIGHT, WIDTH), seed + 1, np.float32)}
    return write_exr(path, rgb(beauty) | aovs | depth | lamps, **more)


def error(path):
    (part,) = [channels for _, channels in read_bits(path) if "R" in channels]
    fused = np.stack([part[c] for c in "RGB"], axis=-1).astype(np.float32)
    return np.abs(encode_radiance(fused, 1.0) - encode_radiance(truth(), 1.0)).mean()


def test_one_file_and_two_of_one_size(tmp_path):
    """Two are better than one. Other layers are those of the last one."""
    a, b, out = write_render(tmp_path / "a.exr", 1, 1), write_render(tmp_path / "b.exr", 2, 1), tmp_path / "out.exr"
    one = fuse_files(None, b, out, model="best").as_dict()
    assert (one["scale"], one["model"], one["lrhs"], one["hrls"]) == (1, "joint-large-x1", None, str(b))
    assert one["lrhs_aovs"] == {} and one["warnings"] == []
    assert not {"msspl/lrhs", "msspl/spp_lrhs"} & open_exr(out).metadata.keys()
    error_of_one = error(out)
    two = fuse_files(a, b, out, model="best", overwrite=True).as_dict()
    assert (two["scale"], two["lrhs"], two["warnings"]) == (1, str(a), [])
    assert error(out) < error_of_one
    (depth,) = [part["Z"] for _, part in read_bits(out) if "Z" in part]
    assert (depth == 3).all()


def test_samples_say_how_two_renders_are_averaged(tmp_path):
    a, b, out = write_render(tmp_path / "a.exr", 1, 1), write_render(tmp_path / "b.exr", 2, 64), tmp_path / "out.exr"
    errors = {}
    for spp in ((1.0, 64.0), (64.0, 1.0)):
        report = fuse_files(a, b, out, inputs=InputOptions(lr_spp=spp[0], hr_spp=spp[1]), overwrite=True)
        assert report.spp_avg == 65
        errors[spp] = error(out)
    assert errors[1.0, 64.0] < 0.5 * errors[64.0, 1.0]


def test_spread_noise_of_one_render_is_noticed(tmp_path):
    render = write_render(tmp_path / "hr.exr", 1, sigma=0.5)
    report = fuse_files(None, render, tmp_path / "out.exr", model="fast")
    assert report.model == "joint-small-spread-x1"


@pytest.mark.parametrize(("quality", "family", "most"), [("balanced", "joint", 0.8), ("best", "joint-large", 1.05)])
def test_renders_with_little_noise_have_a_model_of_their_own(tmp_path, quality, family, most):
    """It has at most this share of the error. It predicts no error, so the other one does if that is asked for."""
    a, b, small, out = (tmp_path / f"{name}.exr" for name in ("a", "b", "small", "out"))
    for seed, path in enumerate((a, b)):
        write_render(path, seed, 256, plain=True)
    write_exr(small, rgb(noisy(box_downsample(truth(), 2), 256, seed=3)))
    for first, scale in ((None, 1), (a, 1), (small, 2)):
        report = fuse_files(first, b, out, model=quality, overwrite=True)
        assert report.model == f"{family}-clean-x{scale}"
        assert any("little noise" in note for note in report.hr.notes)
        own = error(out)
        fuse_files(first, b, out, model=f"{family}-x{scale}", overwrite=True)
        assert own < most * error(out)
        with_error = WriteOptions(error_layer=True)
        assert fuse_files(first, b, out, model=quality, write=with_error, overwrite=True).model == f"{family}-x{scale}"
        with pytest.raises(InputError, match=f"use --model {family}-x{scale}"):
            fuse_files(first, b, out, model=f"{family}-clean-x{scale}", write=with_error, overwrite=True)
    fuse_files(None, write_render(tmp_path / "noisy.exr", 2, 1), out, model=quality, overwrite=True)
    assert f"{family}-x1" in open_exr(out).metadata["msspl/model"]


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize(("quality", "family"), [("balanced", "joint"), ("best", "joint-large")])
def test_pairs_with_little_spread_noise_have_a_model_of_their_own(tmp_path, quality, family, scale):
    """It has less of the error at little noise. At more noise the other one is taken."""
    small, hr, out = tmp_path / "small.exr", tmp_path / "hr.exr", tmp_path / "out.exr"
    for spp, ending in ((4096, "-spread-clean"), (4, "-spread")):
        write_render(hr, 1, spp, sigma=0.5)
        write_exr(small, rgb(spread(noisy(box_downsample(truth(), scale), spp * scale**2, seed=3), 0.5)))
        report = fuse_files(small, hr, out, model=quality, overwrite=True)
        assert report.model == f"{family}{ending}-x{scale}"
        assert any("has spread the" in note for note in report.hr.notes)
        if spp == 4096:
            own = error(out)
            fuse_files(small, hr, out, model=f"{family}-spread-x{scale}", overwrite=True)
            assert own < error(out)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ("same seed", "have the same noise; render each with a noise seed of its own"),
        ("same file", "given twice"),
        ("a third of the size", r"a ratio of 3 is not supported .* or at the size of the HRLS"),
    ],
)
def test_what_does_not_fit_is_one_sentence(tmp_path, second, message):
    b = write_render(tmp_path / "b.exr", 2)
    a = b if second == "same file" else write_render(tmp_path / "a.exr", 2)
    if second.startswith("a third"):
        write_exr(a, rgb(noisy(picture(HEIGHT // 3, WIDTH // 3), 9)))
    with pytest.raises(InputError, match=message) as caught:
        fuse_files(a, b, tmp_path / "out.exr", model="fast")
    assert "\n" not in str(caught.value) and not (tmp_path / "out.exr").exists()
    assert check_files(a, b).problem == str(caught.value)
    assert check_files(None, b).fits


@pytest.mark.parametrize("model", ["fast", "best"])
@pytest.mark.parametrize("seeds", [1, 2])
def test_passes_sum_to_the_beauty(tmp_path, seeds, model):
    paths = [write_render(tmp_path / f"{seed}.exr", seed, lamps=True) for seed in range(seeds)]
    first = paths[0] if seeds == 2 else None
    inputs = InputOptions(sums=("lamps=light1+light2",))
    layout = WriteOptions("multilayer")
    report = fuse_files(first, paths[-1], tmp_path / "out.exr", inputs=inputs, model=model, write=layout)
    assert report.passes["lamps"].startswith("fused")
    ((_, part),) = read_bits(tmp_path / "out.exr")
    for c in "RGB":
        np.testing.assert_allclose(part[f"light1.{c}"] + part[f"light2.{c}"], part[c], rtol=2e-5)
    noise = np.abs(part["light1.R"] - picture(HEIGHT, WIDTH)[..., 0] / 2).mean()
    assert noise < 0.1 * picture(HEIGHT, WIDTH)[..., 0].mean()


def write_shot(folder, seed):
    """Four frames of a camera that stands still."""
    folder.mkdir()
    for number in range(1, 5):
        write_render(folder / f"hr.{number:04}.exr", 10 * number + seed)
    return folder


@pytest.mark.parametrize("seeds", [1, 2])
def test_a_shot_in_chunks_has_the_pixels_of_one_run(tmp_path, seeds):
    """And its neighbours take noise away."""
    folders = [write_shot(tmp_path / f"seed{seed}", seed) for seed in range(seeds)]
    renders = (folders[0] if seeds == 2 else None), folders[-1]
    report = fuse_shot(*renders, tmp_path / "whole", model="fast", report_path=tmp_path / "report.json")
    assert report.exit_code == 0 and report.temporal.startswith("with 4 frames")
    saved = json.loads((tmp_path / "report.json").read_text())
    assert (saved["lrhs"] is None) == (seeds == 1) and saved["frames"][0]["hrls"].endswith("hr.0001.exr")
    for chunk in ("1-2", "3-4"):
        fuse_shot(*renders, tmp_path / "chunks", frames=chunk, model="fast", skip_existing=True)
    fuse_shot(*renders, tmp_path / "alone", model="fast", temporal="off")
    for number in range(1, 5):
        whole, chunks, alone = (tmp_path / name / f"hr.{number:04}.exr" for name in ("whole", "chunks", "alone"))
        for (_, one), (_, other) in zip(read_bits(whole), read_bits(chunks), strict=True):
            assert all(same_bits(one[name], other[name]) for name in one)
        assert error(whole) < 0.9 * error(alone)


def test_a_folder_with_several_sequences_names_them(tmp_path):
    folder = write_shot(tmp_path / "shot", 0)
    write_render(folder / "lr.0001.exr")
    with pytest.raises(
        InputError, match=r"has several sequences \(hr\.####\.exr, lr\.####\.exr\); name the one to fuse"
    ):
        find_shot(None, folder, tmp_path / "out")
    assert len(find_shot(None, folder / "hr.####.exr", tmp_path / "out").frames) == 4


def test_a_job_has_one_sequence_of_renders(tmp_path):
    job = make_job(None, write_shot(tmp_path / "shot", 0), tmp_path / "out", chunk=2)
    names = [parameter["name"] for parameter in job.template["parameterDefinitions"]]
    arguments = job.template["steps"][0]["script"]["actions"]["onRun"]["args"]
    assert "HRFolder" in names and "LRFolder" not in names
    assert arguments[:2] == ["{{Param.HRFolder}}/{{Param.HRName}}", "--output"]


@pytest.mark.parametrize(("sigma", "noise"), [(0, "independent"), (0.5, "spread")])
def test_inspection_of_one_render_tells_its_noise(tmp_path, sigma, noise):
    inspection = inspect_file(write_render(tmp_path / "hr.exr", 1, sigma=sigma), InputOptions())
    inspect_noise([inspection])
    assert inspection.noise == noise
    assert any(fact.startswith("noise: ") for fact in inspection.facts)
