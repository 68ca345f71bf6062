# SPDX-License-Identifier: Apache-2.0
"""Shots: what becomes of good and bad frames, and of runs that are ended."""

import json
import os
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from oiio_msspl import InputError, InputOptions, MssplError, fuse_files, fuse_shot
from oiio_msspl._version import full_version
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.jobs import existing, memory, pipeline, write
from oiio_msspl.jobs import run as run_module
from oiio_msspl.jobs.plan import TemporalOptions
from oiio_msspl.jobs.run import ShotRun
from oiio_msspl.jobs.shot_report import read_earlier
from oiio_msspl.model.session import Session
from tests.conftest import downsample, noisy, picture, read_bits, rgb, write_exr
from tests.shots import HEIGHT, WIDTH, contents, layers, low_layers, make_shot, write_png


def run(folder, model, **more):
    """Fuse a shot frame by frame. tests/jobs/test_over_time.py has shots whose frames depend on each other."""
    more = {"temporal": TemporalOptions("off")} | more
    return fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(model), **more)


# ------------------------------------------------------------------------------------------------ good frames


def test_a_shot_is_what_its_frames_are_alone(tmp_path, bilinear_models):
    """Read ahead and written behind, each frame is bit for bit what fuse_files makes of it; so is its preview."""
    folder = make_shot(tmp_path, 3)
    report = run(folder, bilinear_models[4], previews=True)
    assert report.exit_code == 0
    assert sorted(contents(folder / "out")) == sorted(
        f"beauty.{n}.{e}" for n in (1001, 1002, 1003) for e in ("exr", "png")
    )
    (folder / "alone").mkdir()
    for frame in (1001, 1002, 1003):
        pair = (folder / f"lr/lr.{frame}.exr", folder / f"hr/beauty.{frame}.exr")
        out = folder / f"alone/beauty.{frame}.exr"
        fuse_files(*pair, out, model=str(bilinear_models[4]), preview_path=out.with_suffix(".png"))
    assert contents(folder / "out") == contents(folder / "alone")


def test_frames_without_room_in_memory_are_read_as_they_are_fused(tmp_path, bilinear_models, monkeypatch):
    folder = make_shot(tmp_path, 2)
    assert run(folder, bilinear_models[4]).exit_code == 0
    whole = contents(folder / "out")
    monkeypatch.setattr(memory, "_pixel_bytes", lambda render, features: 1 << 40)
    monkeypatch.setattr("oiio_msspl.aovs.mapped_render.MappedRender.load", pytest.fail)
    assert run(folder, bilinear_models[4], overwrite=True).exit_code == 0
    assert contents(folder / "out") == whole


def test_layers_that_the_model_does_not_read_are_not_loaded(tmp_path, monkeypatch):
    folder = make_shot(tmp_path, 2)
    for path in folder.glob("?r/*.exr"):
        values = picture(*((HEIGHT, WIDTH) if path.parent.name == "hr" else (HEIGHT // 4, WIDTH // 4)))
        write_exr(path, rgb(values) | rgb(values, "albedo.") | rgb(values, "specular."))
    loaded = []
    real = MappedRender.load_with

    def load_with(self, *arguments, **options):
        result = real(self, *arguments, **options)
        loaded.append(set(result[0].layers))
        return result

    monkeypatch.setattr(MappedRender, "load_with", load_with)
    assert run(folder, "fast").exit_code == 0
    assert loaded == [{"rgb", "albedo"}] * 4


def test_the_three_stages_overlap_and_hold_one_frame_each(tmp_path, bilinear_models, monkeypatch):
    """Each frame waits in its stage until the neighbours are in theirs: a pipeline that did not overlap would hang."""
    inside = {"read": 0, "fuse": 0, "write_settled": 0}
    most = dict(inside)
    began = {(stage, n): threading.Event() for stage in inside for n in range(1, 7)}

    def watched(owner, stage, meanwhile):
        real = getattr(owner, stage)

        def call(*arguments):
            number = arguments[owner is ShotRun].number
            inside[stage] += 1
            most[stage] = max(most[stage], inside[stage])
            began[stage, number].set()
            for other, offset in meanwhile:
                if (other, number + offset) in began:
                    assert began[other, number + offset].wait(20), f"{other} of {number + offset} does not overlap"
            result = real(*arguments)
            inside[stage] -= 1
            return result

        monkeypatch.setattr(owner, stage, call)

    watched(ShotRun, "read", [])
    watched(ShotRun, "fuse", [("read", 1), ("write_settled", -1)])
    watched(pipeline, "write_settled", [("fuse", 1)])
    folder = make_shot(tmp_path, 6, first=1)
    assert run(folder, bilinear_models[4]).exit_code == 0
    assert most == {"read": 1, "fuse": 1, "write_settled": 1}


def test_a_long_shot_loads_the_model_once_and_keeps_no_file_open(tmp_path, bilinear_models, monkeypatch):
    loaded, handles = [], []
    real = Session.__init__
    monkeypatch.setattr(Session, "__init__", lambda self, *a, **k: (loaded.append(a), real(self, *a, **k))[1])
    folder = make_shot(tmp_path, 12)
    report = run(folder, bilinear_models[4], progress=lambda *_: handles.append(len(os.listdir("/proc/self/fd"))))
    assert report.exit_code == 0
    assert len(loaded) == 1
    assert max(handles[3:]) <= handles[2] + 2


# ------------------------------------------------------------------------------------------------ bad frames


def truncate(path, share=0.6):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def black(lr, hr):
    write_exr(hr, layers(0) | rgb(np.zeros((HEIGHT, WIDTH, 3), np.float16)))


def both_black(lr, hr):
    black(lr, hr)
    write_exr(lr, rgb(np.zeros((HEIGHT // 4, WIDTH // 4, 3), np.float16)))


def not_finite(value):
    def spoil(lr, hr):
        channels = layers(0)
        channels["G"][3:5, 7] = value
        write_exr(hr, channels)

    return spoil


def all_nan(lr, hr):
    write_exr(hr, layers(0) | rgb(np.full((HEIGHT, WIDTH, 3), np.nan, np.float16)))


def swapped(lr, hr):
    low, high = lr.read_bytes(), hr.read_bytes()
    lr.write_bytes(high), hr.write_bytes(low)


def corrupt_header(lr, hr):
    data = bytearray(hr.read_bytes())
    data[8:60] = b"\xff" * 52
    hr.write_bytes(data)


def corrupt_pixels(lr, hr):
    data = bytearray(hr.read_bytes())
    data[-600:] = b"\xff" * 600
    hr.write_bytes(data)


def deep(lr, hr):
    samples = np.empty((4, 4), dtype=object)
    for index in np.ndindex(4, 4):
        samples[index] = np.ones(2, np.float32)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    with OpenEXR.File(header, {c: samples.copy() for c in "RGBZ"}) as file:
        file.write(str(hr))


def png(lr, hr):
    image = oiio.ImageBuf(oiio.ImageSpec(WIDTH, HEIGHT, 3, "uint8"))
    image.write(str(hr), "uint8", "png")


def folder_instead(lr, hr):
    hr.unlink()
    hr.mkdir()


def same_file(lr, hr):
    lr.unlink()
    os.link(hr, lr)


def other_size(height, width):
    def resize(lr, hr):
        write_exr(lr, rgb(picture(height, width)))

    return resize


def dim(lr, hr):
    write_exr(lr, {c: values / 8 for c, values in low_layers(0).items()})


#: What is wrong -> (how it comes about, how the frame ends, what is said).
SORTS = {
    "truncated HRLS": (lambda lr, hr: truncate(hr), "failed", "damaged or still being written"),
    "truncated LRHS": (lambda lr, hr: truncate(lr), "failed", "damaged or still being written"),
    "corrupt header": (corrupt_header, "failed", "can't be opened as an EXR"),
    "corrupt pixels": (corrupt_pixels, "failed", "damaged or still being written"),
    "zero bytes": (lambda lr, hr: hr.write_bytes(b""), "failed", "can't be opened as an EXR"),
    "text": (lambda lr, hr: lr.write_text("not an EXR " * 50), "failed", "can't be opened as an EXR"),
    "PNG named .exr": (png, "failed", "is a png file; give an EXR"),
    "deep": (deep, "failed", "holds deep data only"),
    "folder": (folder_instead, "failed", "is a folder"),
    "named pipe": (lambda lr, hr: (lr.unlink(), os.mkfifo(lr)), "failed", "is no ordinary file"),
    "broken link": (lambda lr, hr: (lr.unlink(), lr.symlink_to("nowhere")), "failed", "no such file"),
    "no beauty": (lambda lr, hr: write_exr(hr, {"Z": picture(8, 8)[..., 0]}), "failed", "no beauty"),
    "ids for a beauty": (
        lambda lr, hr: write_exr(hr, rgb(np.ones((HEIGHT, WIDTH, 3), np.uint32))),
        "failed",
        "no layer with R, G, B",
    ),
    "missing LRHS": (lambda lr, hr: lr.unlink(), "missing", "no LRHS"),
    "missing HRLS": (lambda lr, hr: hr.unlink(), "missing", "no HRLS"),
    "swapped": (swapped, "failed", "the inputs look swapped"),
    "one file twice": (same_file, "failed", "given twice"),
    "other pixel aspect": (
        lambda lr, hr: write_exr(hr, layers(0), pixelAspectRatio=2.0),
        "failed",
        "has pixel aspect 1",
    ),
    "unsupported ratio": (other_size(20, 30), "failed", "a ratio of 1.6 is not supported"),
    "other framing": (other_size(8, 16), "failed", "framing differs"),
    "other scale": (other_size(16, 24), "failed", "is for x4, but this pair is x2"),
    "black HRLS": (black, "failed", "the beauty is black"),
    "NaN everywhere": (all_nan, "failed", "the beauty is black"),
    "both black": (both_black, "fused", "both renders are black"),
    "some NaN": (not_finite(np.nan), "fused", "repaired values that were NaN"),
    "some Inf": (not_finite(np.inf), "fused", "repaired values that were NaN"),
    "no albedo": (
        lambda lr, hr: write_exr(hr, {k: v for k, v in layers(0).items() if "albedo" not in k}),
        "fused",
        "albedo is not found here and found in frame 1000",
    ),
    "other exposure": (dim, "fused", "times as bright as the LRHS"),
    "existing target": ("{out}.exr", "failed", "the output exists; pass --skip-existing or --overwrite"),
    "existing preview": ("{out}.png", "failed", "exists; pass --overwrite"),
    "folder for a target": ("{out}.exr/", "failed", "is a folder"),
}


def test_every_sort_of_bad_frame_is_named_and_the_others_are_fused(tmp_path, bilinear_models):
    """The bad ones stand between good ones, which come out as ever."""
    folder = make_shot(tmp_path, 2 * len(SORTS) + 1, first=1000)
    (folder / "out").mkdir()
    bad = dict(zip(SORTS, range(1001, 10000, 2), strict=False))
    for sort, number in bad.items():
        how = SORTS[sort][0]
        if callable(how):
            how(folder / f"lr/lr.{number}.exr", folder / f"hr/beauty.{number}.exr")
        elif how.endswith("/"):
            (folder / f"out/beauty.{number}.exr").mkdir()
        else:
            (folder / how.format(out=f"out/beauty.{number}")).write_text("mine")
    report_path = folder / "report.json"
    report = run(folder, bilinear_models[4], previews=True, report_path=report_path)

    results = {entry["frame"]: entry for entry in json.loads(report_path.read_text())["frames"]}
    assert len(results) == 2 * len(SORTS) + 1
    for sort, number in bad.items():
        _, status, words = SORTS[sort]
        entry = results[number]
        said = entry["message"] or " ".join(entry["warnings"])
        assert (sort, entry["status"], entry["exit_code"]) == (sort, status, 0 if status == "fused" else 2), said
        assert words in said, (sort, said)
        assert (folder / f"out/beauty.{number}.exr").is_file() == (status == "fused" or sort == "existing target")
    good = set(results) - set(bad.values())
    assert all(results[n]["status"] == "fused" and not results[n]["warnings"] for n in good)
    assert {path.name for path in (folder / "out").iterdir() if path.name.startswith(".")} == set()
    assert (folder / f"out/beauty.{bad['existing target']}.exr").read_text() == "mine"
    assert (folder / f"out/beauty.{bad['existing preview']}.png").read_text() == "mine"
    assert report.exit_code == 2


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_said_at_once(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 1)
    (folder / "out").mkdir(mode=0o555)
    with pytest.raises(InputError, match="is not writable"):
        run(folder, bilinear_models[4])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"device": "abacus"}, "'abacus': use one of cpu"),
        ({"temporal": TemporalOptions("auto", "layer=foo")}, "foo"),
        ({"report_path": "r.json", "skip_existing": True}, "of another shot"),
    ],
)
def test_a_wrong_option_leaves_no_folder(tmp_path, bilinear_models, monkeypatch, wrong, message):
    folder = make_shot(tmp_path, 2)
    monkeypatch.chdir(folder)
    other = make_shot(tmp_path / "other", 1)
    run(other, bilinear_models[4], report_path=folder / "r.json")
    with pytest.raises(InputError, match=message):
        run(folder, bilinear_models[4], **wrong)
    assert not (folder / "out").exists()


def test_a_fault_of_the_program_in_one_frame_does_not_stop_the_others(tmp_path, bilinear_models, monkeypatch):
    folder = make_shot(tmp_path, 3)
    real = run_module.fuse

    def faulty(lr, *arguments, **more):
        if "1002" in lr.name:
            raise ZeroDivisionError("oh")
        return real(lr, *arguments, **more)

    monkeypatch.setattr(run_module, "fuse", faulty)
    report = run(folder, bilinear_models[4])
    assert [result.status for result in report.results.values()] == ["fused", "failed", "fused"]
    assert report.results[1002].message.startswith("unexpected ZeroDivisionError: oh")
    assert report.exit_code == 1


def test_a_picture_that_is_no_preview_of_ours_is_left_alone(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 2)
    (folder / "out").mkdir()
    mine = folder / "out/beauty.1001.png"
    oiio.ImageBuf(oiio.ImageSpec(4, 4, 3, "uint8")).write(str(mine))
    before = mine.read_bytes()
    write_png(folder / "out/beauty.1002.png")  # of a run that was killed
    report = run(folder, bilinear_models[4], previews=True, skip_existing=True)
    assert [report.results[n].status for n in (1001, 1002)] == ["failed", "fused"]
    assert "beauty.1001.png: exists; pass --overwrite" in report.results[1001].message
    assert mine.read_bytes() == before
    assert oiio.ImageBuf(str(folder / "out/beauty.1002.png")).spec().width == WIDTH


def test_a_frame_that_stays_keeps_its_preview(tmp_path, bilinear_models, monkeypatch):
    """An old frame that can't be replaced, and one that another run puts there meanwhile."""
    folder = make_shot(tmp_path, 1)
    assert run(folder, bilinear_models[4], previews=True).exit_code == 0
    before, real = contents(folder / "out"), write.write_fused

    def full_disk(*arguments, **more):
        raise MssplError("disk full")

    def too_late(path, *arguments, **more):
        path.write_text("theirs")
        return real(path, *arguments, **more)

    write_exr(folder / "lr/lr.1001.exr", {c: values / 2 for c, values in low_layers(1).items()})
    monkeypatch.setattr(write, "write_fused", full_disk)
    assert run(folder, bilinear_models[4], previews=True, overwrite=True).results[1001].message == "disk full"
    assert contents(folder / "out") == before
    (folder / "out/beauty.1001.exr").unlink()
    assert run(folder, bilinear_models[4], previews=True, overwrite=True).results[1001].message == "disk full"
    assert (folder / "out/beauty.1001.png").exists()
    assert run(folder, bilinear_models[4], previews=True, skip_existing=True).results[1001].message == "disk full"
    assert contents(folder / "out") == {}
    monkeypatch.setattr(write, "write_fused", too_late)
    assert "appeared while" in run(folder, bilinear_models[4], previews=True).results[1001].message
    assert (folder / "out/beauty.1001.png").exists()


def test_what_is_done_is_skipped_and_its_report_kept(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 3)
    not_finite(np.nan)(None, folder / "hr/beauty.1001.exr")
    report_path = folder / "r.json"
    run(folder, bilinear_models[4], frames="1001-1002", report_path=report_path)
    before = contents(folder / "out")
    with pytest.raises(InputError, match=r"r\.json: exists; pass --skip-existing to go on with that run"):
        run(folder, bilinear_models[4], report_path=report_path)
    report = run(folder, bilinear_models[4], skip_existing=True, report_path=report_path)
    assert [result.status for result in report.results.values()] == ["skipped", "skipped", "fused"]
    assert before.items() <= contents(folder / "out").items()
    saved = json.loads(report_path.read_text())
    assert saved["frames"][0]["repaired"] == {"hrls.rgb": 2}
    assert saved["counts"] == {"all": 3, "fused": 1, "skipped": 2, "failed": 0, "missing": 0}
    assert saved["finished"] and saved["exit_code"] == 0
    report_path.write_text("[]")
    with pytest.raises(InputError, match="is no report of a shot"):
        run(folder, bilinear_models[4], skip_existing=True, report_path=report_path)


def test_a_resumed_report_keeps_the_frames_of_other_runs(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 4)
    (folder / "lr/lr.1003.exr").write_text("no EXR")
    report_path = folder / "r.json"
    assert run(folder, bilinear_models[4], frames="1001,1003", report_path=report_path).exit_code == 2
    before = json.loads(report_path.read_text())["frames"]
    more = {"skip_existing": True, "report_path": report_path}
    assert run(folder, bilinear_models[4], frames="1004", **more).exit_code == 0
    saved = json.loads(report_path.read_text())
    assert saved["frames"][:2] == before and [entry["frame"] for entry in saved["frames"]] == [1001, 1003, 1004]
    assert saved["counts"] == {"all": 3, "fused": 2, "skipped": 0, "failed": 1, "missing": 0}
    assert saved["finished"] and saved["exit_code"] == 0
    run(folder, bilinear_models[4], frames="1004", overwrite=True, report_path=report_path)
    assert [entry["frame"] for entry in json.loads(report_path.read_text())["frames"]] == [1004]


def test_a_frame_that_is_fused_anew_replaces_the_first_one_of_a_report(tmp_path, bilinear_models):
    """Others are not compared with a result that is gone."""
    folder = make_shot(tmp_path, 2)
    more = {"report_path": folder / "r.json"}
    run(folder, bilinear_models[4], **more)
    for number in (1001, 1002):
        path = folder / f"hr/beauty.{number}.exr"
        channels = read_bits(path)[0][1]
        write_exr(path, {name: plane for name, plane in channels.items() if not name.startswith("albedo")})
        os.utime(path, (2e9, 2e9))
    report = run(folder, bilinear_models[4], update=True, **more)
    assert [result.status for result in report.results.values()] == ["fused", "fused"]
    assert not any("may flicker" in text for result in report.results.values() for text in result.warnings)
    first = json.loads((folder / "r.json").read_text())["first_fused"]
    assert {row["feature"]: row["status"] for row in first["aovs"]}["albedo"] != "found"


def test_another_model_or_scale_than_that_of_the_first_frame_is_a_warning(tmp_path, bilinear_models):
    """Of this run, and of the earlier one that it resumes."""
    folder = make_shot(tmp_path, 3)
    write_exr(folder / "lr/lr.1003.exr", rgb(downsample(picture(HEIGHT, WIDTH), 2)))
    more = {"skip_existing": True, "report_path": folder / "r.json"}
    assert run(folder, bilinear_models[4], frames="1001", **more).results[1001].warnings == []
    report = run(folder, "fast", frames="1002-1003", **more)
    (same_scale,), (other_scale,) = (report.results[number].warnings for number in (1002, 1003))
    assert same_scale == "the model is joint-small-x4 here and bilinear-x4 in frame 1001: it may flicker"
    assert other_scale == "the scale is x2 here and x4 in frame 1001: it may flicker"


def test_a_shot_is_not_resumed_with_other_weights(tmp_path, bilinear_models, monkeypatch):
    """Frames without a digest, and files that are no EXR, do not stop it."""
    folder = make_shot(tmp_path, 4)
    run(folder, bilinear_models[4], frames="1001")
    (folder / "out/beauty.1002.exr").write_text("no EXR")
    write_exr(folder / "out/beauty.1003.exr", rgb(picture(HEIGHT, WIDTH)))
    before = contents(folder / "out")
    with pytest.raises(InputError, match=r"beauty.1001.exr: was fused by other weights \(bilinear-x4 \w{12}\) than"):
        run(folder, "fast", skip_existing=True)
    with monkeypatch.context() as patch, pytest.raises(InputError, match=r"would be \(bilinear-x4 0{12}\)"):
        patch.setattr(existing, "digests", lambda models, device: {path.stem: "0" * 12 for path in models})
        run(folder, bilinear_models[4], skip_existing=True)
    assert contents(folder / "out") == before
    assert run(folder, bilinear_models[4], skip_existing=True).results[1004].status == "fused"
    assert run(folder, "fast", overwrite=True).exit_code == 0


def test_other_weights_and_another_version_than_those_of_the_first_frame_are_warnings(tmp_path, bilinear_models):
    """A model of the same name has been retrained between two runs."""
    folder = make_shot(tmp_path, 2)
    more = {"skip_existing": True, "report_path": folder / "r.json"}
    run(folder, bilinear_models[4], frames="1001", **more)
    report = json.loads((folder / "r.json").read_text())
    (name,) = report["first_fused"]["weights"]
    report["first_fused"] |= {"weights": {name: "0" * 12}, "version": "0.9"}
    (folder / "r.json").write_text(json.dumps(report))
    weights, version = run(folder, bilinear_models[4], frames="1002", **more).results[1002].warnings
    assert re.fullmatch(
        rf"the digest of its weights is {name} \w{{12}} here and {name} 0{{12}} in frame 1001: .*", weights
    )
    assert version == f"the version is {full_version()} here and 0.9 in frame 1001: it may flicker"


def test_another_number_of_neighbours_than_that_of_the_first_frame_is_a_warning(tmp_path, bilinear_models):
    """The earlier run was fused frame by frame. This one knows that nothing moves."""
    folder = make_shot(tmp_path, 3)
    more = {"skip_existing": True, "report_path": folder / "r.json"}
    run(folder, bilinear_models[4], frames="1001", temporal=TemporalOptions("off"), **more)
    report = run(folder, bilinear_models[4], temporal=TemporalOptions(2), **more)
    for number in (1002, 1003):
        assert "--temporal is 2 here and off in frame 1001: it may flicker" in report.results[number].warnings


def layers_with_passes(seed):
    """Channels of an HRLS with two light groups that sum to the beauty."""
    light = (noisy(picture(HEIGHT, WIDTH), 1, seed) * 32).round() / 32
    key = (light * 12).round() / 32
    named = {"": light, "light_key.": key, "light_fill.": light - key, "albedo.": picture(HEIGHT, WIDTH)}
    return {name: plane for prefix, each in named.items() for name, plane in rgb(each, prefix).items()} | {
        "Z": light[..., 0]
    }


def make_shot_with_passes(folder, count):
    """Pairs whose HRLS has light groups."""
    make_shot(folder, count)
    for number in range(1001, 1001 + count):
        write_exr(folder / f"hr/beauty.{number}.exr", layers_with_passes(number))
    return folder


@pytest.mark.parametrize(
    ("change", "warnings"),
    [
        (
            lambda channels: channels | {name: 3 * channels[name] for name in channels if "light_key" in name},
            [r"light groups: passed on here \(does not sum to the beauty: .* more light.*\) and fused in frame 1001: "],
        ),
        (
            lambda channels: {name: plane for name, plane in channels.items() if "light_" not in name},
            [
                "the layers light_fill, light_key are missing here and present in frame 1001: ",
                "light groups: missing here and fused in frame 1001: ",
            ],
        ),
        (
            lambda channels: {name: plane for name, plane in channels.items() if name != "Z"},
            ["the layer Z is missing here and present in frame 1001: "],
        ),
        (
            lambda channels: {name: plane for name, plane in channels.items() if "albedo" not in name},
            ["albedo is not found here and found in frame 1001: "],
        ),
        (
            lambda channels: channels | rgb(channels["Z"][..., None].repeat(3, -1), "glow."),
            ["the layer glow is present here and missing in frame 1001: "],
        ),
        (
            lambda channels: channels | {name: plane * np.nan for name, plane in channels.items() if "key" in name},
            [r"light groups: passed on here \(.*: the layer light_key is NaN or infinite\) and fused in frame 1001: "],
        ),
    ],
)
def test_layers_and_passes_that_differ_from_the_first_frame_are_a_warning(tmp_path, bilinear_models, change, warnings):
    folder = make_shot_with_passes(tmp_path, 3)
    write_exr(folder / "hr/beauty.1002.exr", change(layers_with_passes(1002)))
    report = run(folder, bilinear_models[4])
    assert report.first["passes"]["light groups"].startswith("fused")
    assert report.results[1003].warnings == []
    found = [text for text in report.results[1002].warnings if not text.startswith("no albedo was found")]
    assert len(found) == len(warnings), found
    for text, expected in zip(found, warnings, strict=True):
        assert re.fullmatch(expected + "it may flicker", text)


def test_layers_that_are_not_written_can_not_flicker(tmp_path, bilinear_models):
    folder = make_shot_with_passes(tmp_path, 2)
    write_exr(folder / "hr/beauty.1002.exr", {n: x for n, x in layers_with_passes(1002).items() if n != "Z"})
    report = run(folder, bilinear_models[4], write=WriteOptions(layers=("light*",)))
    assert report.results[1002].warnings == []


def test_a_view_that_the_first_frame_lacks_is_a_warning(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 2)
    for number, labels in ((1001, "AB"), (1002, "A")):
        for name, make in (("lr/lr", low_layers), ("hr/beauty", layers)):
            pixels = {n: x for n, x in make(number).items() if n in "RGB"}
            channels = {f"{label}.Combined.{n}": x for label in labels for n, x in pixels.items()}
            write_exr(folder / f"{name}.{number}.exr", channels)
    report = run(folder, bilinear_models[4])
    assert [each["view"] for each in report.first["fused_views"]] == ["A", "B"]
    assert "B is not fused here and fused in frame 1001: it may flicker" in report.results[1002].warnings


# ------------------------------------------------------------------------------------------------ runs that are ended


def test_a_frame_that_is_handed_over_as_the_signal_comes_is_reported(tmp_path, bilinear_models, monkeypatch):
    folder = make_shot(tmp_path, 5)
    submit, handed_over = ThreadPoolExecutor.submit, []

    def interrupted(self, work, *arguments):
        future = submit(self, work, *arguments)
        if self._thread_name_prefix == "write":
            handed_over.append(work)
            if len(handed_over) == 3:
                raise KeyboardInterrupt
        return future

    monkeypatch.setattr(ThreadPoolExecutor, "submit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(folder, bilinear_models[4], report_path=folder / "r.json", previews=False)
    report = json.loads((folder / "r.json").read_text())
    files = sorted(path.name for path in (folder / "out").iterdir())
    assert files == [f"beauty.{entry['frame']}.exr" for entry in report["frames"]]
    assert len(files) == 3


def test_temporary_files_of_two_machines_have_two_names(tmp_path, monkeypatch):
    """Where both have a process of one number."""
    monkeypatch.setattr(os, "getpid", lambda: 7)
    target = tmp_path / "a.1001.exr"
    with replacing(target, overwrite=True) as one, replacing(target, overwrite=True) as other:
        for path in (one, other):
            path.touch()
        assert len(list(tmp_path.iterdir())) == 2


# ------------------------------------------------------------------------------------------------ inputs stay


@pytest.mark.parametrize(
    ("report", "message"),
    [
        ("lr/lr.1002.exr", "is one of the inputs"),
        ("hr/beauty.1001.exr", "is one of the inputs"),
        ("albedo.exr", "is one of the inputs"),
        ("out/beauty.1002.exr", "is the same file as"),
        ("out/beauty.1002.png", "is the same file as"),
        ("link.json", "is one of the inputs"),
        ("somebody.txt", "is no report of a shot"),
        ("pipe", "is no ordinary file"),
    ],
)
@pytest.mark.parametrize("existing", [True, False])
def test_a_report_replaces_nothing_but_a_report(tmp_path, bilinear_models, report, message, existing):
    folder = make_shot(tmp_path, 2)
    write_exr(folder / "albedo.exr", rgb(picture(HEIGHT, WIDTH)))
    (folder / "link.json").symlink_to("hr/beauty.1001.exr")
    (folder / "somebody.txt").write_text("mine")
    os.mkfifo(folder / "pipe")  # as /dev/zero, it would be read for ever
    if existing:
        assert run(folder, bilinear_models[4], previews=True).exit_code == 0
    before = everything(folder)
    inputs = InputOptions({"albedo": f"file:{folder / 'albedo.exr'}"})
    with pytest.raises(InputError, match=message):
        run(folder, bilinear_models[4], inputs=inputs, previews=True, overwrite=True, report_path=folder / report)
    assert everything(folder) == before


def test_the_report_of_another_shot_is_not_continued(tmp_path, bilinear_models, monkeypatch):
    folder, other = make_shot(tmp_path / "a", 2), make_shot(tmp_path / "b", 1)
    report_path = tmp_path / "r.json"
    monkeypatch.chdir(folder)
    pair = "lr", "hr", "out"
    more = {"model": str(bilinear_models[4]), "report_path": report_path, "skip_existing": True}
    fuse_shot(*pair, frames="1001", **more)
    before = report_path.read_bytes()
    monkeypatch.chdir(other)  # the same names as seen from there
    with pytest.raises(InputError, match=r"r\.json: is the report of another shot, whose frames are .*/a/out/beauty"):
        fuse_shot(*pair, **more)
    assert report_path.read_bytes() == before
    fuse_shot(folder / "lr", folder / "hr", folder / "out", **more)
    assert [entry["status"] for entry in json.loads(report_path.read_text())["frames"]] == ["skipped", "fused"]


@pytest.mark.parametrize("target", ["hr/beauty.1002.exr", "lr/lr.1003.exr"])
def test_a_result_that_is_a_link_to_the_render_of_another_frame_is_refused(tmp_path, bilinear_models, target):
    """Though that frame is not to be fused: its neighbours read it, and so will the run that fuses it."""
    folder = make_shot(tmp_path, 3)
    (folder / "out").mkdir()
    (folder / "out/beauty.1001.exr").symlink_to(folder / target)
    before = everything(folder)
    with pytest.raises(InputError, match=r"beauty\.1001\.exr: is one of the inputs"):
        run(folder, bilinear_models[4], overwrite=True, frames="1001")
    assert everything(folder) == before


def test_a_preview_of_one_frame_that_is_a_link_to_another_s_input_is_refused(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 2)
    (folder / "out").mkdir()
    (folder / "out/beauty.1001.png").symlink_to(folder / "hr/beauty.1002.exr")
    before = everything(folder)
    with pytest.raises(InputError, match=r"beauty\.1001\.png: is one of the inputs"):
        run(folder, bilinear_models[4], previews=True, overwrite=True)
    assert everything(folder) == before


def test_a_sibling_file_that_a_frame_reads_is_not_written(tmp_path, bilinear_models):
    """It is known only when the frame is opened. The frame fails and the file stays."""
    folder = tmp_path
    for name in ("lr", "hr", "out"):
        (folder / name).mkdir()
    write_exr(folder / "lr/RGB_IMAGEPIPELINE_1.exr", low_layers(1))
    write_exr(folder / "hr/RGB_IMAGEPIPELINE_1.exr", rgb(picture(HEIGHT, WIDTH)))
    write_exr(folder / "hr/ALBEDO.exr", rgb(picture(HEIGHT, WIDTH)))
    (folder / "out/RGB_IMAGEPIPELINE_1.exr").symlink_to(folder / "hr/ALBEDO.exr")
    before = everything(folder)
    report = run(folder, bilinear_models[4], overwrite=True)
    assert "is one of the inputs" in report.results[1].message
    assert everything(folder) == before


def everything(folder):
    """{path: bytes} of all files below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ------------------------------------------------------------------------------------------------ what exists already


def test_frames_of_two_runs_at_the_same_time_are_skipped(tmp_path, bilinear_models, monkeypatch):
    """The other run has written a frame before this one fuses it, or while it was fused."""
    folder, real = make_shot(tmp_path, 3), run_module.fuse
    assert run(folder, bilinear_models[4], previews=True).exit_code == 0
    other = folder / "other"
    (folder / "out").rename(other)
    expected = contents(other)
    (folder / "out").mkdir()

    def meanwhile(lr, *arguments, **more):
        if "1001" in lr.name:
            for name in ("beauty.1001", "beauty.1002"):
                for suffix in (".png", ".exr"):
                    os.link(other / (name + suffix), folder / "out" / (name + suffix))
        assert "1002" not in lr.name
        return real(lr, *arguments, **more)

    monkeypatch.setattr(run_module, "fuse", meanwhile)
    report = run(folder, bilinear_models[4], previews=True, skip_existing=True)
    assert [result.status for result in report.results.values()] == ["skipped", "skipped", "fused"]
    assert contents(folder / "out") == expected
    assert report.exit_code == 0


def test_frames_that_are_older_than_an_input_are_named_and_with_update_fused_again(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 4)
    albedo = write_exr(folder / "albedo.exr", rgb(picture(HEIGHT, WIDTH)))
    more = {"inputs": InputOptions({"albedo": f"file:{albedo}"}), "previews": True}
    assert run(folder, bilinear_models[4], **more).exit_code == 0
    outputs = {n: folder / f"out/beauty.{n}.exr" for n in range(1001, 1005)}
    written = outputs[1001].stat().st_mtime_ns
    os.utime(folder / "lr/lr.1001.exr", ns=(written, written))  # of the same moment, so not newer
    now = outputs[1004].stat().st_mtime
    os.utime(folder / "lr/lr.1002.exr", (now + 9, now + 9))
    os.utime(folder / "hr/beauty.1003.exr", (now + 9, now + 9))
    outputs[1004].unlink()
    kept = {n: path.stat().st_ino for n, path in outputs.items() if path.exists()}

    report = run(folder, bilinear_models[4], frames="1001-1003", skip_existing=True, **more)
    assert [result.status for result in report.results.values()] == ["skipped"] * 3
    assert [len(result.warnings) for result in report.results.values()] == [0, 1, 1]
    assert "is older than" in report.results[1002].warnings[0] and "lr.1002.exr" in report.results[1002].warnings[0]

    report = run(folder, bilinear_models[4], update=True, **more)
    assert [report.results[n].status for n in outputs] == ["skipped", "fused", "fused", "fused"]
    changed = [n for n, path in outputs.items() if path.stat().st_ino != kept.get(n)]
    assert changed == [1002, 1003, 1004]
    os.utime(albedo, (now + 99, now + 99))
    assert {r.status for r in run(folder, bilinear_models[4], update=True, **more).results.values()} == {"fused"}


@pytest.mark.parametrize("newer", ["lr/lr.1001.ALBEDO.exr", "hr/beauty.1001.AVG_SHADING_NORMAL.exr", "hr/ALBEDO.exr"])
def test_files_of_layers_beside_a_render_are_inputs(tmp_path, bilinear_models, newer):
    """LuxCore writes one file a layer. A file of another frame, or one that is not read, does not count."""
    folder = make_shot(tmp_path, 2)
    clean = picture(HEIGHT, WIDTH)
    write_exr(folder / "lr/lr.1001.ALBEDO.exr", rgb(downsample(clean, 4)))
    for name in ("beauty.1001.AVG_SHADING_NORMAL", "ALBEDO"):
        write_exr(folder / f"hr/{name}.exr", rgb(clean))
    (folder / "hr/beauty.1001.DEPTH.exr").touch()
    sequences = folder / "lr/lr.####.exr", folder / "hr/beauty.####.exr", folder / "out"
    fuse = partial(fuse_shot, *sequences, model=str(bilinear_models[4]), temporal=TemporalOptions("off"))
    assert fuse().exit_code == 0
    later = (folder / "out/beauty.1002.exr").stat().st_mtime + 9
    os.utime(folder / "hr/beauty.1001.DEPTH.exr", (later, later))
    report = fuse(skip_existing=True)
    assert [result.warnings for result in report.results.values()] == [[], []]
    os.utime(folder / newer, (later, later))
    report = fuse(skip_existing=True)
    (warning,) = report.results[1001].warnings
    assert warning.startswith(f"is older than {folder / newer}")
    report = fuse(update=True)
    assert [report.results[number].status for number in (1001, 1002)] == ["fused", "skipped"]


def test_a_warning_that_a_frame_is_older_is_not_taken_from_an_earlier_report(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 1)
    not_finite(np.nan)(None, folder / "hr/beauty.1001.exr")
    more = {"report_path": folder / "r.json", "skip_existing": True}
    (repaired,) = run(folder, bilinear_models[4], **more).results[1001].warnings
    written, render = (folder / f"{name}/beauty.1001.exr" for name in ("out", "hr"))
    later = written.stat().st_mtime + 9
    os.utime(render, (later, later))
    for _ in range(2):
        found = run(folder, bilinear_models[4], **more).results[1001].warnings
        assert found == [repaired, f"is older than {render}; --update fuses such frames again"]
    os.utime(written, (later + 9, later + 9))
    assert run(folder, bilinear_models[4], **more).results[1001].warnings == [repaired]


def test_a_folder_with_the_name_of_a_frame_does_not_count_as_done(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 1)
    (folder / "out/beauty.1001.exr").mkdir(parents=True)
    result = run(folder, bilinear_models[4], skip_existing=True).results[1001]
    assert result.status == "failed" and "is a folder" in result.message


def test_a_report_of_another_version_does_not_stop_a_resumed_shot(tmp_path):
    path, report = tmp_path / "report.json", SimpleNamespace(first=None, shot=SimpleNamespace(frames=[]))
    path.write_text(json.dumps({"frames": [], "first_fused": {"frame": 1001, "aovs": []}}))
    assert read_earlier(report, path, overwrite=False, skip_existing=True) == {} and report.first is None
    path.write_text(json.dumps({"frames": [], "first_fused": "1001"}))
    with pytest.raises(InputError, match="is no report of a shot"):
        read_earlier(report, path, overwrite=False, skip_existing=True)


def test_results_do_not_lie_among_the_low_resolution_renders(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 1)
    with pytest.raises(InputError, match="lr: holds renders that this run reads; name another folder"):
        fuse_shot(folder / "lr", folder / "hr", folder / "lr", model=str(bilinear_models[4]))
    report = fuse_shot(folder / "lr", folder / "hr", folder / "lr" / "out.####.exr", model=str(bilinear_models[4]))
    assert report.exit_code == 0


def test_what_will_be_done_is_told_before_the_first_frame(tmp_path, bilinear_models):
    """A frame that can't be read is passed over. A missing albedo is a warning of each frame."""
    folder = make_shot(tmp_path, 2)
    for frame in (1001, 1002):
        beauty = rgb(picture(HEIGHT, WIDTH))
        write_exr(
            folder / "hr" / f"beauty.{frame}.exr", beauty | {f"light_{i}.{c}": beauty[c] for i in "ab" for c in "RGB"}
        )
    (folder / "lr/lr.1001.exr").write_text("no EXR")
    told = []

    def begin(report):
        told.append((dict(report.found), report.temporal, list((folder / "out").iterdir())))

    report = run(folder, bilinear_models[4], begin=begin, temporal=TemporalOptions("auto"))
    assert str(report) == f"<{folder}/out/beauty.####.exr: 1 failed, 1 fused>"
    ((found, temporal, written),) = told
    assert written == [] and temporal == report.temporal and temporal.startswith("frame by frame: ")
    assert (found["frame"], found["renderer"], found["scale"]) == (1002, "unknown", 4)
    assert found["sets"] == {"light groups": "light_a, light_b"}
    assert {row["feature"]: row["status"] for row in found["aovs"]}["albedo"] == "default"
    assert "no albedo was found, so textures blur" in report.results[1002].warnings[0]
    run(folder, bilinear_models[4], begin=begin, frames="1002", skip_existing=True)
    assert len(told) == 1
