# SPDX-License-Identifier: Apache-2.0
"""Running msspl-fuse, with small Python programs in its place."""

import json
import os
import re
import sys
import time
from pathlib import Path

import pytest
from msspl_bridge import FuseError, process
from msspl_bridge.command import clean_environment
from msspl_cli.commands.nuke_install import find_msspl_fuse


class Window:
    """A ProgressTask, which is cancelled when ``cancel`` says so."""

    def __init__(self, cancel=lambda: False):
        self.isCancelled, self.shown = cancel, []
        self.setProgress = self.setMessage = self.shown.append


def run(*programs, window=None):
    return process.run([[sys.executable, "-c", code] for code in programs], os.environ, window or Window())


def frame(number, done, status="fused", message=""):
    line = {"frame": number, "status": status, "message": message, "done": done, "count": 3}
    return f"print({json.dumps(line)!r});"


def test_frames_warnings_and_progress_are_heard():
    window = Window()
    begin = json.dumps({"found": None, "temporal": "frame by frame: no motion"})
    first = f"print({begin!r}); print('warning: dark');" + frame(7, 1) + frame(8, 2, "skipped")
    outcome = run(first, frame(9, 3), window=window)
    assert window.shown == [
        *(16, "frame 7 fused, 1 of 3 done"),
        *(33, "frame 8 skipped, 2 of 3 done"),
        *(100, "frame 9 fused, 3 of 3 done"),
    ]
    assert (outcome.written, outcome.counts) == ([7, 8, 9], {"fused": 2, "skipped": 1})
    assert outcome.notes == ["fuses frame by frame: no motion", "dark"]
    assert (outcome.finished, outcome.error) == (True, "")


def test_a_failure_is_told_once_in_the_programs_own_words():
    def error(code):
        outcome = run(code)
        assert not outcome.finished
        return outcome.error

    bad = "".join(frame(n, n, "failed", "no") for n in (1, 2, 3))
    assert error("print('error: frame 1: no');" + bad + "exit(2)") == "frame 1: no (2 more failed)"
    assert error("print('ended strangely'); exit(3)") == "ended strangely"
    assert error("exit(3)").endswith("ended with exit code 3")
    with pytest.raises(FuseError, match=r"^/nowhere: can't be started"):
        process.run([["/nowhere"]], os.environ, Window())


def test_a_wrong_option_is_told_without_the_box_around_it():
    environment = clean_environment(os.environ, "/opt/Nuke")
    outcome = process.run([[find_msspl_fuse(), "--nope"]], environment, Window())
    assert re.fullmatch(r"No such option(: --nope| '--nope'\.).*", outcome.error)
    many = [find_msspl_fuse(), "a.exr", "-o", "b.exr", f"--{'x' * 200}"]  # more than a line of a terminal
    outcome = process.run([many], environment, Window())
    assert re.fullmatch(r"No such option(: --x{200}| '--x{200}'\.)", outcome.error)


def test_the_row_ends_with_a_program_that_fails_without_any_frame():
    assert run("exit(2)", frame(1, 1)).written == []
    assert run(frame(1, 1) + "exit(2)", frame(2, 1)).written == [1, 2]


@pytest.mark.skipif(sys.platform == "win32", reason="ends a POSIX process group")
def test_cancelling_ends_the_program_and_its_children(tmp_path):
    marker = tmp_path / "child"
    child = f"import os, time; open({str(marker)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    start = time.monotonic()
    outcome = run(code, code, window=Window(lambda: marker.exists() and marker.read_text() != ""))
    assert (outcome.finished, outcome.error) == (False, "")
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
