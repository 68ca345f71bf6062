# SPDX-License-Identifier: Apache-2.0
"""Runs programs one after another, reads their progress and their messages, and cancels them."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from msspl_bridge import FuseError

#: The box that the command line draws around a mistake in the options.
_BOX = " \u2502\n"
#: Seconds that a cancelled msspl-fuse has to remove its temporary file.
_GRACE = 10


@dataclass
class Outcome:
    """What the programs said."""

    written: list[int] = field(default_factory=list)
    """Numbers of the frames that are there: fused, or skipped because they existed."""
    notes: list[str] = field(default_factory=list)
    """How frames are averaged, and warnings: a sentence each."""
    error: str = ""
    """The first failure, which shows the cause; empty if there is none."""
    finished: bool = False
    """Whether all programs ended without a failure."""
    last: str = ""
    """The last line with a word."""
    counts: Counter[str] = field(default_factory=Counter)
    """How many frames ended in which way."""

    def hear(self, line: str) -> dict[str, Any] | None:
        """Take in a line of output. Return what msspl-fuse says of a frame that ended."""
        kind, _, text = line.strip().partition(": ")
        if kind == "warning":
            self.notes.append(text)
        elif kind == "error":
            self.error = self.error or text
        elif line.startswith('{"found"'):  # before the first frame
            how = json.loads(line)["temporal"]
            self.notes += [f"fuses {how}"] if how else []
        elif line.startswith('{"frame"'):
            frame: dict[str, Any] = json.loads(line)
            self.counts[frame["status"]] += 1
            self.written += [] if frame["message"] else [frame["frame"]]
            return frame
        elif re.search(r"\w", line):
            self.last = line.strip(_BOX)
        return None


def run(commands: Sequence[list[str]], environment: Mapping[str, str], window: Any) -> Outcome:
    """Run programs one after another until they end. This blocks, so call it from a thread of its own.

    A program that fails without any frame ends the row.

    Args:
        window: a ProgressTask of Nuke. It is asked ten times a second whether the artist cancelled. Then the program
            and its children are ended: finished frames stay on disk, and no file is half-written.

    Raises:
        FuseError: a program can't be started.
    """
    outcome, code = Outcome(), 0
    for index, command in enumerate(commands):
        process = _start(command, environment)
        try:
            for line in _lines(process, window):
                if frame := outcome.hear(line):
                    done, count = frame["done"], frame["count"]
                    window.setProgress(100 * (index * count + done) // (len(commands) * count))
                    window.setMessage(f"frame {frame['frame']} {frame['status']}, {done} of {count} done")
            if window.isCancelled():
                return outcome
            code = process.wait() or code
        finally:
            if process.poll() is None:
                _end(process)
        if code and not outcome.written:
            break
    if code:
        bad = outcome.counts["failed"] + outcome.counts["missing"]
        more = f" ({bad - 1} more failed)" if bad > 1 else ""
        outcome.error = (outcome.error or outcome.last or f"{command[0]} ended with exit code {code}") + more
    outcome.finished = not code
    return outcome


def _start(command: list[str], environment: Mapping[str, str]) -> subprocess.Popen[str]:
    # In a new process group, so that cancelling also ends the children of msspl-fuse; without a console window.
    group: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    try:
        return subprocess.Popen(
            command,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            **group,
        )
    except OSError as error:
        raise FuseError(f"{command[0]}: can't be started ({error.strerror}); check the path") from error


def _lines(process: subprocess.Popen[str], window: Any) -> Iterator[str]:
    """Yield the lines of output, until the artist cancels."""
    lines: queue.Queue[str | None] = queue.Queue()
    threading.Thread(target=_read_lines, args=(process, lines), daemon=True).start()
    while not window.isCancelled():
        with contextlib.suppress(queue.Empty):
            line = lines.get(timeout=0.1)
            if line is None:
                return
            yield line


def _read_lines(process: subprocess.Popen[str], lines: queue.Queue[str | None]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line)
    lines.put(None)


def _end(process: subprocess.Popen[str]) -> None:
    if sys.platform == "win32":
        subprocess.call(["taskkill", "/F", "/T", "/PID", str(process.pid)], stdout=subprocess.DEVNULL)
    else:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGTERM)
            try:
                process.wait(_GRACE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
    process.wait()
