# SPDX-License-Identifier: Apache-2.0
"""msspl inspect, as a process."""

import json

import numpy as np
import pytest

from tests.conftest import SHARED, needs_shared, picture, rgb, write_exr
from tests.programs import run


def test_inspect_tells_a_person_and_a_machine(files):
    done = run("msspl", "inspect", files / "hr.exr")
    assert done.returncode == 0
    assert "display window 128x96+0+0" in done.stdout
    assert "passed through: Z, mask" in done.stdout
    data = json.loads(run("msspl", "inspect", files / "hr.exr", "--json").stdout)
    assert data["usable"]
    assert data["parts"][0]["channels"]["mask.X"] == "half"


def test_inspect_explains_what_cannot_be_used(files):
    write_exr(files / "black.exr", rgb(np.zeros((8, 8, 3), np.float32)) | rgb(picture(8, 8), "albedo."))
    done = run("msspl", "inspect", files / "black.exr")
    assert done.returncode == 2
    assert "can't be used: the beauty is black everywhere, though albedo are not" in done.stdout


@needs_shared("exr")
@pytest.mark.parametrize("path", sorted(SHARED.glob("exr/**/*.exr")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_inspect_handles_every_real_file(path):
    """Usable with a mapped beauty, or explained in a sentence: never a traceback."""
    done = run("msspl", "inspect", path, "--json")
    data = json.loads(done.stdout)
    assert done.stderr == ""
    assert done.returncode == (0 if data["usable"] else 2)
    assert data["usable"] == (not data["problems"])
    unusable = {
        "crypto_only",
        "deep",
        "ALBEDO",
        "AVG_SHADING_NORMAL",
        "DEPTH",
        "DIRECT_DIFFUSE",
        "INDIRECT_GLOSSY",
        "NOISE",
    }
    # Of the V-Ray file only the headers are there.
    unusable |= {"rgba_z_crypto_diffuse_normals"}
    assert data["usable"] == (path.stem not in unusable), data["problems"]
