# SPDX-License-Identifier: Apache-2.0
"""msspl-fuse on one pair, as a process: its exit code, what it prints, and what it wrote, reopened."""

import json
import re
import signal
import subprocess
import sys
import time

import numpy as np
import OpenImageIO as oiio
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from tests.conftest import EXAMPLES, picture, rgb, write_exr
from tests.programs import fuse, run, start


def test_the_main_job(files, bilinear_models):
    done = fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--model", bilinear_models[4])
    assert done.returncode == 0, done.stderr
    assert "albedo    found: albedo\n" in done.stdout
    assert "variance  none (optional)\n" in done.stdout
    timing = r"Fused with bilinear-x4 on the CPU in \d+\.\d s \(\d\.\d s loading, \d\.\d s fusing, \d\.\d s writing\)\."
    assert re.search(timing, done.stdout), done.stdout
    assert done.stderr == ""
    out = map_render(open_exr(files / "out.exr"))
    values = out.read(out.data_window)
    assert values["rgb"].shape == (96, 128, 3)
    assert (values["alpha"] == 1).all()
    mask = next(p for p in out.file.parts if p.name == "mask")
    assert (out.file.read(mask.channels, mask.data_window) == 7).all()
    assert out.metadata["msspl/model"] == "bilinear-x4"
    preview = oiio.ImageBuf(str(files / "out.png"))
    assert (preview.spec().width, preview.spec().height, preview.spec().nchannels) == (128, 96, 3)


def test_with_strict_a_warning_is_an_error(files, bilinear_models):
    """A good pair is written; one with a warning is not."""
    options = ("--model", bilinear_models[4], "--no-preview", "--strict")
    assert fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", *options).returncode == 0
    bright = oiio.ImageBuf(str(files / "lr.exr"))
    oiio.ImageBufAlgo.mul(bright, bright, 4.0)
    assert bright.write(str(files / "bright.exr"))
    done = fuse(files / "bright.exr", files / "hr.exr", "-o", files / "no.exr", *options)
    assert done.returncode == 2 and not (files / "no.exr").exists()
    assert "not written, because warnings are errors: " in done.stderr and "times as bright" in done.stderr


def test_a_quality_names_the_model(files):
    pair = files / "lr.exr", files / "hr.exr", "-o", files / "out.exr"
    done = fuse(*pair, "--quality", "fast", "--no-preview", "--json")
    assert (done.returncode, json.loads(done.stdout)["model"]) == (0, "joint-small-x4")
    for options, message in (
        (("--quality", "good"), "--quality 'good': use one of fast, balanced, best"),
        (("--quality", "fast", "--model", "joint"), "--quality and --model: give one of them"),
    ):
        done = fuse(*pair, *options, "--overwrite")
        assert done.returncode == 2 and message in done.stderr


def test_the_predicted_error_can_be_asked_for(files, bilinear_models):
    options = ("--model", bilinear_models[4], "--error-layer", "--no-preview")
    assert fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", *options).returncode == 0
    part = open_exr(files / "out.exr").parts[1]
    assert (part.name, [channel.name for channel in part.channels]) == ("error", ["error.Y"])


def test_albedo_and_normal_without_noise_can_be_asked_for(files):
    """The HRLS has an albedo and no normal. Its own albedo stays as it is."""
    pair = files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--data-passes", "--no-preview"
    refused = fuse(*pair)
    assert refused.returncode == 2
    assert "--data-passes: joint-x4 does not denoise albedo and normal; use --quality best" in refused.stderr
    done = fuse(*pair, "--quality", "best")
    assert done.returncode == 0, done.stderr
    names = [[channel.name for channel in part.channels] for part in open_exr(files / "out.exr").parts]
    assert names[1] == [f"denoised_albedo.{c}" for c in "RGB"]
    assert [f"albedo.{c}" for c in "RGB"] in names


def test_what_the_renders_bring_back_can_be_seen_and_left_out(files):
    pair = files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--no-preview", "--quality", "fast"
    done = fuse(*pair, "--trust-layer", "--json")
    assert done.returncode == 0, done.stderr
    layer = next(part for part in open_exr(files / "out.exr").parts if part.name == "trust")
    assert [channel.name for channel in layer.channels] == ["trust.Y"]
    assert 0 <= json.loads(done.stdout)["trust"] <= 1
    done = fuse(*pair, "--trust", "off", "--json", "--overwrite")
    assert json.loads(done.stdout)["trust"] is None
    assert open_exr(files / "out.exr").parts[0].metadata["msspl/trust"] == "off"
    refused = fuse(*pair, "--trust", "maybe", "--overwrite")
    assert refused.returncode == 2 and "--trust 'maybe': use on or off" in refused.stderr


def test_the_report_for_machines(files, bilinear_models):
    options = "--json", "--lr-spp", 16, "--hr-spp", 1, "--no-preview", "--model", bilinear_models[4]
    done = fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", *options)
    report = json.loads(done.stdout)
    assert report["spp"] == {"lrhs": 16, "hrls": 1, "average": 2}
    assert report["preview"] is None
    assert not (files / "out.png").exists()
    assert {row["feature"]: row["status"] for row in report["aovs"]}["diffuse"] == "default"


def test_quiet_says_nothing(files, bilinear_models):
    done = fuse(files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--model", bilinear_models[4], "-q")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_nothing_is_overwritten_without_being_told(files, bilinear_models):
    arguments = [files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--model", bilinear_models[4]]
    (files / "out.exr").write_text("old")
    done = fuse(*arguments)
    assert done.returncode == 2
    assert done.stderr == f"error: {files}/out.exr: exists; pass --overwrite to replace it\n"
    assert (files / "out.exr").read_text() == "old"
    (files / "out.exr").unlink()
    (files / "out.png").write_text("old")
    assert fuse(*arguments).returncode == 2
    assert not (files / "out.exr").exists()
    assert fuse(*arguments, "--overwrite").returncode == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hr.exr", "lr.exr"], "the inputs look swapped"),
        (["hr.exr", "hr.exr"], "given twice"),
        (["lr.exr", "hr.exr", "hr.exr"], "hr.exr: is a third render; give one, or two of the same frame"),
        (["hr.exr", "--model", "paper"], "the model paper needs a low-resolution render"),
        (["lr.exr", "nothing.exr"], "nothing.exr: no such file"),
        (["lr.exr", "text.exr"], "text.exr: can't be opened as an EXR"),
        (["lr.exr", "hr.exr", "--map", "albedo=nothing"], "albedo is mapped to nothing, which is not there"),
        (["lr.exr", "hr.exr", "--device", "abacus"], "use one of cpu"),
        (["lr.exr", "hr.exr", "--model", "nothing"], "no model 'nothing'"),
        (["lr.exr", "hr.exr", "--layout", "x"], "use one of spec"),
        (["lr.exr", "hr.exr", "--max-memory", "lots"], "write it as 3G or 800M"),
        (["lr.exr", "hr.exr", "--max-memory", "1M"], "allow at least"),
        (["lr.exr", "hr.exr", "--lr-spp", "inf"], "--lr-spp inf: give the samples per pixel, a number above 0"),
        (["lr.exr", "hr.exr", "--hr-spp", "nan"], "--hr-spp nan: give the samples per pixel, a number above 0"),
        (["lr.exr", "hr.exr", "--hr-spp", "0"], "--hr-spp 0: give the samples per pixel, a number above 0"),
        (["lr.exr", "hr.exr", "-o", "."], "is a folder"),
        (["lr.exr", "."], "is a folder"),
        (["lr.exr", "hr.exr", "--compression", "dwaa:x"], "use one of none"),
        (["lr.exr", "hr.exr", "--ocio-view", "sepia"], "--ocio-view 'sepia'"),
        (["lr.exr", "hr.exr", "-o", "hr.exr", "--overwrite"], "is one of the inputs"),
        (["lr.exr", "hr.exr", "-o", "out.png"], "the result is an EXR"),
    ],
)
def test_the_callers_mistakes_are_one_sentence_and_exit_code_2(files, bilinear_models, arguments, message):
    (files / "text.exr").write_text("hello " * 50)
    names = [str(files / a) if a.endswith((".exr", ".png")) else a for a in arguments]
    if "--model" not in names:
        names += ["--model", str(bilinear_models[4])]
    if "-o" not in names:
        names += ["-o", str(files / "out.exr")]
    done = fuse(*names)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (files / "out.exr").exists()


def test_one_render_is_enough(files):
    done = fuse(files / "hr.exr", "-o", files / "out.exr", "--quality", "fast", "--json")
    report = json.loads(done.stdout)
    assert (report["model"], report["scale"], report["lrhs"]) == ("joint-small-x1", 1, None)
    text = fuse(files / "hr.exr", "-o", files / "out.exr", "--quality", "fast", "--overwrite").stdout
    assert text.splitlines()[0].startswith("Render at x1")


def test_debug_shows_the_traceback_and_leaves_the_exit_code(files):
    done = fuse(files / "hr.exr", files / "lr.exr", "-o", files / "out.exr", "--debug")
    assert "Traceback" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert done.returncode == 2


@pytest.mark.parametrize("option", ["lr", "output"])
def test_a_name_that_is_too_long_is_a_mistake(files, option):
    name = files / f"{'x' * 300}.exr"
    lr, output = (name, files / "out.exr") if option == "lr" else (files / "lr.exr", name)
    done = fuse(lr, files / "hr.exr", "-o", output)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {name}: can't be used (")
    assert done.stderr.count("\n") == 1


def test_wrong_usage_is_exit_code_2(files):
    assert fuse(files / "lr.exr").returncode == 2


def test_opencolorio_views_of_the_preview(files, bilinear_models):
    arguments = [files / "lr.exr", files / "hr.exr", "-o", files / "out.exr", "--model", bilinear_models[4]]
    pictures = []
    for extra in ([], ["--ocio-view", "Un-tone-mapped"], ["--ocio-view", "ACES 1.0 - SDR Video"]):
        assert fuse(*arguments, "--overwrite", *extra).returncode == 0
        pictures.append(np.asarray(oiio.ImageBuf(str(files / "out.png")).get_pixels(oiio.UINT8)).astype(int))
    assert np.abs(pictures[0] - pictures[1]).max() <= 2  # the paper's curve is sRGB, clipped at white
    assert np.abs(pictures[0] - pictures[2]).mean() > 5


def test_a_stereo_pair_says_whose_layers_are_read(tmp_path, bilinear_models):
    """The views that are fused, those that are not, and negative values apart from broken ones."""
    for name, size in (("lr", (24, 32)), ("hr", (96, 128))):
        left, right = picture(*size), picture(*size) * 2
        left[0, 0], left[0, 1, 0] = -0.1, np.nan
        write_exr(tmp_path / f"{name}.exr", rgb(left) | rgb(right, "right."), multiView=["left", "right"])
    options = ("--model", bilinear_models[4], "--no-preview", "-o", tmp_path / "out.exr")
    done = fuse(tmp_path / "lr.exr", tmp_path / "hr.exr", *options)
    assert done.stdout.startswith("Pair at x4, views left, right\n"), done.stderr
    assert re.search(r"\n  view right: rgb .*, albedo none: expect blur\n", done.stdout)
    assert "Repaired values that were NaN or infinite: 1 in lrhs.rgb, 1 in hrls.rgb\n" in done.stdout
    assert "Set negative values to 0 (colours out of gamut): 3 in lrhs.rgb, 3 in hrls.rgb\n" in done.stdout
    assert open_exr(tmp_path / "out.exr").metadata["msspl/aovs"].endswith("variance: none (optional); alpha: none")
    done = fuse(tmp_path / "lr.exr", tmp_path / "hr.exr", *options, "--overwrite", "--view-layer", "left")
    assert done.stdout.startswith("Pair at x4, view left (also there: right)\n"), done.stderr
    assert "view right" not in done.stdout


def test_all_views_that_are_fused_are_named(tmp_path, bilinear_models):
    """Two view layers for each eye."""
    for name, size in (("lr", (24, 32)), ("hr", (96, 128))):
        channels = {}
        for prefix in ("fg.Combined.", "bg.Combined.", "fg.Combined.right.", "bg.Combined.right."):
            channels |= rgb(picture(*size), prefix)
        write_exr(tmp_path / f"{name}.exr", channels, multiView=["left", "right"])
    options = ("--model", bilinear_models[4], "--no-preview", "-o", tmp_path / "out.exr")
    done = fuse(tmp_path / "lr.exr", tmp_path / "hr.exr", *options)
    assert "views left/bg, right/bg, left/fg, right/fg\n" in done.stdout, done.stderr


def test_layers_of_the_example_are_chosen_by_any_spelling(tmp_path, bilinear_models):
    """The example's layers are called ViewLayer.CryptoObject00 and so on."""
    options = ("--model", bilinear_models[4], "--no-preview", "--layers", "viewlayer.CRYPTO*")
    done = fuse(EXAMPLES / "lr.exr", EXAMPLES / "hr.exr", "-o", tmp_path / "out.exr", *options)
    assert done.returncode == 0, done.stderr
    names = {channel.name.split(".")[1] for part in open_exr(tmp_path / "out.exr").parts for channel in part.channels}
    assert names == {"Combined", "CryptoObject00"}


def test_the_readmes_first_command_shows_a_result(tmp_path):
    """Our own example pair through the shipped model: finite, as bright as the LRHS, cryptomatte still there."""
    done = fuse(EXAMPLES / "lr.exr", EXAMPLES / "hr.exr", "-o", tmp_path / "out.exr", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    report = json.loads(done.stdout)
    assert (report["scale"], report["spp"]["average"]) == (4, 2)
    out = map_render(open_exr(tmp_path / "out.exr"))
    values = out.read(out.data_window)["rgb"]
    assert np.isfinite(values).all()
    low = map_render(open_exr(EXAMPLES / "lr.exr"))
    assert values.mean() == pytest.approx(low.read(low.data_window)["rgb"].mean(), rel=0.1)
    names = {p.name for p in out.file.parts}
    assert any("CryptoObject00" in n for n in names)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize(("name", "exit_code"), [("SIGTERM", 143), ("SIGINT", 130), ("SIGHUP", 129)])
def test_a_signal_leaves_nothing_half_written(tmp_path, bilinear_models, name, exit_code):
    """The signal of a farm, of Ctrl-C or of a closed terminal comes while the EXR is written: the old file stays."""
    noise = np.random.default_rng(0).integers(0, 2**31, (512, 512), dtype=np.uint32)
    write_exr(tmp_path / "hr.exr", rgb(picture(512, 512)) | {f"id{i}.X": noise + i for i in range(40)})
    write_exr(tmp_path / "lr.exr", rgb(picture(128, 128)))
    (tmp_path / "out.exr").write_text("old")
    before = sorted(path.name for path in tmp_path.iterdir())
    code = "from msspl_cli.app import msspl_fuse; msspl_fuse()"
    options = ("--model", bilinear_models[4], "--overwrite", "--no-preview")
    process = start(
        [sys.executable, "-c", code, tmp_path / "lr.exr", tmp_path / "hr.exr", "-o", tmp_path / "out.exr", *options]
    )
    while not any(path.stat().st_size > 1000 for path in tmp_path.glob(".msspl-*/*")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.001)
    process.send_signal(getattr(signal, name))
    _, err = process.communicate(timeout=60)
    assert process.returncode == exit_code, err
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (tmp_path / "out.exr").read_bytes() == b"old"


def test_a_signal_that_interrupts_the_start_of_a_thread_does_not_keep_the_program_from_ending():
    code = """
import sys, threading, typer
from msspl_cli.errors import run
from oiio_msspl.image import parallel
app = typer.Typer()
start = threading.Thread.start

def start_and_be_interrupted(thread):
    start(thread)
    sys.exit(143)

@app.command()
def work() -> None:
    threading.Thread.start = start_and_be_interrupted
    parallel.available_cores = lambda: 2  # with one there is no thread
    parallel.in_background(lambda: print("done"))

run(app)
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (process.returncode, process.stdout) == (143, "done\n"), process.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize("names", [["SIGHUP"], ["SIGTERM", "SIGTERM", "SIGINT"], ["SIGINT", "SIGINT", "SIGHUP"]])
def test_signals_in_quick_succession_leave_no_temporary_file(files, names):
    """The first one ends the program while it writes, the others come while it cleans up."""
    code = """
import sys, time, typer
from pathlib import Path
from msspl_cli.errors import run
from oiio_msspl.exr.atomic import replacing
app = typer.Typer()

@app.command()
def write(path: Path) -> None:
    try:
        with replacing(path) as temporary:
            temporary.write_text("half")
            print("on", flush=True)
            time.sleep(60)
    finally:
        time.sleep(0.5)
        path.with_suffix(".cleaned").touch()

run(app)
"""
    out = files / "new.exr"
    process = start([sys.executable, "-c", code, out])
    process.stdout.readline()
    for name in names:
        process.send_signal(getattr(signal, name))
        time.sleep(0.1)
    process.communicate(timeout=30)
    assert process.returncode == (130 if names[0] == "SIGINT" else 128 + getattr(signal, names[0]))
    assert [path.name for path in files.iterdir() if path.name.startswith((".", "new"))] == ["new.cleaned"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lrr/", "hrr/", "-o", "newout/"], "lrr: no such file or folder"),
        (["lrr", "hrr", "-o", "out", "--frames", "1-3"], "lrr: no such file or folder"),
        (
            ["lr*.exr", "hr*.exr", "-o", "out"],
            "lr*.exr: no such file or folder; write the place of the frame number as #",
        ),
    ],
)
def test_mistyped_names_are_said_first(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = run("msspl_fuse", *arguments)
    assert done.returncode == 2 and message in done.stderr and not list(tmp_path.iterdir())
