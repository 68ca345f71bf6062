# SPDX-License-Identifier: Apache-2.0
"""Shots: which files are frames of one, what becomes of good and bad ones, and of runs that are ended."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from oiio_msspl.exr import preview
from oiio_msspl.jobs import shot
from oiio_msspl import InputError, MssplError, fuse_files, fuse_shot
from oiio_msspl.exr.preview import write_png
from oiio_msspl.jobs.shot import Stages, _fused_result, fuse, write_frame
from oiio_msspl.model.session import Session
from oiio_msspl.exr.atomic import remove_leftovers, replacing
from oiio_msspl.jobs.sequence import find_shot, format_frames
from tests.conftest import downsample, noisy, picture, read_bits, rgb, write_exr
from tests.test_cli import fuse

HEIGHT, WIDTH = 32, 48


def touch(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


def layers(seed, spp=1):
    """Channels of an HRLS."""
    clean = picture(HEIGHT, WIDTH)
    albedo = rgb((clean > 0.3).astype(np.float16), "albedo.")
    return rgb(noisy(clean, spp, seed).astype(np.float16)) | albedo | {"Z": clean[..., 0]}


def low_layers(seed, scale=4):
    return rgb(noisy(downsample(picture(HEIGHT, WIDTH), scale), 16, seed).astype(np.float16))


@pytest.fixture
def make(tmp_path):
    """Make a shot of pairs at x4: lr/lr.####.exr and hr/beauty.####.exr."""

    def make(count, first=1001):
        for name in ("lr", "hr"):
            (tmp_path / name).mkdir()
        for frame in range(first, first + count):
            write_exr(tmp_path / f"lr/lr.{frame}.exr", low_layers(frame))
            write_exr(tmp_path / f"hr/beauty.{frame}.exr", layers(frame))
        return tmp_path

    return make


def run(folder, model, **more):
    return fuse_shot(folder / "lr", folder / "hr", folder / "out", model=str(model), **more)


def contents(folder):
    """{name: bytes}, without the date that OpenImageIO gives a file whose source has none."""
    return {path.name: re.sub(rb"\d{4}(:\d\d){2} \d\d(:\d\d){2}", b"", path.read_bytes()) for path in folder.iterdir()}


# ------------------------------------------------------------------------------------------------ which files


@pytest.mark.parametrize("pattern", ["a.####.exr", "a.%04d.exr", "a.@@@@.exr", "a.$F4.exr"])
def test_every_way_to_write_a_pattern_means_the_same_files(tmp_path, pattern):
    """Four digits: 7 is 0007 and not 7, 10000 has five, -3 is -003; other names are others' files."""
    names = ["a.0007.exr", "a.10000.exr", "a.-003.exr", "a.7.exr", "b.0007.exr", "a.0007.crypto.exr", "a.x.exr"]
    folder = touch(tmp_path / "lr#1", *names)
    found = find_shot(folder / pattern, folder / pattern, tmp_path / pattern)
    assert [frame.number for frame in found.frames] == [-3, 7, 10000]
    assert [frame.lr.name for frame in found.frames] == ["a.-003.exr", "a.0007.exr", "a.10000.exr"]
    assert found.frames[1].output == tmp_path / "a.0007.exr"


def test_folders_pair_by_number_whatever_names_and_padding(tmp_path):
    """Blender's 0001.exr against name-1.exr; hidden files, pictures and unnumbered EXRs are no frames."""
    touch(tmp_path / "lr", "0001.exr", "0002.exr", ".0003.exr", "0004.png", "single.exr")
    touch(tmp_path / "hr", "shot-1.exr", "shot-2.exr", "shot-10.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert [(f.number, f.lr and f.lr.name, f.hr and f.hr.name, f.output.name) for f in found.frames] == [
        (1, "0001.exr", "shot-1.exr", "shot-1.exr"),
        (2, "0002.exr", "shot-2.exr", "shot-2.exr"),
        (10, None, "shot-10.exr", "shot-10.exr"),
    ]


def test_of_several_sequences_those_of_one_name_are_paired(tmp_path):
    touch(tmp_path / "lr", "beauty_0001.exr", "beauty_0002.exr", "ao.1.exr")
    touch(tmp_path / "hr", "beauty.0001.exr", "beauty.0002.exr", "crypto.0001.exr", "beauty.0001.id.exr")
    found = find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")
    assert (found.lr.pattern.name, found.hr.pattern.name) == ("beauty_####.exr", "beauty.####.exr")


def test_results_are_named_exr_whatever_the_hrls_is_named(tmp_path):
    touch(tmp_path, "hr.exr.0001", "hr.exr.0002")
    found = find_shot(tmp_path / "hr.exr.####", tmp_path / "hr.exr.####", tmp_path / "out")
    assert [frame.output.name for frame in found.frames] == ["hr.exr.0001.exr", "hr.exr.0002.exr"]


@pytest.mark.parametrize(
    ("lr", "hr", "message"),
    [
        (["a.1.exr", "b.1.exr"], ["a.1.exr", "b.1.exr"], "2 sequences go by the same name in both; name the two"),
        (["lr.1.exr"], ["a.1.exr", "b.1.exr"], "hr has a.#.exr, b.#.exr, and none has the same name in both"),
        (["lr.1.exr", "lr.0001.exr"], ["a.1.exr"], "with and without zeros"),
        (["lr.exr"], ["a.1.exr"], "lr: no numbered EXRs"),
    ],
)
def test_folders_that_leave_a_doubt_are_explained(tmp_path, lr, hr, message):
    touch(tmp_path / "lr", *lr), touch(tmp_path / "hr", *hr)
    with pytest.raises(InputError, match=message):
        find_shot(tmp_path / "lr", tmp_path / "hr", tmp_path / "out")


@pytest.mark.parametrize(
    ("frames", "numbers"),
    [
        ("1001-1007x3", [1001, 1004, 1007]),
        ("1004, 1001-1002", [1004, 1001, 1002]),
        ("-2-1", [-2, -1, 0, 1]),
        ([1003, 1001, 1003], [1003, 1001]),
        (range(5, 7), [5, 6]),
    ],
)
def test_ranges_are_taken_in_their_order(tmp_path, frames, numbers):
    folder = touch(tmp_path / "a", "a.1001.exr")
    found = find_shot(folder, folder, tmp_path / "out", frames)
    assert [frame.number for frame in found.frames] == numbers
    assert sum(frame.lr is not None for frame in found.frames) == numbers.count(1001)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lr/#.##.exr", "hr", "-o", "out"], "has its frame number in one place"),
        (["lr/x.####.exr", "hr", "-o", "out"], "no file has such a name; the folder has .*lr.####.exr"),
        (["no/x.####.exr", "hr", "-o", "out"], "there is no folder"),
        (["lr/lr.1001.exr", "hr", "-o", "out"], "is a single file, the other one is a folder"),
        (["lr", "hr", "-o", "out.exr"], r"one name for many frames; write out.####.exr"),
        (["lr", "hr", "-o", "out.####.png"], "the results are EXRs"),
        (["lr", "hr", "-o", "no/such/folder"], "does not exist; create it first"),
        (["lr", "hr", "-o", "hr", "--skip-existing"], "is one of the inputs"),
        (["lr", "hr", "-o", "out", "--frames", "a-b"], "--frames 'a-b': write it as 1001-1100"),
        (["lr", "hr", "-o", "out", "--frames", "1-2x0.5"], "whole frames only"),
        (["lr", "hr", "-o", "out", "--frames", ""], "names no frame"),
        (["lr", "hr", "-o", "out", "--overwrite", "--skip-existing"], "exclude each other"),
        (["lr", "hr", "-o", "out", "--progress", "x"], "use one of openjd, json"),
        (["lr", "hr", "-o", "out", "--progress", "json", "--json"], "both print to standard output"),
        (["lr", "hr", "-o", "out", "--report", "no/r.json"], "does not exist; create it first"),
        (["lr", "hr", "-o", "out", "--model", "x"], "no model 'x'"),
        (["lr", "hr", "-o", "out", "--view", "x"], "--view 'x'"),
        (["lr", "hr", "-o", "out", "--model", "paper", "--error-layer"], "paper-x4 does not predict its error"),
        (["lr/lr.1001.exr", "hr/beauty.1001.exr", "-o", "o.exr", "--skip-existing"], "--skip-existing is for shots"),
    ],
)
def test_what_is_wrong_for_the_whole_shot_is_said_at_once(make, monkeypatch, arguments, message):
    monkeypatch.chdir(make(1))
    done = fuse(*arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and done.stdout == ""
    assert re.search(message, done.stderr), done.stderr


# ------------------------------------------------------------------------------------------------ good frames


def test_a_shot_is_what_its_frames_are_alone(make, bilinear_models):
    """Read ahead and written behind, each frame is bit for bit what fuse_files makes of it; so is its preview."""
    folder = make(3)
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


def test_frames_without_room_in_memory_are_read_as_they_are_fused(make, bilinear_models, monkeypatch):
    folder = make(2)
    assert run(folder, bilinear_models[4]).exit_code == 0
    whole = contents(folder / "out")
    monkeypatch.setattr(shot, "_pixel_bytes", lambda render: 1 << 40)
    monkeypatch.setattr("oiio_msspl.aovs.mapped_render.MappedRender.load", pytest.fail)
    assert run(folder, bilinear_models[4], overwrite=True).exit_code == 0
    assert contents(folder / "out") == whole


def test_the_three_stages_overlap_and_hold_one_frame_each(make, bilinear_models, monkeypatch):
    """Each frame waits in its stage until the neighbours are in theirs: a pipeline that did not overlap would hang."""
    inside = {"read": 0, "fuse": 0, "write": 0}
    most = dict(inside)
    began = {(stage, n): threading.Event() for stage in inside for n in range(1, 7)}

    def watched(stage, number_of, meanwhile):
        real = getattr(Stages, stage)

        def call(self, *arguments):
            number = number_of(arguments[0])
            inside[stage] += 1
            most[stage] = max(most[stage], inside[stage])
            began[stage, number].set()
            for other, offset in meanwhile:
                if (other, number + offset) in began:
                    assert began[other, number + offset].wait(20), f"{other} of {number + offset} does not overlap"
            result = real(self, *arguments)
            inside[stage] -= 1
            return result

        monkeypatch.setattr(Stages, stage, call)

    watched("read", lambda frame: frame.number, [])
    watched("fuse", lambda ready: ready.frame.number, [("read", 1), ("write", -1)])
    watched("write", lambda report: int(report.output.stem.split(".")[1]), [("fuse", 1)])
    folder = make(6, first=1)
    assert run(folder, bilinear_models[4]).exit_code == 0
    assert most == {"read": 1, "fuse": 1, "write": 1}


def test_a_long_shot_loads_the_model_once_and_keeps_no_file_open(make, bilinear_models, monkeypatch):
    loaded, handles = [], []
    real = Session.__init__
    monkeypatch.setattr(Session, "__init__", lambda self, *a, **k: (loaded.append(a), real(self, *a, **k))[1])
    folder = make(12)
    report = run(folder, bilinear_models[4], progress=lambda *_: handles.append(len(os.listdir("/proc/self/fd"))))
    assert report.exit_code == 0
    assert len(loaded) == 1
    assert max(handles[3:]) <= handles[2] + 2


def test_progress_for_programs(make, bilinear_models):
    folder = make(3)
    (folder / "lr/lr.1002.exr").unlink()
    arguments = [folder / "lr", folder / "hr", "-o", folder / "out", "--model", bilinear_models[4], "--no-preview"]
    lines = [json.loads(line) for line in fuse(*arguments, "--progress", "json").stdout.splitlines()]
    assert [(line["frame"], line["status"], line["done"], line["count"]) for line in lines] == [
        (1002, "missing", 1, 3),
        (1001, "fused", 2, 3),
        (1003, "fused", 3, 3),
    ]
    done = fuse(*arguments, "--progress", "openjd", "--skip-existing", "-q")
    assert done.stdout.splitlines() == [
        "openjd_progress: 33.3",
        "openjd_status: frame 1001 skipped, 1 of 3 done",
        "openjd_progress: 66.7",
        "openjd_status: frame 1002 missing, 2 of 3 done",
        f"openjd_fail: frame 1002: no LRHS ({folder}/lr/lr.####.exr) of this number",
        "openjd_progress: 100.0",
        "openjd_status: frame 1003 skipped, 3 of 3 done",
    ]
    assert done.returncode == 2


def test_what_a_person_reads(make, bilinear_models):
    folder = make(4)
    (folder / "hr/beauty.1003.exr").write_text("no EXR")
    done = fuse(folder / "lr", folder / "hr", "-o", folder / "out", "--model", bilinear_models[4], "-v", "--no-preview")
    assert done.returncode == 2
    assert "  albedo    found    albedo\n" in done.stdout
    assert "  fused   3  1001-1002,1004\n  failed  1  1003 " in done.stdout
    assert done.stderr.count("error: frame 1003:") == 1
    assert "frame 1004: fused (read " in done.stderr


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
    "named pipe": (lambda lr, hr: (lr.unlink(), os.mkfifo(lr)), "failed", "no such file"),
    "broken link": (lambda lr, hr: (lr.unlink(), lr.symlink_to("nowhere")), "failed", "no such file"),
    "no beauty": (lambda lr, hr: write_exr(hr, {"Z": picture(8, 8)[..., 0]}), "failed", "no beauty"),
    "ids for a beauty": (
        lambda lr, hr: write_exr(hr, rgb(np.ones((HEIGHT, WIDTH, 3), np.uint32))),
        "failed",
        "hold integers",
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
    "unsupported ratio": (other_size(HEIGHT, WIDTH), "failed", "a ratio of 1 is not supported"),
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
        "albedo is default here and found in frame 1000",
    ),
    "other exposure": (dim, "fused", "times as bright as the LRHS"),
    "existing target": ("{out}.exr", "failed", "the output exists; pass --skip-existing or --overwrite"),
    "existing preview": ("{out}.png", "failed", "exists; pass --overwrite"),
    "folder for a target": ("{out}.exr/", "failed", "is a folder"),
}


def test_every_sort_of_bad_frame_is_named_and_the_others_are_fused(make, bilinear_models):
    """The bad ones stand between good ones, which come out as ever."""
    folder = make(2 * len(SORTS) + 1, first=1000)
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


def test_a_full_disk_and_an_unwritable_target_are_failures_of_ours(make, bilinear_models):
    """Exit code 1; neither a half frame nor a preview without its frame stays."""
    folder = make(4)
    noise = np.random.default_rng(0).integers(0, 2**31, (HEIGHT, WIDTH), dtype=np.uint32)
    write_exr(folder / "hr/beauty.1002.exr", layers(0) | {f"id{i}.X": noise + i for i in range(40)})
    (folder / "out").mkdir()
    (folder / "out/beauty.1003.exr").symlink_to(folder / "gone" / "x.exr")

    code = "import sys; from msspl_cli.app import msspl_fuse as main; main()"
    arguments = [folder / "lr", folder / "hr", "-o", folder / "out", "--model", bilinear_models[4], "--overwrite"]
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
    )
    assert done.returncode == 1
    assert "error: frame 1002: " in done.stderr and "error: frame 1003: " in done.stderr
    assert done.stderr.count("can't be written") == 2, done.stderr
    names = {path.name for path in (folder / "out").iterdir() if path.is_file()}
    assert names == {f"beauty.{n}.{e}" for n in (1001, 1004) for e in ("exr", "png")}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_said_at_once(make, bilinear_models):
    folder = make(1)
    (folder / "out").mkdir(mode=0o555)
    with pytest.raises(InputError, match="is not writable"):
        run(folder, bilinear_models[4])


def test_a_fault_of_the_program_in_one_frame_does_not_stop_the_others(make, bilinear_models, monkeypatch):
    folder = make(3)
    real = fuse

    def faulty(lr, *arguments, **more):
        if "1002" in lr.name:
            raise ZeroDivisionError("oh")
        return real(lr, *arguments, **more)

    monkeypatch.setattr(shot, "fuse", faulty)
    report = run(folder, bilinear_models[4])
    assert [result.status for result in report.results.values()] == ["fused", "failed", "fused"]
    assert report.results[1002].message.startswith("unexpected ZeroDivisionError: oh")
    assert report.exit_code == 1


def test_a_picture_that_is_no_preview_of_ours_is_left_alone(make, bilinear_models):
    folder = make(2)
    (folder / "out").mkdir()
    mine = folder / "out/beauty.1001.png"
    oiio.ImageBuf(oiio.ImageSpec(4, 4, 3, "uint8")).write(str(mine))
    before = mine.read_bytes()
    write_png(folder / "out/beauty.1002.png", np.zeros((2, 2, 3)))  # of a run that was killed
    report = run(folder, bilinear_models[4], previews=True, skip_existing=True)
    assert [report.results[n].status for n in (1001, 1002)] == ["failed", "fused"]
    assert "beauty.1001.png: exists; pass --overwrite" in report.results[1001].message
    assert mine.read_bytes() == before
    assert oiio.ImageBuf(str(folder / "out/beauty.1002.png")).spec().width == WIDTH


def test_a_frame_that_stays_keeps_its_preview(make, bilinear_models, monkeypatch):
    """An old frame that can't be replaced, and one that another run puts there meanwhile."""
    folder = make(1)
    assert run(folder, bilinear_models[4], previews=True).exit_code == 0
    before, real = contents(folder / "out"), write_frame

    def full_disk(*arguments, **more):
        raise MssplError("disk full")

    def too_late(report, *arguments, **more):
        report.output.write_text("theirs")
        real(report, *arguments, **more)

    write_exr(folder / "lr/lr.1001.exr", {c: values / 2 for c, values in low_layers(1).items()})
    monkeypatch.setattr(shot, "write_frame", full_disk)
    assert run(folder, bilinear_models[4], previews=True, overwrite=True).results[1001].message == "disk full"
    assert contents(folder / "out") == before
    (folder / "out/beauty.1001.exr").unlink()
    assert run(folder, bilinear_models[4], previews=True, skip_existing=True).results[1001].message == "disk full"
    assert contents(folder / "out") == {}
    monkeypatch.setattr(shot, "write_frame", too_late)
    assert "appeared while" in run(folder, bilinear_models[4], previews=True).results[1001].message
    assert (folder / "out/beauty.1001.png").exists()


def test_what_is_done_is_skipped_and_its_report_kept(make, bilinear_models):
    folder = make(3)
    not_finite(np.nan)(None, folder / "hr/beauty.1001.exr")
    report_path = folder / "r.json"
    run(folder, bilinear_models[4], frames="1001-1002", report_path=report_path)
    before = contents(folder / "out")
    with pytest.raises(InputError, match=r"r\.json: exists"):
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


# ------------------------------------------------------------------------------------------------ runs that are ended


def start(folder, model, *more):
    code = "import sys; from msspl_cli.app import msspl_fuse; msspl_fuse()"
    arguments = [folder / "lr", folder / "hr", "-o", folder / "out", "--model", model, "--report", folder / "r.json"]
    command = [sys.executable, "-c", code, *map(str, arguments), "--skip-existing", *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(folder, count, process):
    """Until so many frames are there."""
    while sum(1 for _ in folder.glob("out/beauty.*.exr")) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.001)


def test_a_shot_killed_three_times_and_resumed_is_whole(make, bilinear_models):
    """100 frames; every file is there, and bit for bit that of a run that nobody disturbed; nothing else is."""
    folder = make(100)
    undisturbed = start(folder, bilinear_models[4])
    assert undisturbed.communicate() and undisturbed.returncode == 0
    (folder / "out").rename(folder / "expected")
    (folder / "r.json").unlink()

    for count, delay in ((1, 0.0), (40, 0.003), (75, 0.007)):
        process = start(folder, bilinear_models[4])
        wait_for(folder, count, process)
        time.sleep(delay)
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        expected = contents(folder / "expected")
        half = {n: data for n, data in contents(folder / "out").items() if not n.startswith(".")}
        assert half.items() <= expected.items()
        if (folder / "r.json").exists():
            assert not json.loads((folder / "r.json").read_text())["finished"]
    # What a kill in the middle of writing leaves, should the three moments have missed it.
    (folder / "out/.beauty.1100.99999.tmp.exr").write_bytes(b"half")
    write_png(folder / "out/beauty.1100.png", np.zeros((2, 2, 3)), overwrite=True)

    last = start(folder, bilinear_models[4])
    last.communicate()
    assert last.returncode == 0
    assert contents(folder / "out") == contents(folder / "expected")
    report = json.loads((folder / "r.json").read_text())
    assert report["finished"] and report["counts"]["fused"] + report["counts"]["skipped"] == 100
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []


def test_a_signal_between_writing_and_recording_loses_no_frame(make, bilinear_models, monkeypatch):
    folder, recorded = make(4), _fused_result
    moments = iter([None, KeyboardInterrupt])

    def interrupted(*arguments):
        if moment := next(moments, None):
            raise moment
        return recorded(*arguments)

    monkeypatch.setattr(shot, "_fused_result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(folder, bilinear_models[4], report_path=folder / "r.json", previews=False)
    report = json.loads((folder / "r.json").read_text())
    files = sorted(path.name for path in (folder / "out").iterdir())
    assert files == [f"beauty.{entry['frame']}.exr" for entry in report["frames"]] != []


def test_a_frame_that_is_handed_over_as_the_signal_comes_is_reported(make, bilinear_models, monkeypatch):
    folder = make(5)
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


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_ctrl_c_ends_with_the_table_and_whole_frames(make, bilinear_models, name, code):
    folder = make(100)
    process = start(folder, bilinear_models[4], "--no-preview")
    wait_for(folder, 5, process)
    process.send_signal(getattr(signal, name))
    out, err = process.communicate()
    assert process.returncode == code, err
    assert "Traceback" not in err
    report = json.loads((folder / "r.json").read_text())
    files = sorted(path.name for path in (folder / "out").iterdir())
    assert files == [f"beauty.{entry['frame']}.exr" for entry in report["frames"]]
    assert 5 <= len(files) < 100 and not report["finished"]
    assert f"  fused     {len(files)} " in out and "run again with --skip-existing" in out
    read_bits(folder / "out" / files[-1])


def test_temporary_files_of_two_machines_have_two_names(tmp_path, monkeypatch):
    """Where both have a process of one number; either is known as a leftover."""
    monkeypatch.setattr(os, "getpid", lambda: 7)
    target = tmp_path / "a.1001.exr"
    with replacing(target, overwrite=True) as one, replacing(target) as other:
        for path in (one, other):
            path.touch()
        assert len(list(tmp_path.iterdir())) == 2
        remove_leftovers([target])
        assert list(tmp_path.iterdir()) == []
        for path in (one, other):
            path.touch()


def test_frames_are_shown_as_ranges():
    assert format_frames([1001, 1002, 1003, 1007]) == "1001-1003,1007"
