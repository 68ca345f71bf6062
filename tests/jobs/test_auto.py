# SPDX-License-Identifier: Apache-2.0
"""The model that a quality means: for a frame, for a shot, and for a job."""

import pytest

from oiio_msspl import InputError, InputOptions, WriteOptions, fuse_files, fuse_shot, open_exr
from oiio_msspl.fusion.motion.source import VECTORS, MotionSource
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.jobs.checks import model_of_shot
from oiio_msspl.jobs.farm.openjd import make_job
from oiio_msspl.jobs.plan import TemporalOptions, _is_slow, plan_temporal
from oiio_msspl.jobs.sequence import find_shot
from oiio_msspl.model.catalogue import load_model, shipped_models
from tests.conftest import noisy, picture, read_bits, rgb, spread, write_exr


def write_pair(folder, name, sigma, extra=None):
    clean = picture(128, 192)
    images = noisy(box_downsample(clean, 4), 16, seed=1), noisy(clean, 1)
    for render, image in zip(("lr", "hr"), images, strict=True):
        (folder / render).mkdir(exist_ok=True)
        channels = rgb(image if sigma is None else spread(image, sigma))
        if extra and render == "hr":
            channels |= rgb(clean, f"{extra}.")
        write_exr(folder / render / f"{name}.exr", channels)


@pytest.mark.parametrize(("sigma", "ending"), [(None, ""), (0.5, "-spread")])
@pytest.mark.parametrize(
    ("quality", "model"), [(None, "joint-x4"), ("fast", "joint-small-x4"), ("best", "joint-large-x4")]
)
def test_a_frame_gets_the_model_for_its_noise(tmp_path, sigma, ending, quality, model):
    write_pair(tmp_path, "a", sigma, "albedo")
    report = fuse_files(tmp_path / "lr/a.exr", tmp_path / "hr/a.exr", tmp_path / "out.exr", model=quality)
    assert report.model == model.replace("-x4", f"{ending}-x4")
    assert any("spread the noise" in note for note in report.as_dict()["notes"]) == bool(ending)


def test_the_best_quality_needs_an_albedo_or_a_normal(tmp_path, caplog):
    """Without them it takes three times as long and is no better."""
    note = "without an albedo and a normal, the quality best gains nothing, so the model is joint"
    write_pair(tmp_path, "a.0001", None)
    pair = tmp_path / "lr/a.0001.exr", tmp_path / "hr/a.0001.exr"
    report = fuse_files(*pair, tmp_path / "out.exr", model="best")
    assert (report.model, note in report.as_dict()["notes"]) == ("joint-x4", True)
    assert fuse_files(*pair, tmp_path / "named.exr", model="joint-large").model == "joint-large-x4"
    assert fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "shot", model="best").exit_code == 0
    assert note in caplog.text
    with pytest.raises(InputError, match=r"hr/a\.0001\.exr has neither an albedo nor a normal; name them with --map"):
        fuse_files(*pair, tmp_path / "more.exr", model="best", write=WriteOptions(data_passes=True))
    write_pair(tmp_path, "normal", None, "N")
    report = fuse_files(tmp_path / "lr/normal.exr", tmp_path / "hr/normal.exr", tmp_path / "out2.exr", model="best")
    assert report.model == "joint-large-x4"


def test_a_job_s_model_has_as_many_neighbours_as_one_run(tmp_path, monkeypatch):
    """Without an albedo and a normal, best is the default quality, also in this."""
    for number in range(3):
        write_pair(tmp_path, f"a.{number:04}", None)
    pair, options = (tmp_path / "lr", tmp_path / "hr"), TemporalOptions()
    shot = find_shot(*pair, tmp_path / "out")
    job = make_job(*pair, tmp_path / "out", model="best").template["steps"][0]["script"]["actions"]["onRun"]["args"]
    assert job[-2:] == ["--model", "joint"]
    found = MotionSource(VECTORS, "as vectors say")
    monkeypatch.setattr("oiio_msspl.jobs.plan.find_motion", lambda *arguments, **more: found)
    plans = [plan_temporal(shot, InputOptions(), options, model) for model in ("best", "joint", "joint-large")]
    assert [plan.count for plan in plans] == [4, 4, 6]


@pytest.mark.parametrize(
    ("name", "scale", "layers"),
    [
        ("best", 2, ["joint-small-x2", "mean-x1"]),
        ("best", 4, ["joint-small-x4"]),
        ("joint-large-spread", 2, ["joint-small-spread-x2", "mean-spread-x1"]),
        ("joint-large-spread", 8, ["joint-small-spread-x8"]),
        ("balanced", 4, []),
    ],
)
def test_only_the_best_quality_has_a_network_for_single_layers(name, scale, layers):
    """It copes with spread noise where the model of the beauty does."""
    session = load_model(scale, name, threads=1)
    assert [session.layer_session(half=half).name for half in (False, True)[: len(session.layers)]] == layers
    assert "mean-x1" not in shipped_models()  # it is for no pair


def test_a_model_is_taken_as_it_is_named(tmp_path, caplog):
    """If it leaves spread noise, the user is told, for a frame and for a shot."""
    write_pair(tmp_path, "a.0001", 0.5)
    note = "and joint-small leaves such noise; use --model joint-small-spread"
    pair = tmp_path / "lr/a.0001.exr", tmp_path / "hr/a.0001.exr"
    for model, told in (("joint-small", True), ("joint-small-spread", False), ("paper-x4", False)):
        report = fuse_files(*pair, tmp_path / f"{model}.exr", model=model)
        assert report.model == model.removesuffix("-x4") + "-x4"
        assert any(note in each for each in report.as_dict()["notes"]) == told
    assert fuse_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out", model="joint-small").exit_code == 0
    assert f"frame 1: the pixel filter has spread the noise over neighbouring pixels, {note}" in caplog.text


def test_a_black_frame_does_not_choose_the_model_of_a_shot(tmp_path, monkeypatch):
    """Shots fade in."""
    for number in range(1, 4):
        write_pair(tmp_path, f"a.{number:04}", 0.5)
    for name in ("lr", "hr"):
        path = tmp_path / name / "a.0001.exr"
        write_exr(path, {c: 0 * plane for c, plane in read_bits(path)[0][1].items()})
    pair = tmp_path / "lr", tmp_path / "hr", tmp_path / "out"
    assert fuse_shot(*pair, frames=[1, 3]).exit_code == 0
    assert open_exr(tmp_path / "out/a.0003.exr").metadata["msspl/model"] == "joint-spread-x4"
    action = make_job(*pair).template["steps"][0]["script"]["actions"]["onRun"]
    assert action["args"][-2:] == ["--model", "joint-spread"]


def test_a_black_shot_gets_the_model_for_its_layers(tmp_path):
    """Without an albedo, `best` gains nothing."""
    for number in (1, 2):
        write_pair(tmp_path, f"a.{number:04}", None)
        for name in ("lr", "hr"):
            path = tmp_path / name / f"a.{number:04}.exr"
            write_exr(path, {c: 0 * plane for c, plane in read_bits(path)[0][1].items()})
    shot = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert model_of_shot(shot, InputOptions(), "best") == "joint"


@pytest.mark.parametrize("folder", ["", "joint-large/"])
def test_the_path_of_a_model_does_not_say_that_it_is_slow(folder):
    assert _is_slow("best") and _is_slow("joint-large-x4")
    assert not _is_slow(f"{folder}joint-large-mine.onnx") and not _is_slow(f"/models/{folder}x.onnx")


def test_all_frames_of_a_shot_and_its_job_get_the_model_of_the_first_pair(tmp_path, caplog, monkeypatch):
    """Also in a second run that begins with another frame. A broken pair is passed over. The user is told, and a run
    without a frame to fuse reads none."""
    for number, sigma in ((1, None), (2, 0.5), (3, None)):
        write_pair(tmp_path, f"a.{number:04}", sigma)
    (tmp_path / "hr/a.0001.exr").write_bytes(b"broken")
    pair = tmp_path / "lr", tmp_path / "hr", tmp_path / "out"
    for frames in ([1, 2], None):
        report = fuse_shot(*pair, frames=frames, skip_existing=True)
    assert [result.status for _, result in sorted(report.results.items())] == ["failed", "skipped", "fused"]
    assert open_exr(tmp_path / "out/a.0003.exr").metadata["msspl/model"] == "joint-spread-x4"
    assert "so the model is joint-spread" in caplog.text
    assert fuse_shot(*pair[:2], tmp_path / "chunk", frames=[3]).exit_code == 0
    assert open_exr(tmp_path / "chunk/a.0003.exr").metadata["msspl/model"] == "joint-spread-x4"
    monkeypatch.setattr("oiio_msspl.jobs.shot.model_of_shot", lambda *arguments, **options: pytest.fail("reads a pair"))
    assert fuse_shot(*pair, frames=[2, 3], skip_existing=True).results[2].status == "skipped"
    monkeypatch.undo()
    action = make_job(*pair).template["steps"][0]["script"]["actions"]["onRun"]
    assert action["args"][-2:] == ["--model", "joint-spread"]
