# SPDX-License-Identifier: Apache-2.0
"""The gizmo without Nuke: its Tcl through a real interpreter, its buttons in a fake host with the real msspl-fuse."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from msspl_cli.installed import find_msspl_fuse

from tests import fake_nuke
from tests.conftest import EXAMPLES
from tests.fake_nuke import FakeNuke, read_script, tcl_interpreters

FOLDER = Path(__file__).resolve().parents[1] / "nuke_gizmo"
GIZMO = (FOLDER / "MSSPLFuse.gizmo").read_text(encoding="utf-8")
SOURCES = sorted(FOLDER.glob("*.py"))

needs_tcl = pytest.mark.skipif(not tcl_interpreters(), reason="no Tcl here: neither tkinter nor tclsh")
posix = pytest.mark.skipif(sys.platform == "win32", reason="ends a POSIX process group")


@pytest.fixture(scope="module")
def nodes():
    if not tcl_interpreters():
        pytest.skip("no Tcl here: neither tkinter nor tclsh")
    return read_script(GIZMO, tcl_interpreters()[0])


def scripts(nodes):
    return {knob.name: knob.options["T"] for knob in nodes[1].user_knobs if knob.kind == 22}


# ---------------------------------------------------------------------------------------------- the gizmo's Tcl


@needs_tcl
def test_every_tcl_interpreter_reads_the_same_gizmo():
    results = [read_script(GIZMO, interpreter) for interpreter in tcl_interpreters()]
    assert all(result == results[0] for result in results)


def test_inputs_come_in_order_and_the_hrls_is_passed_on(nodes):
    assert [node.kind for node in nodes.values()] == ["Gizmo", "Input", "Input", "Output"]
    assert {node.parent for node in list(nodes.values())[1:]} == {1}
    inputs = sorted((int(n.knobs.get("number", 0)), n.knobs["name"]) for n in nodes.values() if n.kind == "Input")
    assert inputs == [(0, "LRHS"), (1, "HRLS")]
    (connected,) = nodes[4].inputs
    assert nodes[connected].knobs["name"] == "HRLS"


def test_knobs_their_kinds_and_defaults(nodes):
    gizmo = nodes[1]
    kinds = {k.name: k.kind for k in gizmo.user_knobs if k.name}
    text, file, number, menu, tick, tab, button, lines = 1, 2, 3, 4, 6, 20, 22, 43
    assert kinds == {
        **{"msspl": tab, "output": file, "model": text, "device": menu, "mapping": lines, "layers": text},
        **{"overwrite": tick, "fuse_frame": button, "first": number, "last": number, "fuse_range": button},
        **{"setup": tab, "program": file, "options": text},
    }
    assert {name: gizmo.knobs[name] for name in kinds if name in gizmo.knobs} == {
        "overwrite": "true",
        "first": "{root.first_frame}",
        "last": "{root.last_frame}",
    }
    assert all("t" in k.options for k in gizmo.user_knobs if k.kind not in (tab, 26)), "a knob without a tooltip"
    assert "LRHS" in gizmo.knobs["help"]


def test_devices_are_those_of_the_program(nodes):
    from oiio_msspl.model.session import PROVIDERS

    device = next(k for k in nodes[1].user_knobs if k.name == "device")
    assert device.items == list(PROVIDERS)


# ---------------------------------------------------------------------------------------------- the Python in it


def test_everything_is_python_3_9_and_the_standard_library(nodes):
    texts = {path.name: path.read_text(encoding="utf-8") for path in SOURCES} | scripts(nodes)
    allowed = sys.stdlib_module_names | {"nuke", "msspl_bridge", "msspl_nuke"}
    for name, text in texts.items():
        for statement in ast.walk(ast.parse(text, name, feature_version=(3, 9))):
            if isinstance(statement, ast.Import):
                assert {alias.name for alias in statement.names} <= allowed, name
            elif isinstance(statement, ast.ImportFrom):
                assert str(statement.module).partition(".")[0] in allowed, name
    assert "nuke" not in {
        a.name for n in ast.walk(ast.parse(texts["msspl_bridge.py"])) for a in getattr(n, "names", ())
    }


def test_types_agree_with_types_nuke(nodes, tmp_path):
    """The module and every button, against the stubs of Nuke's API; what has no such name is found."""
    api = pytest.importorskip("mypy.api")
    buttons = "import nuke\n"
    for name, text in scripts(nodes).items():
        buttons += f"\n\ndef {name}() -> None:\n" + "".join(f"    {line}\n" for line in text.splitlines())
    (tmp_path / "buttons.py").write_text(buttons)
    (tmp_path / "wrong.py").write_text("import nuke\n\n\nnuke.mesage('')\nnuke.thisNode().nam()\n")
    # The oldest Python that mypy still knows. A cache of its own, because the project's is for another Python.
    options = ["--python-version", "3.10", "--disallow-untyped-defs", f"--cache-dir={FOLDER.parent}/.mypy_cache/nuke"]
    out, err, _ = api.run([*options, *map(str, SOURCES), *(str(tmp_path / f"{n}.py") for n in ("buttons", "wrong"))])
    assert not err
    errors = [line for line in out.splitlines() if ": error:" in line]
    assert len(errors) == 2, out
    assert all("wrong.py" in line and "attr-defined" in line for line in errors), out


def test_the_fake_host_has_nothing_that_nuke_has_not():
    """Every public name of the fake, and its parameters, are in types-nuke."""
    stubs = importlib.util.find_spec("nuke-stubs")
    if stubs is None or not stubs.submodule_search_locations:
        pytest.skip("types-nuke is not installed")
    folder = Path(stubs.submodule_search_locations[0])
    classes, functions = {}, {}
    for path in folder.glob("*.pyi"):
        for item in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(item, ast.ClassDef):
                classes[item.name] = {m.name: m for m in item.body if isinstance(m, ast.FunctionDef)}
                classes[item.name][""] = [b.id for b in item.bases if isinstance(b, ast.Name)]
            elif isinstance(item, ast.FunctionDef):
                functions[item.name] = item

    def real(name, method):
        found = classes.get(name, {}).get(method)
        return found or next(filter(None, (real(base, method) for base in classes.get(name, {}).get("", ()))), None)

    def accepts(stub, fake):
        names = {a.arg for a in [*stub.args.args, *stub.args.kwonlyargs]}
        return bool(stub.args.vararg) or {a.arg for a in fake.args.args} <= names

    for item in ast.parse(Path(fake_nuke.__file__).read_text(encoding="utf-8")).body:
        if not isinstance(item, ast.ClassDef) or item.name in ("UserKnob", "ScriptNode"):
            continue
        for method in (m for m in item.body if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")):
            if item.name == "FakeNuke":
                if method.name in ("nodes_of", "add", "press", "wait"):
                    continue
                method.args.args = method.args.args[1:]
                stub = functions.get(method.name)
            else:
                stub = real(item.name, method.name)
            assert stub is not None, f"{item.name}.{method.name}"
            assert method.name == "metadata" or accepts(stub, method), f"{item.name}.{method.name}"


# ---------------------------------------------------------------------------------------------- the bridge


@pytest.fixture
def bridge():
    return importlib.import_module("msspl_bridge")


@pytest.mark.parametrize(
    ("pattern", "path", "number", "back"),
    [
        ("/a/hr.%04d.exr", "/a/hr.1001.exr", 1001, "/a/hr.%04d.exr"),
        ("/a/hr.####.exr", "/a/hr.0007.exr", 7, "/a/hr.%04d.exr"),
        ("/a/hr_%d.exr", "/a/hr_12.exr", 12, "/a/hr_%01d.exr"),
        ("/a/hr-%04d.exr", "/a/hr-0101.exr", 101, "/a/hr-%04d.exr"),
        ("/a/hr.%04d.exr", "/a/hr.-003.exr", -3, "/a/hr.%04d.exr"),
        ("/a/v2%04d.exr", "/a/v20001.exr", 1, "/a/v2%04d.exr"),
        ("/%V/hr.%v.%04d.exr", "/left/hr.l.0001.exr", 1, "/left/hr.l.%04d.exr"),
        ("/a/still.exr", "/a/still.exr", None, "/a/still.exr"),
    ],
)
def test_the_number_is_found_where_the_pattern_has_it(bridge, pattern, path, number, back):
    clip = bridge.find_clip(pattern, path)
    assert (clip.number, clip.path, clip.pattern) == (number, path, back)


def test_a_file_that_is_no_frame_of_the_pattern_is_refused(bridge):
    with pytest.raises(bridge.Problem, match=r"^/a/proxy\.1\.exr: is not a frame of /a/hr"):
        bridge.find_clip("/a/hr.%04d.exr", "/a/proxy.1.exr")


def test_the_output_is_named_after_the_hrls_or_as_the_artist_says(bridge):
    hr = bridge.find_clip("/a/hr.%04d.exr", "/a/hr.1001.exr")
    still = bridge.Clip("/a/hr.exr")
    assert bridge.name_output("", hr, 1).path == "/a/hr_fused.1001.exr"
    assert bridge.name_output("", still, 1).path == "/a/hr_fused.exr"
    assert bridge.name_output("/b/out_##.exr", hr, 1).path == "/b/out_1001.exr"
    assert bridge.name_output("/b/out_##.exr", still, 1).path == "/b/out_01.exr"
    assert bridge.name_output("/b/out.exr", hr, 1).path == "/b/out.exr"
    with pytest.raises(bridge.Problem, match=r"output out\.exr: is not a full path"):
        bridge.name_output("out.exr", hr, 1)


def test_the_command_says_what_the_knobs_say(bridge):
    clips = [bridge.Clip(f"/a/{name}.", 1001, 4, ".exr") for name in ("lr", "hr", "out")]
    settings = bridge.Settings(
        model="paper-x4",
        device="cuda",
        mapping="\nalbedo = my albedo\ndiffuse=lighting+GI\n",
        layers="crypto*, depth",
        options="--hr-spp 4 --view-layer 'left eye'",
    )
    one = bridge.build_command("msspl-fuse", *clips, settings)
    assert one[:5] == ["msspl-fuse", "/a/lr.1001.exr", "/a/hr.1001.exr", "-o", "/a/out.1001.exr"]
    assert " ".join(one[5:]) == (
        "--device cuda --layout nuke --no-preview --model paper-x4 --map albedo=my albedo --map diffuse=lighting+GI "
        "--layers crypto* --layers depth --overwrite --hr-spp 4 --view-layer left eye"
    )
    many = bridge.build_command("msspl-fuse", *clips, bridge.Settings(overwrite=False), (1001, 1010))
    assert many[1:5] == ["/a/lr.%04d.exr", "/a/hr.%04d.exr", "-o", "/a/out.%04d.exr"]
    assert " ".join(many[5:]) == (
        "--device cpu --frames 1001-1010 --progress openjd --layout nuke --no-preview --skip-existing"
    )


@pytest.mark.parametrize(
    ("knobs", "sentence"),
    [
        ({"mapping": "albedo"}, "mapping 'albedo': write a line a feature"),
        ({"mapping": "=x"}, "mapping '=x': write a line a feature"),
        ({"options": "--view 'left"}, "No closing quotation"),
    ],
)
def test_a_knob_that_makes_no_sense_is_named(bridge, knobs, sentence):
    clip = bridge.Clip("/a.exr")
    with pytest.raises(bridge.Problem, match=re.escape(sentence)):
        bridge.build_command("msspl-fuse", clip, clip, clip, bridge.Settings(**knobs))


def test_backslashes_of_windows_survive_the_options(bridge, monkeypatch):
    monkeypatch.setattr(os, "sep", "\\")
    clip = bridge.Clip("/a.exr")
    settings = bridge.Settings(options=r'--map-file C:\maps\a.toml --report "C:\my reports\r.json"')
    command = bridge.build_command("msspl-fuse", clip, clip, clip, settings)
    assert command[-4:] == ["--map-file", "C:/maps/a.toml", "--report", "C:/my reports/r.json"]


@posix
def test_the_program_is_the_chosen_one_then_the_environments_then_the_paths(bridge, tmp_path):
    def program(name):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
        return str(path)

    on_path, other, chosen = program("bin/msspl-fuse"), program("other"), program("chosen one")
    environment = {"PATH": str(tmp_path / "bin")}
    assert bridge.find_program("", environment) == on_path
    assert bridge.find_program("", {**environment, "MSSPL_FUSE": other}) == other
    assert bridge.find_program(chosen, {**environment, "MSSPL_FUSE": other}) == chosen
    with pytest.raises(bridge.Problem, match="the program knob says /nowhere, which is no program here"):
        bridge.find_program("/nowhere", environment)
    with pytest.raises(bridge.Problem, match=r"msspl-fuse was not found; install oiio_msspl, .* MSSPL_FUSE"):
        bridge.find_program("", {"PATH": str(tmp_path / "empty")})


def test_what_the_host_sets_for_its_own_python_does_not_reach_the_program(bridge, tmp_path):
    """A Python that inherits these does not start; with the cleaned environment it does. The site's paths stay."""
    host = tmp_path / "Nuke15.1v1"
    (host / "lib").mkdir(parents=True)
    (host / "json.py").write_text("raise SystemExit('the host-s json')\n")
    theirs = os.pathsep.join([str(host), str(host / "lib"), "/opt/cuda/lib", f"{host}-tools"])
    environment = {
        **os.environ,
        "PYTHONHOME": str(host),
        "PYTHONPATH": str(host),
        "LD_LIBRARY_PATH": theirs,
        "SHOT": "é",
    }
    command = [sys.executable, "-c", "import json, os; print(os.environ['SHOT'])"]
    assert subprocess.run(command, env=environment, capture_output=True).returncode != 0
    clean = bridge.clean_environment(environment, str(host))
    done = subprocess.run(command, env=clean, capture_output=True, encoding="utf-8")
    assert (done.returncode, done.stdout.strip()) == (0, "é"), done.stderr
    assert clean["LD_LIBRARY_PATH"] == os.pathsep.join(["/opt/cuda/lib", f"{host}-tools"])
    assert "LD_LIBRARY_PATH" not in bridge.clean_environment({"LD_LIBRARY_PATH": str(host)}, str(host))


def test_lines_of_the_program_are_understood(bridge):
    assert bridge.parse_line("openjd_progress: 33.3\n") == ("openjd_progress", "33.3")
    assert bridge.parse_line("openjd_status: frame 7 fused, 1 of 3 done") == (
        "openjd_status",
        "frame 7 fused, 1 of 3 done",
    )
    assert bridge.parse_line("openjd_fail: frame 8: x")[0] == "openjd_fail"
    assert bridge.parse_line("error: hr.exr: is broken") == ("error", "hr.exr: is broken")
    assert bridge.parse_line("albedo    found    albedo") == ("", "albedo    found    albedo")


def ignore(*_):
    return False


def test_a_program_that_fails_says_why_once(bridge):
    def run(code):
        return bridge.run([sys.executable, "-c", code], os.environ, ignore, ignore)

    both = "import sys; print('openjd_fail: frame 1: no'); print('error: frame 1: no', file=sys.stderr); sys.exit(2)"
    with pytest.raises(bridge.Problem, match=r"^frame 1: no$"):
        run(both)
    with pytest.raises(bridge.Problem, match=r"^frame 1: no \(2 more frames failed\)$"):
        run("[print(f'openjd_fail: frame {n}: no') for n in (1, 2, 3)]; raise SystemExit(1)")
    with pytest.raises(bridge.Problem, match=r"^ended strangely$"):
        run("print('ended strangely'); raise SystemExit(3)")
    with pytest.raises(bridge.Problem, match=r"^msspl-fuse ended with exit code 3$"):
        run("raise SystemExit(3)")
    with pytest.raises(bridge.Problem, match=r"^/nowhere: can't be started"):
        bridge.run(["/nowhere"], os.environ, ignore, ignore)
    assert run("print('warning: dark')") == ["dark"]


@posix
def test_cancel_ends_the_program_and_what_it_started(bridge, tmp_path):
    """The whole process group: a program that has children leaves none behind."""
    marker = tmp_path / "child"
    child = f"import os, time; open({str(marker)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    start = time.monotonic()
    with pytest.raises(bridge.Cancelled):
        bridge.run(
            [sys.executable, "-c", code], os.environ, ignore, lambda: marker.exists() and marker.read_text() != ""
        )
    assert time.monotonic() - start < 30
    pid = int(marker.read_text())
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{pid}/stat").exists() and Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z":
            return  # ended; whoever runs the tests has not noticed yet
        time.sleep(0.05)
    pytest.fail("the child lives on")


# ---------------------------------------------------------------------------------------------- the buttons


@pytest.fixture
def host(nodes, monkeypatch, tmp_path):
    """Nuke with a gizmo whose inputs are Reads of the example pair, frames 1001 to 1003 of a shot."""
    nuke = FakeNuke(nodes)
    monkeypatch.setitem(sys.modules, "nuke", nuke)
    monkeypatch.delitem(sys.modules, "msspl_nuke", raising=False)
    program = find_msspl_fuse()
    assert program, "install the package: pip install -e '.[test]'"
    monkeypatch.setenv("MSSPL_FUSE", program)
    # As in Nuke: another Python's variables.
    monkeypatch.setenv("PYTHONHOME", "/opt/Nuke15.1v1")
    monkeypatch.setenv("PYTHONPATH", "/opt/Nuke15.1v1")
    for name in ("lr", "hr"):
        for frame in (1001, 1002, 1003):
            shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / f"{name}.{frame}.exr")
    nuke.gizmo = nuke.createNode("MSSPLFuse")
    nuke.gizmo.setXYpos(40, 200)
    nuke.reads = [nuke.nodes.Read(str(tmp_path / f"{name}.%04d.exr"), 1001, 1003) for name in ("lr", "hr")]
    for index, read in enumerate(nuke.reads):
        nuke.gizmo.setInput(index, read)
    nuke.frame_number = 1002
    yield nuke
    nuke.wait()
    sys.modules.pop("msspl_nuke", None)


def results(nuke):
    return [n for n in nuke.everything if n.Class() == "Read" and n not in nuke.reads]


def test_a_frame_is_fused_and_comes_back_as_a_read(host, tmp_path):
    host.gizmo["mapping"].setValue("albedo=ViewLayer.Denoising Albedo")
    host.gizmo["layers"].setValue("*Crypto*")
    host.reads[1]["colorspace"].setValue("scene_linear")
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    assert host.messages == []
    (read,) = results(host)
    assert read["file"].value() == str(tmp_path / "hr_fused.%04d.exr")
    assert [read[k].value() for k in ("first", "last", "frame")] == [1002, 1002, ""]
    assert read["colorspace"].value() == "scene_linear"
    assert (read.xpos(), read.ypos()) == (40, 300)
    out = tmp_path / "hr_fused.1002.exr"
    assert read.metadata("input/filename", 1002) == str(out)
    from oiio_msspl.exr.reader import open_exr

    names = [part.name for part in open_exr(out).parts]
    assert len(names) == 2
    assert "Crypto" in names[1]
    assert host.gizmo.name() not in importlib.import_module("msspl_nuke")._running


def test_frame_0_is_a_frame(host, tmp_path):
    for read, name in zip(host.reads, ("lr", "hr"), strict=True):
        shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / f"{name}.0000.exr")
        read["first"].setValue(0)
    host.frame_number = 0
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    assert host.messages == []
    assert [results(host)[0][k].value() for k in ("first", "last", "origfirst", "origlast")] == [0] * 4


def test_a_second_frame_updates_the_same_read(host):
    for frame in (1002, 1001):
        host.frame_number = frame
        host.press(host.gizmo, "fuse_frame")
        host.wait()
    (read,) = results(host)
    assert [read[k].value() for k in ("first", "last")] == [1001, 1002]
    assert read["reload"].presses == 1
    read["file"].setValue("/elsewhere.%04d.exr")  # the artist uses the Read for something else: it is ours again
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    assert [results(host)[0][k].value() for k in ("first", "last")] == [1001, 1001]


def test_a_range_shows_progress_and_comes_back_as_a_read(host, tmp_path):
    host.gizmo["first"].setValue(1001)
    host.gizmo["last"].setValue(1003)
    host.gizmo["output"].setValue(str(tmp_path / "out" / "f.%04d.exr"))
    host.press(host.gizmo, "fuse_range")
    host.wait()
    assert host.messages == []
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"f.{n}.exr" for n in (1001, 1002, 1003)]
    (read,) = results(host)
    assert [read[k].value() for k in ("first", "last", "origfirst", "origlast")] == [1001, 1003] * 2
    (task,) = host.ProgressTask.made
    assert task.progress == [33, 66, 100]
    assert any("3 of 3" in message for message in task.messages)


def test_frame_modes_are_followed(host, tmp_path):
    """Reads shifted in time: files are the ones that Nuke reads, and the result stands where the HRLS stands."""
    for read in host.reads:
        read["frame"].setValue("frame+1000")
    host.gizmo["first"].setValue(2)
    host.gizmo["last"].setValue(3)
    host.press(host.gizmo, "fuse_range")
    host.wait()
    assert host.messages == []
    assert sorted(p.name for p in tmp_path.glob("hr_fused*")) == ["hr_fused.1002.exr", "hr_fused.1003.exr"]
    (read,) = results(host)
    assert read["frame"].value() == "frame+1000"
    assert read.metadata("input/filename", 3) == str(tmp_path / "hr_fused.1003.exr")


def test_reads_are_found_through_dots_alone(host):
    nuke = host
    dot = nuke.add(fake_nuke.Node("Dot", "Dot1", inputs=1))
    dot.setInput(0, nuke.reads[0])
    nuke.gizmo.setInput(0, dot)
    module = importlib.import_module("msspl_nuke")
    assert module._find_read(nuke.gizmo, 0, "LRHS") is nuke.reads[0]
    grade = nuke.add(fake_nuke.Node("Grade", "Grade1", inputs=1))
    grade.setInput(0, nuke.reads[1])
    nuke.gizmo.setInput(1, grade)
    nuke.press(nuke.gizmo, "fuse_frame")
    nuke.gizmo.setInput(1, None)
    nuke.press(nuke.gizmo, "fuse_frame")
    assert nuke.messages == [
        "MSSPLFuse1: HRLS comes from Grade1 (Grade), but files are fused; connect the Read itself, or write this out "
        "as EXR and read that",
        "MSSPLFuse1: nothing is connected to HRLS; connect the Read of that render",
    ]


def test_mistakes_come_as_one_sentence_before_anything_runs(host, tmp_path):
    def pressed(button="fuse_frame", **knobs):
        before = {name: host.gizmo[name].value() for name in knobs}
        for name, value in knobs.items():
            host.gizmo[name].setValue(value)
        host.press(host.gizmo, button)
        for name, value in before.items():
            host.gizmo[name].setValue(value)
        (message,) = host.messages
        host.messages.clear()
        return message.removeprefix("MSSPLFuse1: ")

    assert pressed(program="/nowhere").startswith("the program knob says /nowhere, which is no program here")
    assert pressed(mapping="albedo").startswith("mapping 'albedo': write a line a feature")
    assert pressed("fuse_range", first=5, last=4).startswith("the range 5 to 4 is empty")
    assert pressed("fuse_range", first=1001, last=1005).startswith(
        "Read1 does not have one numbered file a frame from 1001 to 1005"
    )
    one_file = str(tmp_path / "out.exr")
    assert "a range needs a number in it" in pressed("fuse_range", first=1001, last=1003, output=one_file)
    host.reads[0]["frame"].setValue("frame-1")
    assert "for a range both need the same numbers" in pressed("fuse_range", first=1002, last=1003)
    host.root()["proxy"].setValue(True)
    assert pressed().startswith("proxy mode is on; turn it off")
    host.root()["proxy"].setValue(False)
    for path in tmp_path.glob("lr.*"):
        path.unlink()
    assert pressed() == "Read1 has no file at frame 1002; go to a frame that is rendered"
    assert results(host) == host.ProgressTask.made == []


def test_what_the_program_refuses_comes_as_one_sentence(host, tmp_path):
    (tmp_path / "lr.1002.exr").write_bytes(b"not an EXR")
    host.press(host.gizmo, "fuse_frame")
    host.wait()
    (message,) = host.messages
    assert message.startswith(f"MSSPLFuse1: {tmp_path}/lr.1002.exr: ")
    assert "\n" not in message
    assert results(host) == []


def test_a_range_with_a_bad_frame_keeps_the_others(host, tmp_path):
    (tmp_path / "lr.1002.exr").write_bytes(b"not an EXR")
    host.gizmo["first"].setValue(1001)
    host.gizmo["last"].setValue(1003)
    host.press(host.gizmo, "fuse_range")
    host.wait()
    (message,) = host.messages
    assert message.startswith("MSSPLFuse1: frame 1002: ")
    assert sorted(p.name for p in tmp_path.glob("hr_fused*")) == ["hr_fused.1001.exr", "hr_fused.1003.exr"]
    assert len(results(host)) == 1


def test_cancel_stops_between_frames_and_leaves_nothing_half_written(host, tmp_path):
    for read, name in zip(host.reads, ("lr", "hr"), strict=True):
        read["last"].setValue(1020)
        for frame in range(1004, 1021):
            shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / f"{name}.{frame}.exr")
    host.gizmo["first"].setValue(1001)
    host.gizmo["last"].setValue(1020)
    host.ProgressTask.cancel_at = "1 of 20"
    host.press(host.gizmo, "fuse_range")
    host.wait()
    assert host.messages == []
    written = sorted(p.name for p in tmp_path.iterdir() if "fused" in p.name)
    assert 1 <= len(written) < 20
    assert written == [f"hr_fused.{1001 + i}.exr" for i in range(len(written))]
    assert len(results(host)) == 1


def test_a_node_fuses_one_thing_at_a_time_and_may_be_deleted_meanwhile(host, tmp_path):
    host.press(host.gizmo, "fuse_frame")
    host.press(host.gizmo, "fuse_frame")
    assert host.messages == ["MSSPLFuse1: is still fusing; wait, or cancel it in the progress window"]
    host.delete(host.gizmo)
    host.wait()
    assert host.messages[1:] == [f"MSSPLFuse1 is gone; its result is {tmp_path}/hr_fused.%04d.exr"]


# ---------------------------------------------------------------------------------------------- menu, groups, files


def test_the_menu_makes_the_node_and_the_group(host):
    exec((FOLDER / "init.py").read_text(encoding="utf-8"), {})
    exec((FOLDER / "menu.py").read_text(encoding="utf-8"), {})
    entries = host.menu("Nodes").entries["MSSPL"].entries
    assert list(entries) == ["MSSPLFuse", "Copy to group"]
    entries["MSSPLFuse"]()
    assert host.everything[-1].name() == "MSSPLFuse2"
    entries["Copy to group"]()
    assert host.messages == ["Select an MSSPLFuse gizmo; groups are copied already."]


def test_copy_to_group_keeps_name_knobs_and_connections_and_its_buttons_work(host, tmp_path):
    viewer = host.add(fake_nuke.Node("Viewer", "Viewer1", inputs=1))
    viewer.setInput(0, host.gizmo)
    host.gizmo["layers"].setValue("none")
    host.selected = [host.gizmo]
    importlib.import_module("msspl_nuke").copy_to_group()
    group = viewer.input(0)
    assert (group.Class(), group.name(), group["layers"].value()) == ("Group", "MSSPLFuse1", "none")
    assert [group.input(i) for i in range(2)] == host.reads
    assert (group.xpos(), group.ypos()) == (40, 200)
    assert host.gizmo not in host.everything
    host.press(group, "fuse_frame")
    host.wait()
    assert (host.messages, len(results(host))) == ([], 1)


def test_a_group_on_a_farm_without_the_module_says_so(host, monkeypatch):
    monkeypatch.setitem(sys.modules, "msspl_nuke", None)
    for button in ("fuse_frame", "fuse_range"):
        host.press(host.gizmo, button)
    assert (
        host.messages
        == ["The buttons need the folder nuke_gizmo of oiio_msspl on the plug-in path (msspl nuke-install)."] * 2
    )


@pytest.fixture
def install(tmp_path):
    def run(*arguments):
        home = {**os.environ, "HOME": str(tmp_path), "USERPROFILE": str(tmp_path)}
        code = "from msspl_cli.app import msspl; msspl()"
        command = [sys.executable, "-c", code, "nuke-install", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, env=home)

    return run


def test_nuke_install_adds_one_line_that_works_and_takes_it_out_again(install, tmp_path, monkeypatch):
    init = tmp_path / ".nuke" / "init.py"
    init.parent.mkdir()
    theirs = b"import nuke\r\nnuke.knobDefault('Blur.size', '10')  # theirs, no newline at the end"
    init.write_bytes(theirs)
    for _ in range(2):
        assert install().returncode == 0
    lines = init.read_bytes().splitlines()
    assert b"\r\n".join(lines[:2]) == theirs
    assert len(lines) == 3

    added = []
    fake = type(sys)("nuke")
    fake.pluginAddPath, fake.knobDefault = added.append, lambda *_: None
    monkeypatch.setitem(sys.modules, "nuke", fake)
    monkeypatch.delenv("MSSPL_FUSE", raising=False)
    exec(init.read_text(), {})
    assert Path(added[0], "MSSPLFuse.gizmo").is_file()
    program = os.environ.pop("MSSPL_FUSE", None)
    assert program is None or Path(program).is_file()

    assert "taken out" in install("--uninstall").stdout
    assert init.read_bytes() == theirs + b"\r\n"
    assert "no line of ours" in install("--uninstall").stdout


def test_nuke_install_into_another_folder(install, tmp_path):
    assert install("--dir", tmp_path / "site").returncode == 0
    assert "pluginAddPath" in (tmp_path / "site" / "init.py").read_text()
    done = install("--dir", tmp_path / "not" / "there")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {tmp_path}/not/there: there is no folder {tmp_path}/not")
    assert not any(t.name.startswith("msspl-fuse for") for t in threading.enumerate())
