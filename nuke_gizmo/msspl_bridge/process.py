# SPDX-License-Identifier: Apache-2.0
"""Runs msspl-fuse, reads its progress and its messages, and cancels it."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

from msspl_bridge.errors import Cancelled, FuseError

_MESSAGE = re.compile(r"(openjd_progress|openjd_status|openjd_fail|error|warning): (.*)")
#: Seconds that a cancelled msspl-fuse has to remove its temporary file.
_GRACE = 10


def run(
    command: list[str],
    environment: Mapping[str, str],
    report: Callable[[int | None, str | None], None],
    cancelled: Callable[[], bool],
) -> list[str]:
    """Run msspl-fuse until it ends. This blocks, so call it from a thread of its own.

    Args:
        report: called with (percent, None) or with (None, the current step).
        cancelled: asked ten times a second. When it returns True, the process and its children are ended.

    Returns:
        Warnings, one sentence each.

    Raises:
        FuseError: msspl-fuse failed. The message is its own.
        Cancelled: finished frames stay on disk, and no file is half-written.
    """
    try:
        process = subprocess.Popen(
            command,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            **_own_group(),
        )
    except OSError as error:
        raise FuseError(f"{command[0]}: can't be started ({error.strerror}); check that it is msspl-fuse") from error
    lines: queue.Queue[str | None] = queue.Queue()
    threading.Thread(target=_read_lines, args=(process, lines), daemon=True).start()
    warnings, errors, last = [], [], ""
    try:
        while True:
            if cancelled():
                raise Cancelled
            try:
                line = lines.get(timeout=0.1)
            except queue.Empty:
                continue
            if line is None:
                break
            kind, text = parse_line(line)
            last = text or last
            if kind == "openjd_progress":
                with contextlib.suppress(ValueError):
                    report(int(float(text)), None)
            elif kind == "openjd_status":
                report(None, text)
            elif kind == "warning":
                warnings.append(text)
            elif kind and text not in errors:  # "openjd_fail" and "error" both carry the text of one failure
                errors.append(text)
        code = process.wait()
    finally:
        if process.poll() is None:
            _end(process)
    if code:
        # msspl-fuse goes on with a range after a bad frame. The first failure shows the cause.
        more = f" ({len(errors) - 1} more frames failed)" if len(errors) > 1 else ""
        raise FuseError((errors[0] if errors else last or f"msspl-fuse ended with exit code {code}") + more)
    return warnings


def parse_line(line: str) -> tuple[str, str]:
    """Split a line of msspl-fuse's output into (kind, text). The kind is "" for a line that is only information."""
    match = _MESSAGE.fullmatch(line.strip())
    return (match[1], match[2].strip()) if match else ("", line.strip())


def _read_lines(process: subprocess.Popen[str], lines: queue.Queue[str | None]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line)
    lines.put(None)


def _own_group() -> dict[str, Any]:
    """Start a new process group, so that cancelling also ends the children of msspl-fuse. Open no console window."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    return {"start_new_session": True}


def _end(process: subprocess.Popen[str]) -> None:
    if sys.platform == "win32":
        subprocess.call(["taskkill", "/F", "/T", "/PID", str(process.pid)], stdout=subprocess.DEVNULL)
        process.wait()
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()
