# SPDX-License-Identifier: Apache-2.0
"""Finds Blender, starts it with the add-on's headless.py, and reads what that prints."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from msspl_cli.extension import find_extension
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import temporary_folder

#: The line that Blender prints while it renders.
_SAMPLES = re.compile(r"Sample (\d+)/(\d+)")
#: The message of a Python that is too old for bpy, or that lacks the module.
_NO_BPY = re.compile(r"unknown option:? -P|No module named 'bpy'", re.IGNORECASE)
#: The advice about another program than Blender.
_NAME_ANOTHER = "name Blender, or a Python that has bpy, with --blender or MSSPL_BLENDER"
#: Seconds that Blender gets to end.
_GRACE = 15
_POSIX = os.name == "posix"


def find_blender(named: str | None) -> str:
    """Find Blender, or a Python that has bpy: as named, or by MSSPL_BLENDER, or ``blender`` on the path."""
    for where, name in (("--blender", named), ("MSSPL_BLENDER", os.environ.get("MSSPL_BLENDER")), ("", "blender")):
        program = shutil.which(os.path.expanduser(name)) if name else None
        if program is not None:
            return program
        if name and where:
            raise InputError(f"{where} {name}: no such program")
    raise InputError("blender is not on the path; name it with --blender or MSSPL_BLENDER")


def render_frames(
    program: str,
    scene: Path,
    job: dict[str, Any],
    folder: Path,
    on_event: Callable[[dict[str, Any]], None],
    fuse: Callable[[Path, Path], None],
    *,
    verbose: bool = False,
) -> None:
    """Let Blender render the frames of a job, and fuse each in this process, where the model stays loaded.

    Args:
        job: the frames and the settings that headless.py reads.
        folder: the folder of the results. The renders lie in it, so that a render that is kept is only renamed.
        on_event: called with each event: a step that begins, the fraction of samples that is done, or the report of a
            frame that ended.
        fuse: called with the files of both renders of each frame, or twice that of its only render. Its errors name
            the frame.
        verbose: pass on the messages of Blender.

    Raises:
        InputError, MssplError: a frame failed. The message names it if the job has several.
    """
    count, reports, number = sum(output is not None for _, output in job["frames"]), 0, None

    def fuse_next(lr: Path, hr: Path) -> None:
        nonlocal number
        number = None
        fuse(lr, hr)

    with temporary_folder(folder) as work:
        path = Path(work, "job.json")
        path.write_text(json.dumps({**job, "work": work}), encoding="utf-8")
        try:
            for event in run_blender(command(program, scene, path), fuse_next, verbose=verbose):
                number = event.get("frame", number)
                if "report" in event:
                    reports += 1
                    number = None
                on_event(event)
        except MssplError as error:
            if number is None or count == 1:
                raise
            raise type(error)(f"frame {number}: {error}") from error
    if reports < count:
        raise MssplError(f"{program}: ended after {reports} of {count} frames (-v shows what it says)")


def command(program: str, scene: Path, job: Path) -> list[str]:
    """Return the arguments that make Blender, or a Python that has bpy, do the job of a file."""
    script = str(find_extension() / "headless.py")
    if Path(program).name.lower().startswith("python"):
        return [program, "-P", script, str(job)]  # -P: modules beside the script must not hide others
    return [program, "--background", str(scene.absolute()), "--python", script, "--", str(job)]


def run_blender(
    arguments: Sequence[str], fuse: Callable[[Path, Path], None], *, verbose: bool = False
) -> Iterator[dict[str, Any]]:
    """Run the add-on's headless.py. Leaving the loop ends Blender and every process that it started.

    Yields:
        The events that headless.py prints, and ``{"samples": fraction}`` for each line about samples.

    Raises:
        InputError, MssplError: the job failed. The message is that of headless.py.
        Exception: an error of ``fuse``, once Blender has ended.
    """
    last: deque[str] = deque(maxlen=5)
    error: dict[str, Any] | None = None
    with _start(arguments) as process:
        assert process.stdin is not None and process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith("MSSPL "):
                    event = json.loads(line.removeprefix("MSSPL "))
                    if "error" in event:
                        error = event
                    elif "fuse" in event:
                        _fuse(process, event["fuse"], fuse)
                    else:
                        yield event
                    continue
                if verbose:
                    print(line, end="", file=sys.stderr)
                if samples := _SAMPLES.search(line):
                    yield {"samples": int(samples[1]) / max(1, int(samples[2]))}
                elif line.strip():
                    last.append(line.strip())
            process.wait()
        finally:
            if process.poll() is None:
                _end(process)
            with contextlib.suppress(BrokenPipeError):  # leaving the `with` would write what Blender has not read
                process.stdin.close()
    if error is not None:
        raise (InputError if error["code"] == 2 else MssplError)(error["error"])
    if process.returncode:
        said = " | ".join(last)
        if _NO_BPY.search(said):
            raise InputError(f"{arguments[0]}: this Python has no module bpy; {_NAME_ANOTHER}")
        raise MssplError(f"{arguments[0]}: ended with code {process.returncode}" + (f": {said}" if said else ""))


def _start(arguments: Sequence[str]) -> subprocess.Popen[str]:
    """Start a process in a group of its own, which can be ended as a whole."""
    try:
        return subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=_POSIX,
        )
    except OSError as refused:
        raise InputError(f"{arguments[0]}: can't be started ({refused.strerror}); {_NAME_ANOTHER}") from refused


def _fuse(process: subprocess.Popen[str], files: Sequence[str], fuse: Callable[[Path, Path], None]) -> None:
    """Fuse a frame, and tell Blender to go on. An error lets Blender end by itself, because its input ends."""
    assert process.stdin is not None and process.stdout is not None
    try:
        fuse(Path(files[0]), Path(files[-1]))
    except Exception:
        process.stdin.close()
        process.stdout.read()
        process.wait()
        raise
    with contextlib.suppress(BrokenPipeError):  # Blender has ended; its exit code says why
        print("fused", file=process.stdin, flush=True)


def _end(process: subprocess.Popen[str]) -> None:
    """End a process and its group: first with SIGTERM, then with SIGKILL."""
    for end in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
        if _POSIX:
            os.killpg(process.pid, end)
        else:
            process.send_signal(end)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE)
            return
