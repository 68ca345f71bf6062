# SPDX-License-Identifier: Apache-2.0
"""What all programs have in common: --help, and that they are installed."""

import shutil
import subprocess
import sys

import pytest


@pytest.mark.parametrize("program", ["msspl_fuse", "msspl_render", "msspl"])
def test_help_imports_nothing_heavy_and_ends_with_examples(program):
    """--help stays quick because NumPy, OpenImageIO and onnxruntime are not imported for it."""
    code = (
        f"import sys; from msspl_cli.app import {program} as main\n"
        "sys.argv[1:] = ['--help']\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print('HEAVY', [m for m in ('numpy', 'OpenImageIO', 'onnxruntime', 'torch', 'OpenEXR') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.endswith("HEAVY []\n"), done.stdout[-300:] + done.stderr
    if program == "msspl_fuse":
        assert "msspl-fuse lr.exr hr.exr -o out.exr" in done.stdout


def test_installed_programs_are_on_the_path():
    assert shutil.which("msspl-fuse"), "install the package: pip install -e '.[test]'"
    assert shutil.which("msspl")
