# SPDX-License-Identifier: Apache-2.0
"""The command line of msspl-fuse and its environment."""

import os
import re
import subprocess
import sys

import pytest
from msspl_bridge import FuseError
from msspl_bridge.command import Settings, build_command, clean_environment, find_program
from msspl_bridge.frame_files import FrameFile


def test_every_knob_reaches_the_command_line():
    *renders, out = (FrameFile(f"/a/{name}.%04d.exr", 1001) for name in ("lr", "hr", "out"))
    settings = Settings(
        model="paper-x4",
        device="cuda",
        mapping="\nalbedo = my albedo\ndiffuse=lighting+GI\n",
        layers="crypto*, depth",
        passes="light groups",
        temporal="off",
        options="--hr-spp 4 --view-layer 'left eye'",
    )
    still = FrameFile("/a/out.exr")
    one = build_command("msspl-fuse", [*renders, still], settings)
    assert one[:5] == ["msspl-fuse", "/a/lr.1001.exr", "/a/hr.1001.exr", "-o", "/a/out.exr"]
    assert " ".join(one[5:]) == (
        "--overwrite --model paper-x4 --device cuda --layout nuke --no-preview --map albedo=my albedo "
        "--map diffuse=lighting+GI --layers crypto* --layers depth --passes light groups --hr-spp 4 --view-layer "
        "left eye"
    )
    many = build_command(
        "msspl-fuse", [*renders, out], Settings(quality="best", overwrite=False, temporal="3"), (1001, 1010)
    )
    assert many[1:5] == ["/a/lr.%04d.exr", "/a/hr.%04d.exr", "-o", "/a/out.%04d.exr"]
    assert " ".join(many[5:]) == (
        "--frames 1001-1010 --temporal 3 --progress json --skip-existing --quality best --device cpu --layout nuke "
        "--no-preview"
    )
    assert build_command("msspl-fuse", [renders[1], out], Settings())[1:4] == [
        "/a/hr.%04d.exr",
        "-o",
        "/a/out.%04d.exr",
    ]


def test_a_frame_gets_its_neighbours_if_its_files_are_numbered_alike():
    """Otherwise msspl-fuse could not find the neighbours, and the frame is fused by itself."""
    lrhs, hrls, out = (FrameFile(f"/a/{name}.%04d.exr", 1001) for name in ("lr", "hr", "out"))

    def command(*files, **settings):
        return build_command("msspl-fuse", files, Settings(**settings))

    in_shot = command(lrhs, hrls, out, overwrite=False)
    assert in_shot[1:5] == ["/a/lr.%04d.exr", "/a/hr.%04d.exr", "-o", "/a/out.%04d.exr"]
    assert in_shot[in_shot.index("--frames") :][:4] == ["--frames", "1001", "--temporal", "auto"]
    assert "--skip-existing" not in in_shot  # an existing frame is refused, as one that is fused by itself
    still, other = FrameFile("/a/still.exr"), FrameFile("/a/lr.%04d.exr", 5)
    for alone in (
        command(other, hrls, out),
        command(still, hrls, out),
        command(lrhs, hrls, still),
        command(still, still, still, temporal="2"),
        command(still, still),
    ):
        assert not {"--frames", "--temporal", "--progress"} & {*alone}
        assert "%" not in "".join(alone)


@pytest.mark.parametrize(
    ("knobs", "sentence"),
    [
        ({"mapping": "albedo"}, "mapping 'albedo': write one feature=layer per line"),
        ({"mapping": "=x"}, "mapping '=x': write one feature=layer per line"),
        ({"options": "--view 'left"}, "No closing quotation"),
    ],
)
def test_a_knob_that_cannot_be_parsed_is_named(knobs, sentence):
    file = FrameFile("/a.exr")
    with pytest.raises(FuseError, match=re.escape(sentence)):
        build_command("msspl-fuse", [file, file], Settings(**knobs))


def test_windows_paths_survive_in_the_options(monkeypatch):
    monkeypatch.setattr(os, "sep", "\\")
    file = FrameFile("/a.exr")
    settings = Settings(options=r'--map-file C:\maps\a.toml --report "C:\my reports\r.json"')
    command = build_command("msspl-fuse", [file, file], settings)
    assert command[-4:] == ["--map-file", "C:/maps/a.toml", "--report", "C:/my reports/r.json"]


def test_a_job_has_the_options_of_the_range(tmp_path):
    fuse, msspl = tmp_path / "msspl-fuse", tmp_path / "msspl"
    files = [FrameFile(f"/a/{name}.%04d.exr", 1001) for name in ("hr", "out")]
    with pytest.raises(FuseError, match=r"there is no msspl beside .*msspl-fuse"):
        build_command(str(fuse), files, Settings(), (1001, 1010), "/job")
    msspl.touch(0o755)
    command = build_command(str(fuse), files, Settings(chunk="20"), (1001, 1010), "/job")
    assert command[:3] == [str(msspl), "submit", "/a/hr.%04d.exr"]
    assert " ".join(command[3:]) == (
        "-o /a/out.%04d.exr --frames 1001-1010 --temporal auto --bundle /job --chunk 20 --update --quality balanced "
        "--device cpu --layout nuke --no-preview"
    )


@pytest.mark.skipif(sys.platform == "win32", reason="the programs are shell scripts")
def test_the_program_knob_wins_over_the_variable_and_the_variable_over_path(tmp_path):
    def program(name):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
        return str(path)

    on_path, other, chosen = program("bin/msspl-fuse"), program("other"), program("chosen one")
    environment = {"PATH": str(tmp_path / "bin")}
    assert find_program("", environment) == on_path
    assert find_program("", {**environment, "MSSPL_FUSE": other}) == other
    assert find_program(chosen, {**environment, "MSSPL_FUSE": other}) == chosen
    with pytest.raises(FuseError, match="the program knob names /nowhere, but there is no such program"):
        find_program("/nowhere", environment)
    with pytest.raises(FuseError, match=r"msspl-fuse was not found; install oiio_msspl, .* MSSPL_FUSE"):
        find_program("", {"PATH": str(tmp_path / "empty")})


def test_the_hosts_python_variables_do_not_reach_the_program(tmp_path):
    """A Python with these variables fails; with the cleaned environment it runs. The site's library paths stay."""
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
    clean = clean_environment(environment, str(host))
    done = subprocess.run(command, env=clean, capture_output=True, encoding="utf-8")
    assert (done.returncode, done.stdout.strip()) == (0, "é"), done.stderr
    assert clean["LD_LIBRARY_PATH"] == os.pathsep.join(["/opt/cuda/lib", f"{host}-tools"])
    assert "LD_LIBRARY_PATH" not in clean_environment({"LD_LIBRARY_PATH": str(host)}, str(host))
