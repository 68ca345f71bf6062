# SPDX-License-Identifier: Apache-2.0
"""Running msspl-fuse, with small Python programs in its place."""

import os
import sys
import time
from pathlib import Path

import pytest
from msspl_bridge import process
from msspl_bridge.errors import Cancelled, FuseError
from msspl_bridge.process import parse_line


def test_lines_are_split_into_kind_and_text():
    assert parse_line("openjd_progress: 33.3\n") == ("openjd_progress", "33.3")
    assert parse_line("openjd_status: frame 7 fused, 1 of 3 done") == (
        "openjd_status",
        "frame 7 fused, 1 of 3 done",
    )
    assert parse_line("openjd_fail: frame 8: x")[0] == "openjd_fail"
    assert parse_line("error: hr.exr: is broken") == ("error", "hr.exr: is broken")
    assert parse_line("albedo    found    albedo") == ("", "albedo    found    albedo")


def ignore(*_):
    """Ignore a report, or answer that nobody has cancelled."""
    return False


def test_a_failure_is_told_once_in_the_programs_own_words():
    def run(code):
        return process.run([sys.executable, "-c", code], os.environ, ignore, ignore)

    both = "import sys; print('openjd_fail: frame 1: no'); print('error: frame 1: no', file=sys.stderr); sys.exit(2)"
    with pytest.raises(FuseError, match=r"^frame 1: no$"):
        run(both)
    with pytest.raises(FuseError, match=r"^frame 1: no \(2 more frames failed\)$"):
        run("[print(f'openjd_fail: frame {n}: no') for n in (1, 2, 3)]; raise SystemExit(1)")
    with pytest.raises(FuseError, match=r"^ended strangely$"):
        run("print('ended strangely'); raise SystemExit(3)")
    with pytest.raises(FuseError, match=r"^msspl-fuse ended with exit code 3$"):
        run("raise SystemExit(3)")
    with pytest.raises(FuseError, match=r"^/nowhere: can't be started"):
        process.run(["/nowhere"], os.environ, ignore, ignore)
    assert run("print('warning: dark')") == ["dark"]


@pytest.mark.skipif(sys.platform == "win32", reason="ends a POSIX process group")
def test_cancelling_ends_the_program_and_its_children(tmp_path):
    marker = tmp_path / "child"
    child = f"import os, time; open({str(marker)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    start = time.monotonic()
    with pytest.raises(Cancelled):
        process.run(
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
            return  # It has ended, and its new parent has not yet reaped it.
        time.sleep(0.05)
    pytest.fail("the child still runs")
