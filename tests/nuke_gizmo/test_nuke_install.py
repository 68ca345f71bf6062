# SPDX-License-Identifier: Apache-2.0
"""``msspl nuke-install``: one line in Nuke's init.py puts the gizmo on the plug-in path."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture
def install(tmp_path):
    def run(*arguments):
        home = {**os.environ, "HOME": str(tmp_path), "USERPROFILE": str(tmp_path)}
        code = "from msspl_cli.app import msspl; msspl()"
        command = [sys.executable, "-c", code, "nuke-install", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, env=home)

    return run


def test_one_working_line_is_added_and_taken_out_again(install, tmp_path, monkeypatch):
    init = tmp_path / ".nuke" / "init.py"
    init.parent.mkdir()
    theirs = b"import nuke\r\nnuke.knobDefault('Blur.size', '10')  # the user's line, without a newline at the end"
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


def test_another_folder_gets_the_line_and_a_missing_one_is_refused(install, tmp_path):
    (tmp_path / "site").mkdir()
    assert install("--dir", tmp_path / "site").returncode == 0
    assert "pluginAddPath" in (tmp_path / "site" / "init.py").read_text()
    done = install("--dir", tmp_path / "typo")
    assert done.returncode == 2 and not (tmp_path / "typo").exists()
    assert done.stderr.startswith(f"error: {tmp_path}/typo: no such folder; make it, or name another one with --dir")
    assert install().returncode == 0  # Nuke's own folder is made
