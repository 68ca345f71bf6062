# SPDX-License-Identifier: Apache-2.0
"""The Blender add-on and msspl-render: what needs no Blender always, the rest in every Python with bpy that is found.

MSSPL_TEST_BPY names those Pythons, separated as in PATH; otherwise ~/venvs/bpy*/bin/python are tried.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from msspl_cli.commands import render
from msspl_cli.installed import find_msspl_fuse

from oiio_msspl import __version__
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.errors import InputError
from oiio_msspl.fusion.alignment import align
from tests.conftest import EXAMPLES

ADDON = Path(__file__).parents[1] / "blender_addon"
posix = pytest.mark.skipif(os.name != "posix", reason="the stand-in for Blender is a script")


# ---------------------------------------------------------------------------------------------- without Blender


def test_the_add_on_is_apart_from_the_core():
    """GPL files that say so, and that talk to the core as a program alone."""
    for path in [*ADDON.rglob("*.py"), ADDON / "blender_manifest.toml"]:
        text = path.read_text()
        assert text.startswith("# SPDX-License-Identifier: GPL-3.0-or-later\n"), path
        assert "import oiio_msspl" not in text, path
        assert "from oiio_msspl" not in text, path
    assert "GNU GENERAL PUBLIC LICENSE" in (ADDON / "LICENSE").read_text()
    assert tomllib.loads((ADDON / "blender_manifest.toml").read_text())["version"] == __version__


def test_a_blender_and_a_python_with_bpy_are_started_differently():
    job, script = Path("job.json"), str(ADDON / "headless.py")
    scene = Path("/a/scene.blend")
    assert render.command("/opt/blender", scene, job) == [
        *("/opt/blender", "--background", "/a/scene.blend", "--python", script, "--", "job.json")
    ]
    assert render.command("/venv/bin/python3.11", scene, job) == ["/venv/bin/python3.11", "-P", script, "job.json"]


@posix
def test_blender_is_found_as_named_then_by_variable_then_on_the_path(tmp_path, monkeypatch):
    for name in ("named", "variable", "blender"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("MSSPL_BLENDER", raising=False)
    assert render.find_blender(None) == str(tmp_path / "blender")
    monkeypatch.setenv("MSSPL_BLENDER", str(tmp_path / "variable"))
    assert render.find_blender(None) == str(tmp_path / "variable")
    assert render.find_blender(str(tmp_path / "named")) == str(tmp_path / "named")
    with pytest.raises(InputError, match="--blender /nothing: no such program"):
        render.find_blender("/nothing")
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("MSSPL_BLENDER")
    with pytest.raises(InputError, match="name it with --blender or MSSPL_BLENDER"):
        render.find_blender(None)


def test_frames_and_names_belong_together():
    assert render.name_targets(Path("a.exr"), None) == [(None, Path("a.exr"))]
    assert render.name_targets(Path("a.exr"), "7") == [(7, Path("a.exr"))]
    assert render.name_targets(Path("x/a.####.exr"), "8-12x2") == [
        (number, Path(f"x/a.{number:04d}.exr")) for number in (8, 10, 12)
    ]
    with pytest.raises(InputError, match="one name for 3 frames; write a"):
        render.name_targets(Path("a.exr"), "1-3")
    with pytest.raises(InputError, match="name the frames with --frames"):
        render.name_targets(Path("a.####.exr"), None)


#: Stands in for Blender: does as headless.py would, without rendering.
FAKE = """
import json, sys, os, time
from pathlib import Path
job = json.loads(Path(sys.argv[-1]).read_text())
def tell(**what): print("MSSPL", json.dumps(what), flush=True)
print("Blender 5.0.1 (hash unknown)")
for number, output in job["frames"]:
    tell(frame=number, step="LRHS 16x9, 16 spp", fraction=0.0)
    print("Fra:1 Mem:8M | Sample 1/2", flush=True)
    {code}
    Path(output).write_text(json.dumps([sys.argv[1:], job]))
    take = dict(name="LRHS", size=[16, 9], spp=16, seconds=1.0, file=None)
    tell(report=dict(frame=number, output=output, lrhs=take, hrls=take, fuse_seconds=0.5, seconds=2.5, plain_spp=2.25,
                     warnings=["the moon is full"]))
"""


@pytest.fixture
def farm(tmp_path):
    """Runs msspl-render with a stand-in for Blender that does ``code`` while it renders."""
    (tmp_path / "scene.blend").write_text("")

    def start(*arguments, code="pass", stderr=subprocess.PIPE):
        blender = tmp_path / "blender"
        blender.write_text(f"#!{sys.executable}\n{FAKE.replace('{code}', code)}")
        blender.chmod(0o755)
        main = "import sys; from msspl_cli.app import msspl_render as main; sys.argv[0] = 'msspl-render'; main()"
        command = [sys.executable, "-c", main, "scene.blend", "-o", "out.exr", "--blender", str(blender), *arguments]
        return subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=stderr, text=True)

    def run(*arguments, code="pass"):
        with start(*arguments, code=code) as process:
            out, err = process.communicate()
        left = sorted(p.name for p in tmp_path.iterdir() if p.name not in ("blender", "scene.blend"))
        return process.returncode, out, err, left

    return start, run, tmp_path


@posix
def test_options_reach_blender_and_times_are_printed(farm):
    _, run, folder = farm
    code, out, err, left = run("-s", "8", "--hr-spp", "2", "--filter", "scene", "--threads", "3", "--frame", "7")
    assert (code, left) == (0, ["out.exr"]), err
    assert "7      1.00    1.00    0.50    2.50   about 2.2 spp" in out
    assert err == "warning: frame 7: the moon is full\n"
    argv, job = json.loads((folder / "out.exr").read_text())
    assert argv[:2] == ["--background", str(folder / "scene.blend")]
    assert Path(argv[3]).is_file()
    assert job["options"] == {
        **{"scale": 8, "hr_spp": 2, "lr_spp": 0, "filter": "SCENE", "view_layer": "", "threads": 3}
    }
    assert job["frames"] == [[7, str(folder / "out.exr")]]
    assert Path(job["program"]).stem == "msspl-fuse"


@posix
def test_a_shot_and_a_report_for_machines(farm):
    _, run, _ = farm
    code, out, _, left = run("-o", "out.##.exr", "--frames", "1-2", "--json")
    assert (code, left) == (0, ["out.01.exr", "out.02.exr"])
    assert [report["frame"] for report in json.loads(out)] == [1, 2]


@posix
@pytest.mark.parametrize(
    ("arguments", "code", "status", "message"),
    [
        ([], "tell(error='the scene has no camera', code=2); sys.exit(2)", 2, "error: the scene has no camera"),
        ([], "tell(error='disk full', code=1); sys.exit(1)", 1, "error: disk full"),
        ([], "print('Segmentation fault'); sys.stdout.flush(); os._exit(11)", 1, "code 11: .*Segmentation fault"),
        ([], "break", 1, "ended after 0 of 1 frames"),
        (["--scale", "3"], "", 2, "--scale 3: use one of 2, 4, 8"),
        (["--filter", "gauss"], "", 2, "--filter 'gauss': use one of box, scene"),
        (["-o", "x.png"], "", 2, "x.png: the result is an EXR"),
        (["-o", "nowhere/x.exr"], "", 2, "the folder nowhere does not exist"),
        (["-o", "out.##.exr"], "", 2, "name the frames with --frames"),
        (["-o", "no/where/x.##.exr", "--frames", "1"], "", 2, "the folder no does not exist"),
        (["--overwrite", "--skip-existing"], "", 2, "exclude each other"),
        (["--blender", "nothing"], "", 2, "--blender nothing: no such program"),
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
    assert run(*arguments[:-1], "--skip-existing")[:3] == (0, "new/out.##.exr: all is there\n", "")


@posix
def test_the_status_line_is_wiped_before_an_error(farm):
    start, _, _ = farm
    reader, terminal = os.openpty()
    with start(code="tell(error='disk full', code=1); sys.exit(1)", stderr=terminal) as process:
        process.wait()
        said = os.read(reader, 10000).decode()
    assert "frame None: LRHS" in said
    assert said.endswith("\r\033[Kerror: disk full\r\n")


@posix
def test_a_program_that_cannot_be_started(farm):
    _, run, folder = farm
    (folder / "no-program").write_text("text")
    (folder / "no-program").chmod(0o755)
    code, _, err, _ = run("--blender", str(folder / "no-program"))
    assert code == 2
    assert re.fullmatch(r"error: .*no-program: can't be started \(.*\); name Blender.* --blender or .*\n", err), err


@posix
def test_nothing_is_overwritten_unasked(farm):
    _, run, folder = farm
    (folder / "out_oidn.exr").write_text("old")
    code, _, err, _ = run("--compare")
    assert (code, err) == (2, "error: out_oidn.exr: exists; pass --overwrite to replace it\n")
    assert run("--compare", "--overwrite")[0] == 0


@posix
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_cancelling_ends_blender_and_what_it_started(farm, how):
    start, _, folder = farm
    code = (
        "import subprocess; child = subprocess.Popen(['sleep', '60']); "
        "Path('pids').write_text(f'{os.getpid()} {child.pid}'); child.wait()"
    )
    process = start(code=code)
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


# ---------------------------------------------------------------------------------------------- in Blender


def pythons_with_bpy():
    named = os.environ.get("MSSPL_TEST_BPY")
    if named is not None:
        return [Path(p) for p in named.split(os.pathsep) if p]
    return sorted(Path.home().glob("venvs/bpy*/bin/python"))


BPY = pythons_with_bpy()


@pytest.fixture(scope="module", params=BPY or [None], ids=lambda p: p.parents[1].name if p else "none")
def python(request):
    if request.param is None:
        pytest.skip("no Python with bpy; name some in MSSPL_TEST_BPY")
    return request.param


@pytest.fixture(scope="module")
def results(python, tmp_path_factory):
    """The folder that the add-on's own checks leave."""
    folder, resources = tmp_path_factory.mktemp("work"), tmp_path_factory.mktemp("resources")
    environment = {
        **os.environ,
        "MSSPL_FUSE": find_msspl_fuse(),
        "BLENDER_USER_RESOURCES": str(resources),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    script = ADDON / "tests" / "in_blender.py"
    done = subprocess.run([python, script, folder], env=environment, capture_output=True, text=True, timeout=600)
    assert done.stdout.endswith("all is well\n"), done.stdout[-2000:] + done.stderr[-2000:]
    return folder


def layer(path, name, components):
    """float32 (height, width, components) of a layer of a single-part EXR."""
    file = open_exr(path)
    channels = {c.name: c for part in file.parts for c in part.channels}
    names = [name + component for component in components]
    return file.read([channels[n] for n in names], file.parts[0].data_window)


def test_the_composited_frame_is_the_file(results):
    for name, components in (("Combined", "RGBA"), ("Mist", "ZZZ"), ("Normal", "XYZ")):
        fused = layer(results / "fused_012.exr", f"ViewLayer.{name}.", components)
        composited = layer(results / f"composited_{name}.exr", "", "RGBA"[: len(components)])
        np.testing.assert_array_equal(composited, fused)
        assert fused.std() > 0.01


def test_both_renders_show_the_same_frame_when_sizes_are_rounded(results):
    """A ramp has the same values at the edges of the frame: to a twentieth of an HRLS pixel, at x8."""
    for name in ("wide", "tall", "squeezed"):
        low, high = (map_render(open_exr(results / f"{name}_{kind}.exr"), features=()) for kind in ("lr", "hr"))
        assert align(low, high).scale == 8
        for axis in (0, 1):
            edges = []
            for render_ in (low, high):
                values = render_.read(render_.data_window)["rgb"][..., 1 - axis].mean(1 - axis)
                centres = (np.arange(len(values)) + 0.5) / len(values)
                edges.append(np.polyval(np.polyfit(centres, values, 1), [0, 1]))
            pixel = abs(edges[1][1] - edges[1][0]) / (high.data_window.width if axis else high.data_window.height)
            assert np.abs(edges[0] - edges[1]).max() < 0.05 * pixel, (name, axis)


def msspl_render(*arguments):
    main = "import sys; from msspl_cli.app import msspl_render as main; sys.argv[0] = 'msspl-render'; main()"
    return subprocess.run([sys.executable, "-c", main, *map(str, arguments)], capture_output=True, text=True)


@posix
def test_msspl_render_from_scene_to_frame(python, results, tmp_path):
    """With a stand-in for Blender's program that reads the command line as Blender does."""
    out = tmp_path / "out {frame}"  # Blender has variables of such names
    blender = tmp_path / "blender"
    blender.write_text(
        f"#!{python}\nimport bpy, runpy, sys\n"
        "assert sys.argv[1] + sys.argv[3] + sys.argv[5] == '--background' + '--python' + '--'\n"
        "bpy.ops.wm.open_mainfile(filepath=sys.argv[2])\n"
        "runpy.run_path(sys.argv[4], run_name='__main__')\n"
    )
    blender.chmod(0o755)
    options = ["-s", "2", "--lr-spp", "8", "--view-layer", "ViewLayer", "--keep", "--compare", "--json"]
    frames = ["--frames", "3-4", "-o", out / "out.##.exr"]
    done = msspl_render(results / "scene.blend", "--blender", blender, *options, *frames)
    assert done.returncode == 0, done.stderr
    reports = json.loads(done.stdout)
    assert [report["frame"] for report in reports] == [3, 4]
    for report in reports:
        assert (report["lrhs"]["size"], report["lrhs"]["spp"]) == ([51, 38], 8)
        assert (report["hrls"]["size"], report["hrls"]["spp"]) == ([101, 75], 1)
        stages = report["lrhs"]["seconds"], report["hrls"]["seconds"], report["fuse_seconds"]
        assert report["seconds"] == pytest.approx(sum(stages))
        assert report["plain_spp"] > 3
        assert report["oidn"]["spp"] >= 1
    names = [f"out.{n}{suffix}.exr" for n in ("03", "04") for suffix in ("", "_hr", "_lr", "_oidn")]
    assert sorted(p.name for p in out.iterdir()) == sorted(names)
    for name, components in (("CryptoObject00", "rgba"), ("Mist", "Z"), ("Combined_key", "RGB"), ("Matte", "RGB")):
        both = [layer(out / f"out.03{s}.exr", f"ViewLayer.{name}.", components) for s in ("", "_hr")]
        np.testing.assert_array_equal(*both)
    means = [layer(out / f"out.03{suffix}.exr", "ViewLayer.Combined.", "RGB").mean() for suffix in ("", "_lr", "_oidn")]
    assert means == pytest.approx([means[2]] * 3, rel=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-s", "2"], "2 view layers are on (ViewLayer, Other.1); name the one to render"),
        (["--view-layer", "Third"], "has no view layer 'Third'; it has ViewLayer, Other.1"),
    ],
)
def test_what_the_scene_does_not_allow_comes_through_as_a_sentence(python, results, tmp_path, options, message):
    done = msspl_render(results / "scene.blend", "--blender", python, *options, "-o", tmp_path / "out.exr")
    assert (done.returncode, list(tmp_path.iterdir())) == (2, [])
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_that_is_no_scene(python, tmp_path):
    done = msspl_render(EXAMPLES / "README.md", "--blender", python, "-o", tmp_path / "out.exr")
    assert done.returncode == 2
    assert "README.md: can't be opened" in done.stderr
