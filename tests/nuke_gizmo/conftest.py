# SPDX-License-Identifier: Apache-2.0
"""The gizmo's files, read once."""

from pathlib import Path

import pytest

from tests.nuke_gizmo.gizmo_file import read_script, tcl_interpreters

FOLDER = Path(__file__).resolve().parents[2] / "nuke_gizmo"
GIZMO = (FOLDER / "MSSPLFuse.gizmo").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def nodes():
    """{number: node} of the gizmo's file, as a real Tcl interpreter reads it."""
    if not tcl_interpreters():
        pytest.skip("no Tcl interpreter: neither tkinter nor tclsh")
    return read_script(GIZMO, tcl_interpreters()[0])


@pytest.fixture(scope="session")
def button_scripts(nodes):
    """{knob: Python script} of the gizmo's buttons."""
    return {knob.name: knob.options["T"] for knob in nodes[1].user_knobs if knob.kind == 22}
