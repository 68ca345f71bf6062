# SPDX-License-Identifier: Apache-2.0
"""The gizmo's files, read once, and a Nuke that has the gizmo."""

import shutil
import sys
from pathlib import Path

import pytest
from msspl_cli.commands.nuke_install import find_msspl_fuse

from tests.conftest import EXAMPLES
from tests.nuke_gizmo.fake_nuke import FakeNuke
from tests.nuke_gizmo.gizmo_file import read_script, tcl_interpreters

FOLDER = Path(__file__).resolve().parents[2] / "nuke_gizmo"
GIZMO = (FOLDER / "MSSPLFuse.gizmo").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def nodes():
    """Return {number: node} of the gizmo's file, as a real Tcl interpreter reads it."""
    if not tcl_interpreters():
        pytest.skip("no Tcl interpreter: neither tkinter nor tclsh")
    return read_script(GIZMO, tcl_interpreters()[0])


@pytest.fixture(scope="session")
def button_scripts(nodes):
    """{knob: Python script} of the gizmo's buttons."""
    return {knob.name: knob.options["T"] for knob in nodes[1].user_knobs if knob.kind == 22}


@pytest.fixture
def host(nodes, monkeypatch, tmp_path):
    """Set up the fake Nuke with a gizmo and two Reads of frames 1001 to 1003, which are copies of the example pair."""
    nuke = FakeNuke(nodes)
    monkeypatch.setitem(sys.modules, "nuke", nuke)
    monkeypatch.delitem(sys.modules, "msspl_nuke", raising=False)
    program = find_msspl_fuse()
    assert program, "install the package: pip install -e '.[test]'"
    monkeypatch.setenv("MSSPL_FUSE", program)
    # Nuke sets such variables for its own Python.
    monkeypatch.setenv("PYTHONHOME", "/opt/Nuke15.1v1")
    monkeypatch.setenv("PYTHONPATH", "/opt/Nuke15.1v1")
    for name in ("lr", "hr"):
        for frame in (1001, 1002, 1003):
            shutil.copy(EXAMPLES / f"{name}.exr", tmp_path / f"{name}.{frame}.exr")
    nuke.gizmo = nuke.createNode("MSSPLFuse")
    nuke.gizmo.setXYpos(40, 200)
    nuke.gizmo["temporal"].setValue("off")  # neighbours take longer, and have a test of their own
    nuke.reads = [nuke.nodes.Read(str(tmp_path / f"{name}.%04d.exr"), 1001, 1003) for name in ("lr", "hr")]
    for index, read in enumerate(reversed(nuke.reads)):  # the HRLS is input 0
        nuke.gizmo.setInput(index, read)
    nuke.frame_number = 1002
    yield nuke
    nuke.wait()
    sys.modules.pop("msspl_nuke", None)
