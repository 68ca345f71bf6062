# SPDX-License-Identifier: Apache-2.0
"""What all programs have in common: --help, and that they are installed."""

import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import sysconfig

import pytest

from oiio_msspl import __version__
from tests.programs import run


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no such setting")
def test_memory_of_large_arrays_is_kept_for_the_next_ones():
    """Otherwise the system clears all of their pages again."""
    code = (
        "import resource, msspl_cli\n"
        "faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "bytearray(64 << 20)\n"
        "before = faults()\n"
        "for _ in range(4): bytearray(64 << 20)\n"
        "print(faults() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 100


def test_installed_programs_are_on_the_path():
    for program in ("msspl-fuse", "msspl-render", "msspl"):
        assert shutil.which(program, path=sysconfig.get_path("scripts")), (
            "install the package: pip install -e '.[test]'"
        )


#: Options that --help shows, and how many more --help-all shows.
SHOWN = {
    "msspl_fuse": (
        "--map --view-layer --quality --device --max-memory --output --layout --layers --passes --error-layer "
        "--overwrite --json --frames --temporal --skip-existing --help --help-all --version",
        24,
    ),
    "msspl_render": (
        "--view-layer --max-memory --blender --renders --scale --lr-spp --hr-spp --components --quality --device "
        "--output --layout --passes --error-layer --overwrite --json --frames --temporal --skip-existing "
        "--help --help-all --version",
        11,
    ),
}


def options_in(text):
    """Return the long names that begin a row of the help text. Of a pair (--half, --float) only the first counts."""
    return set(re.findall(r"^│[ *]+(--[a-z-]+)", text, re.MULTILINE))


@pytest.mark.parametrize("program", SHOWN)
def test_help_shows_everyday_options_in_groups_and_help_all_shows_all(program):
    expected, more = SHOWN[program]
    short, full = (run(program, option).stdout for option in ("--help", "--help-all"))
    assert options_in(short) == set(expected.split())
    assert options_in(full) > options_in(short)
    assert len(options_in(full)) == len(options_in(short)) + more
    groups = [line.split()[1] for line in full.splitlines() if line.startswith("╭")]
    assert groups == [line.split()[1] for line in short.splitlines() if line.startswith("╭")]
    assert [group for group in groups if group != "Render"] == [
        "Arguments",
        "Options",
        "Input",
        "Model",
        "Output",
        "Shot",
    ]


@pytest.mark.parametrize("program", SHOWN)
def test_programs_tell_their_version(program):
    done = run(program, "--version")
    assert (done.returncode, done.stdout) == (0, f"{__version__}\n")


def test_submit_has_the_options_of_msspl_fuse_that_a_job_can_have():
    fuse, submit = (
        options_in(run(program, *command, "--help-all").stdout)
        for program, command in (("msspl_fuse", ()), ("msspl", ("submit",)))
    )
    assert fuse - submit == {"--overwrite", "--json", "--report", "--progress", "--scheduler"}
    assert submit - fuse == {"--bundle", "--chunk", "--command", "--conda", "--name", "--rez", "--timeout"}


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_full_disk_behind_standard_output_is_told():
    code = "import sys; from msspl_cli.app import msspl as main; sys.argv[0] = 'msspl'; main()"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code, "models"], stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: standard output or a temporary file: can't be written (")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs SIGHUP")
def test_a_signal_that_nohup_ignores_stays_ignored():
    code = (
        "import signal; from msspl_cli.errors import _exit_on_signals\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN); signal.signal(signal.SIGTERM, signal.SIG_DFL)\n"
        "_exit_on_signals()\n"
        "assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN and callable(signal.getsignal(signal.SIGTERM))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
