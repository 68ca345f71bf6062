# SPDX-License-Identifier: Apache-2.0
"""msspl-render with a stand-in for Blender. The tests of the add-on run it with Blender itself."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from msspl_cli.blender_process import command, find_blender
from msspl_cli.commands.render import _Printer, name_targets
from msspl_cli.extension import find_extension

from oiio_msspl import fuse_files
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import temporary_folder
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.jobs import frame as reading
from oiio_msspl.jobs import memory
from oiio_msspl.jobs.blender_source import RenderedShot
from oiio_msspl.jobs.plan import TemporalOptions
from oiio_msspl.jobs.sequence import FrameFiles
from oiio_msspl.jobs.settings import Settings
from oiio_msspl.jobs.shot import fuse_shot
from tests.conftest import EXAMPLES, downsample, noisy, picture, rgb, write_exr
from tests.jobs.test_one_size import write_render
from tests.jobs.test_over_time import make_moving_shot
from tests.programs import leave_temporary, start
from tests.shots import pixels

posix = pytest.mark.skipif(os.name != "posix", reason="the stand-in for Blender is a script")


def test_a_blender_and_a_python_with_bpy_are_started_differently():
    job, script = Path("job.json"), str(find_extension() / "headless.py")
    scene = Path("/a/scene.blend")
    assert command("/opt/blender", scene, job) == [
        *("/opt/blender", "--background", "/a/scene.blend", "--python", script, "--", "job.json")
    ]
    assert command("/venv/bin/python3.11", scene, job) == ["/venv/bin/python3.11", "-P", script, "job.json"]


@posix
def test_blender_is_found_as_named_then_by_variable_then_on_the_path(tmp_path, monkeypatch):
    for name in ("named", "variable", "blender"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("MSSPL_BLENDER", raising=False)
    assert find_blender(None) == str(tmp_path / "blender")
    monkeypatch.setenv("MSSPL_BLENDER", str(tmp_path / "variable"))
    assert find_blender(None) == str(tmp_path / "variable")
    assert find_blender(str(tmp_path / "named")) == str(tmp_path / "named")
    with pytest.raises(InputError, match="--blender /nothing: no such program"):
        find_blender("/nothing")
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("MSSPL_BLENDER")
    with pytest.raises(InputError, match="name it with --blender or MSSPL_BLENDER"):
        find_blender(None)


def test_frames_and_names_belong_together():
    assert name_targets(Path("a.exr"), None) == [(None, Path("a.exr"))]
    assert name_targets(Path("a.exr"), "7") == [(7, Path("a.exr"))]
    assert name_targets(Path("x/a.####.exr"), "8-12x2") == [
        (number, Path(f"x/a.{number:04d}.exr")) for number in (8, 10, 12)
    ]
    with pytest.raises(InputError, match="one name for 3 frames; write a"):
        name_targets(Path("a.exr"), "1-3")
    with pytest.raises(InputError, match="name the frames with --frames"):
        name_targets(Path("a.####.exr"), None)


#: Stands in for Blender: does as headless.py would, without rendering.
FAKE = """
import json, shutil, sys, os, time
from pathlib import Path
job = json.loads(Path(sys.argv[-1]).read_text())
def tell(**what): print("MSSPL", json.dumps(what), flush=True)
print("Blender 5.0.1 (hash unknown)")
if "NO_VECTORS" in os.environ: tell(no_vectors=os.environ["NO_VECTORS"])
if "WARNING" in os.environ: tell(warning=os.environ["WARNING"])
for number, output in job["frames"]:
    tell(frame=number, step="LRHS 16x9, 16 spp", fraction=0.0)
    print("Fra:1 Mem:8M | Sample 1/2", flush=True)
    {code}
    Path(output).write_text(json.dumps([sys.argv[1:], job]))
    renders = [dict(name=f"render {n}", size=[16, 9], spp=16, seconds=1.0, file=None)
               for n in range(job["options"]["renders"])]
    tell(report=dict(frame=number, output=output, renders=renders, fuse_seconds=0.5, seconds=2.5, plain_spp=2.25,
                     warnings=["the moon is full"]))
"""


@pytest.fixture
def farm(tmp_path):
    """Return functions that run msspl-render with a stand-in for Blender, which does ``code`` while it renders."""
    (tmp_path / "scene.blend").write_text("")

    def start_render(*arguments, code="pass", stderr=subprocess.PIPE):
        blender = tmp_path / "blender"
        blender.write_text(f"#!{sys.executable}\n{FAKE.replace('{code}', code)}")
        blender.chmod(0o755)
        main = "import sys; from msspl_cli.app import msspl_render as main; sys.argv[0] = 'msspl-render'; main()"
        command = [sys.executable, "-c", main, "scene.blend", "-o", "out.exr", "-s", "4"]
        command += ["--blender", str(blender), *arguments]
        return start(command, cwd=tmp_path, stderr=stderr)

    def run(*arguments, **scripts):
        with start_render(*arguments, **scripts) as process:
            out, err = process.communicate()
        left = sorted(p.name for p in tmp_path.iterdir() if p.name not in ("blender", "scene.blend", "log"))
        return process.returncode, out, err, left

    return start_render, run, tmp_path


@posix
def test_options_reach_blender_and_times_are_printed(farm):
    _, run, folder = farm
    options = ["-s", "8", "--hr-spp", "2", "--filter", "scene", "--threads", "3", "--components", "--frame", "7"]
    code, out, err, left = run(*options)
    assert (code, left) == (0, ["out.exr"]), err
    assert re.search(r"7 +1.00 +1.00 +0.50 +2.50 +about 2.2 spp", out)
    assert err == "warning: frame 7: the moon is full\n"
    argv, job = json.loads((folder / "out.exr").read_text())
    assert argv[:2] == ["--background", str(folder / "scene.blend")]
    assert Path(argv[3]).is_file()
    assert job["options"] == {
        **{"renders": 2, "scale": 8, "hr_spp": 2, "lr_spp": 0, "filter": "SCENE", "view_layer": "", "threads": 3},
        **{"components": True, "vectors": False},
    }
    assert job["frames"] == [[7, str(folder / "out.exr")]]


#: In place of rendering: has copies of a pair fused, then spoils the model's file.
ASKS = f"""
    work = Path(job["work"])
    log = open(Path(job["scene"]).with_name("log"), "a")
    print(number, len(list(work.glob("*.exr"))), file=log, flush=True)
    pair = [work / f"{{render}}.{{number}}.exr" for render in ("lr", "hr")]
    for path, name in zip(pair, ("LR", "HR")):
        shown = os.environ.get(name, {str(EXAMPLES)!r} + f"/{{name.lower()}}.exr")
        if Path(shown.format(number)).exists(): shutil.copy(shown.format(number), path)
    tell(fuse=[str(path) for path in pair[-job["options"]["renders"]:]])
    sys.stdin.readline() or sys.exit(1)
    Path(os.environ["MODEL"]).write_text("spoilt")
    renders = [dict(name=f"render {{n}}", size=[16, 9], spp=16, seconds=1.0, file="")
               for n in range(job["options"]["renders"])]
    if output:
        tell(report=dict(frame=number, output=output, renders=renders, fuse_seconds=0.5, seconds=2.5, plain_spp=2.25,
                         warnings=[]))
    continue
"""


@pytest.fixture
def model(bilinear_models, tmp_path, monkeypatch):
    """Copy a model, which ASKS spoils."""
    path = tmp_path.parent / f"{tmp_path.name}.onnx"
    shutil.copy(bilinear_models[4], path)
    monkeypatch.setenv("MODEL", str(path))
    monkeypatch.setenv("ORIGINAL", str(bilinear_models[4]))
    return str(path)


@posix
@pytest.mark.parametrize("passes", ["none", "components"])
def test_frames_are_fused_here_with_the_options_of_msspl_fuse_and_a_model_that_stays_loaded(farm, model, passes):
    _, run, folder = farm
    options = ["--model", model, "--device", "cpu", "--layout", "nuke", "--error-layer", "--passes", passes]
    code, _, err, left = run("-o", "out.##.exr", "--frames", "1-2", *options, code=ASKS)
    assert (code, err, left) == (0, "", ["out.01.exr", "out.02.exr"])
    for name in left:
        parts = open_exr(folder / name).parts
        assert [part.name for part in parts[:2]] == ["rgba", "error"]
        assert parts[0].spec.getattribute("msspl/model") == "bilinear-x4"
        assert (parts[0].spec.getattribute("msspl/passes") == "[]") == (passes == "none")


@posix
@pytest.mark.parametrize(
    ("options", "names"), [([], ["hr"]), (["--renders", "2"], ["a", "b"]), (["-s", "2"], ["lr", "hr"])]
)
def test_a_frame_is_one_render_or_two_seeds_or_two_sizes(farm, monkeypatch, options, names):
    """The result is that of msspl-fuse on these files, which are kept under names that say what they are."""
    _, run, folder = farm
    inputs = folder.parent / f"{folder.name}-inputs"
    inputs.mkdir()
    first, last = (write_render(inputs / f"{seed}.exr", seed) for seed in (1, 2))
    if "-s" in options:
        write_exr(first, rgb(noisy(downsample(picture(96, 132), 2), 8, 1)))
    fuse_files(first if len(names) == 2 else None, last, inputs / "out.exr", model="fast")
    for name, value in {"LR": first, "HR": last, "MODEL": inputs / "unused"}.items():
        monkeypatch.setenv(name, str(value))
    code, out, err, left = run(
        "-s", "1", *options, "--quality", "fast", "--layout", "spec", "--keep", "--json", code=ASKS
    )
    assert (code, err) == (0, "")
    assert left == sorted(["out.exr", *(f"out_{name}.exr" for name in names)])
    files = [render["file"] for render in json.loads(out)[0]["renders"]]
    assert files == [str(folder / f"out_{name}.exr") for name in names]
    made = open_exr(folder / "out.exr").metadata
    assert [made.get("msspl/lrhs"), made["msspl/hrls"]][-len(names) :] == files
    assert pixels(folder)["out.exr"] == pixels(inputs)["out.exr"]


@posix
@pytest.mark.parametrize("options", [["-s", "1"], ["-s", "4"]])
def test_a_shot_is_not_resumed_with_other_weights(farm, model, monkeypatch, options):
    """Nothing is left of the frame that was rendered to find the model."""
    _, run, folder = farm
    monkeypatch.setenv("MODEL", str(folder.parent / "unused"))
    shot = ["-o", "out.##.exr", "--frames", "1-2", *options]
    assert run(*shot, "--quality", "fast", code=ASKS)[0] == 0
    (folder / "out.02.exr").unlink()
    before = (folder / "out.01.exr").read_bytes()
    code, _, err, left = run(*shot, "--quality", "best", "--skip-existing", code=ASKS)
    assert (code, left, err.count("\n")) == (2, ["out.01.exr"], 1)
    assert re.match(r"error: \S+out.01.exr: was fused by other weights \(joint-small-x\d \w+\) than the frames", err)
    assert run(*shot, "--quality", "fast", "--skip-existing", code=ASKS)[::3] == (0, ["out.01.exr", "out.02.exr"])
    assert (folder / "out.01.exr").read_bytes() == before
    assert run(*shot, "--quality", "best", "--overwrite", code=ASKS)[0] == 0


@posix
def test_a_frame_that_cannot_be_fused_ends_the_shot_with_its_sentence(farm, model, monkeypatch):
    monkeypatch.setenv("HR", "/nothing/hr.exr")
    _, run, _ = farm
    code, _, err, left = run("-o", "out.##.exr", "--frames", "1-2", "--model", model, code=ASKS)
    assert (code, left) == (2, [])
    assert re.fullmatch(r"error: frame 1: \S+/hr\.1\.exr: no such file\n", err), err


@pytest.fixture(scope="module")
def moving(tmp_path_factory, bilinear_models):
    """Make a shot with motion vectors, fused by fuse_shot frame by frame and with neighbours: alone/ and whole/."""
    folder = make_moving_shot(tmp_path_factory.mktemp("moving"), count=7)
    for name, temporal in (("alone", "off"), ("whole", "auto")):
        options = {"model": str(bilinear_models[4]), "temporal": TemporalOptions(temporal)}
        assert fuse_shot(folder / "lr", folder / "hr", folder / name, **options).exit_code == 0
    return folder


@posix
def test_a_shot_is_averaged_with_its_neighbours_while_it_is_rendered(farm, model, moving, monkeypatch):
    """The frames are those of fuse_shot on the same files. At most six pairs are on the disk, and a frame that is
    rendered again for a resumed shot is not written."""
    for name in ("LR", "HR"):
        monkeypatch.setenv(name, f"{moving}/{name.lower()}/{name.lower()}.{{}}.exr")
    _, run, folder = farm
    options = ["--model", model, "--layout", "spec", "--temporal", "auto"]
    shot = ["-o", "out/hr.####.exr", "--frames", "1001-1007", *options]
    code, out, err, _ = run(*shot, "--json", code=ASKS)
    assert (code, err) == (0, "")
    assert [report["frame"] for report in json.loads(out)] == list(range(1001, 1008))
    assert pixels(folder / "out") == pixels(moving / "whole") != pixels(moving / "alone")
    rendered = [tuple(map(int, line.split())) for line in (folder / "log").read_text().splitlines()]
    assert [number for number, _ in rendered] == list(range(1001, 1008))
    assert max(files for _, files in rendered) == 12

    (folder / "log").unlink()
    for number in (1001, 1002):
        (folder / f"out/hr.{number}.exr").unlink()
    shutil.copy(moving / "hr/hr.1003.exr", folder / "out/hr.1003.exr")
    shutil.copy(os.environ["ORIGINAL"], model)
    code, out, err, _ = run(*shot, "--skip-existing", code=ASKS)
    assert (code, err) == (0, "")
    assert "Fused with 4 frames before and after each, along the motion vectors of Cycles" in out
    assert "all s" in out and "plain rendering" not in out
    assert [line.split()[0] for line in (folder / "log").read_text().splitlines()] == [
        str(number) for number in range(1001, 1007)
    ]
    written = pixels(folder / "out")
    assert written.pop("hr.1003.exr") == pixels(moving / "hr")["hr.1003.exr"]
    assert written.items() < pixels(moving / "whole").items()


def test_vectors_of_a_rendered_frame_are_decoded_once_with_its_pixels(tmp_path, bilinear_models, moving, monkeypatch):
    """And their memory is counted."""
    loaded, counted = [], []
    load, counts = reading._read_pixels, memory._vector_bytes
    monkeypatch.setattr(reading, "_read_pixels", lambda frame: (load(frame), loaded.append(list(frame.vectors))))
    monkeypatch.setattr(memory, "_vector_bytes", lambda hr, channels: counted.append(channels) or counts(hr, channels))
    frames = [FrameFiles(number, None, None, tmp_path / f"{number}.exr") for number in (1001, 1002, 1003)]
    shot = RenderedShot(Settings(model=str(bilinear_models[4])), 2, 4, frames, frames, TemporalOptions("auto"))
    for frame in shot.order:
        pair = [moving / f"{render}/{render}.{frame.number}.exr" for render in ("lr", "hr")]
        shot.fuse(*(Path(shutil.copy(path, tmp_path)) for path in pair))
    assert loaded == [[1]] * 3
    assert counted and all(counted)
    assert open_exr(tmp_path / "1002.exr").metadata["msspl/hrls"] == "a render that was not kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1001.exr", "1002.exr", "1003.exr"]


@posix
def test_without_vectors_frames_are_fused_one_by_one(farm, model, moving, monkeypatch):
    for name in ("LR", "HR"):
        monkeypatch.setenv(name, f"{moving}/{name.lower()}/{name.lower()}.{{}}.exr")
    _, run, folder = farm
    shot = ["-o", "hr.####.exr", "--frames", "1003-1005", "--model", model, "--layout", "spec"]
    monkeypatch.setenv("NO_VECTORS", "motion blur is on")
    code, out, err, _ = run(*shot, "--temporal", "auto", code=ASKS)
    assert (code, err) == (0, "")
    assert "Fused frame by frame: motion blur is on\n" in out
    assert len(pixels(folder)) == 3
    assert pixels(folder).items() < pixels(moving / "alone").items()
    shutil.copy(os.environ["ORIGINAL"], model)
    code, _, err, _ = run(*shot, "--temporal", "2", "--overwrite", code=ASKS)
    assert (code, err) == (2, "error: --temporal 2: motion blur is on\n")


@posix
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--layout", "spec", "--passes", "foo*"],
            "foo*: the scene renders no such set of layers; it has 'light groups'",
        ),
        (["--passes", "light*", "--max-memory", "400M"], "--max-memory: this frame needs more with model bilinear-x4"),
        (["--max-memory", "4G"], "or use --layout spec, which does not hold all layers at once"),
        (["-o", "out.##.exr", "--frames", "1-3", "--layout", "spec", "--temporal", "2", "--max-memory", "2G"], "needs"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_rendered(farm, model, options, message):
    """The layout multilayer holds all passes when it is written, and averaging takes memory."""
    _, run, _ = farm
    layers = ["Combined", "Combined_key", "Combined_rest", "Diffuse Direct"]
    told = f"tell(size=[8192, 4096], layers={layers}, pixel_bytes=100)"
    code, _, err, left = run("--model", model, *options, code=f"{told}; time.sleep(300)")
    assert (code, left, err.count("\n")) == (2, [], 1)
    assert message in err


@posix
def test_renders_are_kept_whatever_went_wrong_and_a_resumed_shot_replaces_them(farm, model):
    """A model that is no model any more stands for a fault of the program."""
    _, run, folder = farm
    (folder / "sitecustomize.py").write_text(
        "import sys, os\n"
        "if os.environ.pop('FAULT', '') and sys.argv[0] == '-c':\n"
        "    import oiio_msspl.jobs.run as stages\n"
        "    def fuse(*arguments, **more): raise MemoryError\n"
        "    stages.fuse = fuse\n"
    )
    arguments = ["-o", "out.##.exr", "--frames", "1-2", "--model", model, "--keep", "--skip-existing"]
    environment = {"PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}", "FAULT": "1"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        code, _, err, left = run(*arguments, code=ASKS)
    kept = ["out.01_hr.exr", "out.01_lr.exr"]
    assert (code, [name for name in left if name.endswith(".exr")]) == (1, kept)
    assert err.startswith("error: frame 1: out of memory; try a smaller --max-memory; both renders are kept"), err
    assert run(*arguments, code=ASKS)[0] == 0
    assert sorted(path.name for path in folder.glob("out*")) == [
        f"out.0{number}{suffix}.exr" for number in (1, 2) for suffix in ("", "_hr", "_lr")
    ]


@posix
def test_an_existing_result_is_noticed_before_rendering_whatever_its_extension(farm):
    _, run, folder = farm
    (folder / "b.EXR").write_text("old")
    assert run("-o", "b.EXR")[::2] == (2, "error: b.EXR: exists; pass --overwrite to replace it\n")


@posix
def test_renders_that_cannot_be_fused_are_kept_and_named(farm, model):
    _, run, folder = farm
    arguments = ["-o", "out.##.exr", "--frames", "1-2", "--model", model, "--passes", "foo*"]
    code, _, err, left = run(*arguments, code=ASKS)
    assert (code, left) == (2, ["out.01_hr.exr", "out.01_lr.exr"])
    kept = folder / "out.01_lr.exr", folder / "out.01_hr.exr"
    assert f"frame 1: --passes foo*: {kept[1]} has no such set of layers" in err
    assert err.endswith(f"; both renders are kept for msspl-fuse: {kept[0]}, {kept[1]}\n")
    assert kept[0].read_bytes() == (EXAMPLES / "lr.exr").read_bytes()
    for path in kept:
        path.write_text("the user's")
    assert "frame 1: --passes foo*: the HRLS has no such set of layers" in run(*arguments, code=ASKS)[2]
    assert [path.read_text() for path in kept] == 2 * ["the user's"]


@posix
@pytest.mark.parametrize(
    ("arguments", "code", "status", "message"),
    [
        ([], "tell(error='the scene has no camera', code=2); sys.exit(2)", 2, "error: the scene has no camera"),
        ([], "tell(error='disk full', code=1); sys.exit(1)", 1, "error: disk full"),
        ([], "print('Segmentation fault'); sys.stdout.flush(); os._exit(11)", 1, "code 11: .*Segmentation fault"),
        ([], "break", 1, "ended after 0 of 1 frames"),
        (["--scale", "3"], "", 2, "--scale 3: use one of 1, 2, 4, 8"),
        (["-s", "1", "--lr-spp", "4"], "", 2, "--lr-spp: is for a low-resolution render; give --scale, too"),
        (["--renders", "1"], "", 2, "--renders 1: does not go with --scale 4"),
        (["--filter", "gauss"], "", 2, "--filter 'gauss': use one of box, scene"),
        (["-o", "x.png"], "", 2, "x.png: the result is an EXR"),
        (["-o", "nowhere/x.exr"], "", 2, "the folder nowhere does not exist"),
        (["-o", "out.##.exr"], "", 2, "name the frames with --frames"),
        (["-o", "no/where/x.##.exr", "--frames", "1"], "", 2, "the folder no does not exist"),
        (["--overwrite", "--skip-existing"], "", 2, "exclude each other"),
        (["--blender", "nothing"], "", 2, "--blender nothing: no such program"),
        (["--model", "nothing"], "", 2, "no model 'nothing'"),
        (["--model", "joint-x2"], "", 2, "--model joint-x2: is for x2, but --scale is 4"),
        (["--device", "abacus"], "", 2, "--device 'abacus': use one of cpu"),
        (["--layout", "x"], "", 2, "--layout 'x': use one of spec"),
        (["--model", "paper", "--error-layer"], "", 2, "paper-x4 does not predict its error"),
        (["--temporal", "x"], "", 2, "--temporal x: give auto, off"),
        (["--temporal", "2"], "", 2, "--temporal 2: no two frames follow each other"),
        (["-o", "x.#.exr", "--frames", "1-9x2", "--temporal", "1"], "", 2, "--temporal 1: no two frames follow"),
    ],
)
def test_what_goes_wrong_is_one_sentence_and_a_code(farm, arguments, code, status, message):
    _, run, _ = farm
    returned, _, err, left = run(*arguments, code=code or "pass")
    assert (returned, left) == (status, [])
    assert err.count("\n") == 1
    assert re.search(message, err), err


@posix
def test_a_shot_that_fails_midway_says_where_and_is_resumed(farm):
    _, run, folder = farm
    arguments = ["-o", "new/out.##.exr", "--frames", "1-3", "--json"]
    code, out, err, left = run(*arguments, code="if number == 2: tell(error='disk full', code=1); sys.exit(1)")
    assert (code, left) == (1, ["new"])
    assert err.splitlines()[-1] == "error: frame 2: disk full"
    assert [report["frame"] for report in json.loads(out)] == [1]
    assert [path.name for path in (folder / "new").iterdir()] == ["out.01.exr"]
    assert "out.01.exr: exists" in run(*arguments)[2]
    code, out, _, _ = run(*arguments, "--skip-existing")
    assert (code, [report["frame"] for report in json.loads(out)]) == (0, [2, 3])
    assert run(*arguments[:-1], "--skip-existing")[:3] == (0, "new/out.##.exr: every frame exists\n", "")


@posix
def test_the_progress_bar_is_wiped_before_an_error(farm, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    start_render, _, _ = farm
    reader, terminal = os.openpty()
    with start_render(code="tell(error='disk full', code=1); sys.exit(1)", stderr=terminal) as process:
        process.wait()
        said = os.read(reader, 10000).decode()
    assert "LRHS 16x9, 16 spp" in said
    error = said.rpartition("\033[2K")[2]  # what follows after the bar's line is erased
    assert "LRHS" not in error
    assert error.endswith("error: disk full\r\n")


@posix
def test_a_program_that_cannot_be_started(farm):
    _, run, folder = farm
    (folder / "no-program").write_text("text")
    (folder / "no-program").chmod(0o755)
    code, _, err, _ = run("--blender", str(folder / "no-program"))
    assert code == 2
    assert re.fullmatch(r"error: .*no-program: can't be started \(.*\); name Blender.* --blender or .*\n", err), err


@posix
@pytest.mark.parametrize("said", ["", "Unknown option: -P\nusage: python [option] ..."])
def test_a_python_without_bpy_is_the_callers_mistake(farm, said):
    """It lacks the module, or is so old that it does not know an option."""
    _, run, folder = farm
    program = folder / "python3"
    program.write_text(f'#!/bin/sh\necho "{said}"; exit 2\n' if said else f'#!/bin/sh\nexec {sys.executable} -S "$@"\n')
    program.chmod(0o755)
    code, out, err, _ = run("--blender", str(program))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "python3: this Python has no module bpy; name Blender" in err


@posix
def test_nothing_is_overwritten_unasked(farm):
    _, run, folder = farm
    (folder / "out_hr.exr").write_text("old")
    code, _, err, _ = run("--keep")
    assert (code, err) == (2, "error: out_hr.exr: exists; pass --overwrite to replace it\n")
    assert run("--keep", "--overwrite")[0] == 0


@posix
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_cancelling_ends_blender_and_what_it_started(farm, how):
    start_render, _, folder = farm
    code = (
        "import subprocess; child = subprocess.Popen(['sleep', '60']); "
        "Path('pids').write_text(f'{os.getpid()} {child.pid}'); child.wait()"
    )
    process = start_render(code=code)
    while not (folder / "pids").exists() or not (folder / "pids").read_text():
        time.sleep(0.02)
        assert process.poll() is None
    pids = (folder / "pids").read_text().split()
    process.send_signal(how)
    process.communicate(timeout=30)
    assert process.returncode not in (0, None)
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            for _ in range(100):  # an orphan is reaped by its new parent
                os.kill(int(pid), 0)
                time.sleep(0.02)
    assert sorted(p.name for p in folder.iterdir()) == ["blender", "pids", "scene.blend"]


@posix
def test_what_a_killed_run_left_is_deleted_by_the_next_one(farm):
    """And nothing of a run that is alive, nor what only looks like it."""
    start_render, run, folder = farm
    process = start_render(
        code="Path('pid').write_text(str(os.getpid())); Path(job['work'], 'lr.exr').touch(); time.sleep(60)"
    )
    while not (folder / "pid").exists() or not (folder / "pid").read_text():
        time.sleep(0.02)
        assert process.poll() is None
    process.kill()
    process.communicate()
    os.kill(int((folder / "pid").read_text()), signal.SIGKILL)
    leave_temporary(folder / "out.exr")
    (folder / ".msspl-notes").mkdir()
    with temporary_folder(folder) as alive:
        code, _, err, left = run()
        assert code == 0, err
        assert left == sorted([".msspl-notes", Path(alive).name, "out.exr", "pid"])


@posix
def test_the_report_says_how_frames_are_averaged_and_what_is_wrong_with_all_of_them(farm, monkeypatch):
    """A program that starts msspl-render, such as the add-on, reads nothing else."""
    monkeypatch.setenv("WARNING", "no script was run")
    monkeypatch.setenv("NO_VECTORS", "motion blur is on")
    _, run, _ = farm
    arguments = ["-o", "out.##.exr", "--frames", "1-2", "--temporal", "auto", "--scene-name", "Night", "--json"]
    code, out, _, _ = run(*arguments)
    assert code == 0
    for report in json.loads(out):
        assert report["temporal"] == "frame by frame: motion blur is on"
        assert report["warnings"] == ["the moon is full", "no script was run"]
        assert json.loads(Path(report["output"]).read_text())[1]["scene_name"] == "Night"


@posix
def test_a_blender_that_ends_while_its_frame_is_fused_is_named(farm, model):
    _, run, _ = farm
    crash = ASKS.replace("    sys.stdin.readline() or sys.exit(1)\n", "    os._exit(3)\n")
    assert crash != ASKS
    code, _, err, _ = run("--model", model, code=crash)
    assert code == 1 and "ended with code 3" in err


def test_the_bar_covers_the_whole_run(monkeypatch):
    """It grows from frame to frame, and each of two renders is a third of a frame."""
    told = []
    shot = SimpleNamespace(order=[1, 2], suffixes=("lr", "hr"), waits=lambda output: True)
    printer = _Printer(shot, quiet=False, verbose=False, keep=False)
    monkeypatch.setattr(printer._bar, "update", lambda label, done, total: told.append((label, done / total)))
    for frame in (1, 2):
        for step, fraction in (("LRHS", 0.0), ("HRLS", 1 / 3), ("fuse", 2 / 3)):
            printer.show({"frame": frame, "step": step, "fraction": fraction})
            if step != "fuse":
                printer.show({"samples": 0.5})
        printer.show({"report": {"output": "out.exr"}})
    shares = [share for _, share in told]
    assert shares == pytest.approx([k / 12 for k in (0, 1, 2, 3, 4, 6, 7, 8, 9, 10)])
    assert told[-1][0] == "frame 2: fuse"
