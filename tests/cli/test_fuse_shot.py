# SPDX-License-Identifier: Apache-2.0
"""msspl-fuse on shots, as a process: what it prints, its exit code, and what is left when it is ended."""

import json
import re
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.conftest import read_bits, write_exr
from tests.programs import fuse, leave_temporary, start
from tests.shots import HEIGHT, WIDTH, contents, layers, make_shot, write_png


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lr/##.##.exr", "hr", "-o", "out"], "has its frame number in one place"),
        (["lr/x.####.exr", "hr", "-o", "out"], "no file has such a name; the folder has .*lr.####.exr"),
        (["no/x.####.exr", "hr", "-o", "out"], "there is no folder"),
        (["lr/lr.1001.exr", "hr", "-o", "out"], "is a single file, the other one is a folder"),
        (["lr", "hr", "-o", "out.exr"], r"one name for many frames; write out.####.exr"),
        (["lr", "hr", "-o", "out.####.png"], "the results are EXRs"),
        (["lr", "hr", "-o", "no/such/folder"], "does not exist; create it first"),
        (["lr", "hr", "-o", "plain"], "the folder plain is a file; name another one"),
        (["lr", "hr", "-o", "plain/out"], "the folder plain is a file; name another one"),
        (["lr", "hr", "-o", "plain/out.####.exr"], "the folder plain is a file; name another one"),
        (["lr", "hr", "-o", "hr", "--skip-existing"], "is one of the inputs"),
        (["lr", "hr", "-o", "out", "--frames", "a-b"], "--frames 'a-b': write it as 1001-1100"),
        (["lr", "hr", "-o", "out", "--frames", "1-2x0.5"], "whole frames only"),
        (["lr", "hr", "-o", "out", "--frames", ""], "names no frame"),
        (["lr", "hr", "-o", "out", "--overwrite", "--skip-existing"], "exclude each other"),
        (["lr", "hr", "-o", "out", "--progress", "x"], "use one of openjd, json"),
        (["lr", "hr", "-o", "out", "--progress", "json", "--json"], "both print to standard output"),
        (["lr", "hr", "-o", "out", "--report", "no/r.json"], "does not exist; create it first"),
        (["lr", "hr", "-o", "out", "--model", "x"], "no model 'x'"),
        (["lr", "hr", "-o", "out", "--ocio-view", "x"], "--ocio-view 'x'"),
        (["lr", "hr", "-o", "out", "--motion-format", "layer=v,to=x"], "layer=v,to=x': to is next or previous"),
        (["lr", "hr", "-o", "out", "--model", "paper", "--error-layer"], "paper-x4 does not predict its error"),
        (["lr/lr.1001.exr", "hr/beauty.1001.exr", "-o", "o.exr", "--skip-existing"], "--skip-existing is for shots"),
    ],
)
def test_what_is_wrong_for_the_whole_shot_is_said_at_once(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(make_shot(tmp_path, 1))
    (tmp_path / "plain").touch()
    done = fuse(*arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and done.stdout == ""
    assert re.search(message, done.stderr), done.stderr


def test_progress_for_programs(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 3)
    (folder / "lr/lr.1002.exr").unlink()
    arguments = [folder / "lr", folder / "hr", "-o", folder / "out", "--model", bilinear_models[4], "--no-preview"]
    lines = [json.loads(line) for line in fuse(*arguments, "--progress", "json").stdout.splitlines()]
    begin = lines.pop(1)  # a missing frame is told before
    assert (begin["found"]["frame"], begin["found"]["scale"]) == (1001, 4)
    assert begin["temporal"].startswith("frame by frame: no two frames follow each other")
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


def test_a_failure_has_one_text_whoever_reads_it(tmp_path, bilinear_models):
    """Nuke's node reads both lines, and counts failures by their texts."""
    folder = make_shot(tmp_path / "my  shot", 1)
    (folder / "hr/beauty.1001.exr").write_text("no EXR")
    given = folder / "lr", folder / "hr", "-o", folder / "out", "--model", bilinear_models[4], "--progress", "openjd"
    done = fuse(*given)
    (told,) = (line for line in done.stdout.splitlines() if line.startswith("openjd_fail: "))
    assert "my  shot" in told
    assert done.stderr.splitlines() == [told.replace("openjd_fail", "error")]


def test_with_strict_only_the_frame_with_a_warning_fails(tmp_path, bilinear_models):
    make_shot(tmp_path, 2)
    write_exr(tmp_path / "hr/beauty.1002.exr", {name: plane * 4 for name, plane in layers(1002).items()})
    done = fuse(tmp_path / "lr", tmp_path / "hr", "-o", tmp_path / "out", "--model", bilinear_models[4], "--strict")
    assert done.returncode != 0 and "not written, because warnings are errors: the HRLS is" in done.stdout + done.stderr
    assert [path.stem[-4:] for path in (tmp_path / "out").glob("*.exr")] == ["1001"]


def test_what_a_person_reads(tmp_path, bilinear_models):
    folder = make_shot(tmp_path, 4)
    for number in (1002, 1003):
        (folder / f"hr/beauty.{number}.exr").write_text("no EXR")
    given = folder / "lr", folder / "hr", "-o", folder / "out", "--model", bilinear_models[4], "-v", "--no-preview"
    done = fuse(*given, "--temporal", "off")
    assert done.returncode == 2
    assert "  albedo    found: albedo\n" in done.stdout
    assert "  fused   2  1001,1004\n  failed  2  1002-1003 " in done.stdout
    assert done.stderr.count("error: frame 100") == 1  # one sentence, but for the number
    assert "frame 1004: fused (read " in done.stderr
    assert "debug: report: " not in done.stderr
    more = fuse(*given, "-v", "--temporal", "off", "--overwrite")  # -vv
    assert more.stderr.count("debug: report: ") == 2


def test_a_full_disk_and_a_link_to_nowhere_leave_nothing_half_written(tmp_path, bilinear_models):
    """A full disk is exit code 1, whatever else is wrong; no half frame, and no preview without its frame, stays."""
    folder = make_shot(tmp_path, 4)
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
    assert re.search("error: frame 1002: .* can't be written", done.stderr), done.stderr
    assert re.search("error: frame 1003: .*/gone does not exist; create it first", done.stderr), done.stderr
    names = {path.name for path in (folder / "out").iterdir() if path.is_file()}
    assert names == {f"beauty.{n}.{e}" for n in (1001, 1004) for e in ("exr", "png")}


def start_shot(folder, model, *more):
    code = "import sys; from msspl_cli.app import msspl_fuse; msspl_fuse()"
    arguments = [folder / "lr", folder / "hr", "-o", folder / "out", "--model", model, "--report", folder / "r.json"]
    return start([sys.executable, "-c", code, *arguments, "--skip-existing", *more])


def wait_for(folder, count, process):
    """Until so many frames are there."""
    while sum(1 for _ in folder.glob("out/beauty.*.exr")) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.001)


def test_a_shot_killed_three_times_and_resumed_is_whole(tmp_path, bilinear_models):
    """100 frames; every file is there, and bit for bit that of a run that nobody disturbed; nothing else is."""
    folder = make_shot(tmp_path, 100)
    undisturbed = start_shot(folder, bilinear_models[4])
    assert undisturbed.communicate() and undisturbed.returncode == 0
    (folder / "out").rename(folder / "expected")
    (folder / "r.json").unlink()

    for count, delay in ((1, 0.0), (40, 0.003), (75, 0.007)):
        process = start_shot(folder, bilinear_models[4])
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
    leave_temporary(folder / "out/beauty.1100.exr")
    write_png(folder / "out/beauty.1100.png", overwrite=True)

    last = start_shot(folder, bilinear_models[4])
    last.communicate()
    assert last.returncode == 0
    assert contents(folder / "out") == contents(folder / "expected")
    report = json.loads((folder / "r.json").read_text())
    assert report["finished"] and report["counts"]["fused"] + report["counts"]["skipped"] == 100
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_ctrl_c_ends_with_the_table_and_whole_frames(tmp_path, bilinear_models, name, code):
    folder = make_shot(tmp_path, 100)
    process = start_shot(folder, bilinear_models[4], "--no-preview")
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
