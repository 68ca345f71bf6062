# SPDX-License-Identifier: Apache-2.0
"""Between a compositor and msspl-fuse: file names, command line, environment, the process. Knows nothing of Nuke.

Standard library only, Python 3.9 syntax: it runs in the compositor's own Python.
"""

from __future__ import annotations

import contextlib
import os
import posixpath
import queue
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

_NUMBER = re.compile(r"%(0?)(\d*)d|#+")
_VIEW = re.compile(r"%[vV]")
#: What a program's own Python must not inherit from the Python inside the compositor.
_PYTHON_VARIABLES = ("PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "PYTHONPLATLIBDIR", "__PYVENV_LAUNCHER__")
_LIBRARY_PATHS = (
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "DYLD_LIBRARY_PATH",
    "DYLD_FRAMEWORK_PATH",
    "DYLD_INSERT_LIBRARIES",
)
_MESSAGE = re.compile(r"(openjd_progress|openjd_status|openjd_fail|error|warning): (.*)")
#: Seconds that a cancelled msspl-fuse gets to remove its temporary file.
_GRACE = 10


class Problem(Exception):
    """One sentence for the artist: what is wrong, and what to do."""


class Cancelled(Exception):
    """The artist pressed cancel."""


# ---------------------------------------------------------------------------------------------- file names


@dataclass(frozen=True)
class Clip:
    """A file of a numbered sequence, or a still."""

    head: str
    """Path up to the number; the whole path of a still."""
    number: int | None = None
    """None for a still."""
    digits: int = 0
    tail: str = ""

    @property
    def path(self) -> str:
        return self.head if self.number is None else f"{self.head}{self.number:0{self.digits}d}{self.tail}"

    @property
    def pattern(self) -> str:
        """The sequence, as both Nuke and msspl-fuse write it: ``/shot/hr.%04d.exr``."""
        return self.head if self.number is None else f"{self.head}%0{self.digits}d{self.tail}"


def find_clip(pattern: str, path: str) -> Clip:
    """Where the frame number stands in a file that was found through a pattern (``%04d``, ``####``; ``%V`` for views).

    Raises:
        Problem: the file does not look like the pattern.
    """
    path = _slashes(path)
    folder, name = posixpath.split(path)
    expected = posixpath.basename(_slashes(pattern))
    tokens = list(_NUMBER.finditer(expected))
    if not tokens:
        return Clip(path)
    token = tokens[-1]
    head, tail = (_any_view(part) for part in (expected[: token.start()], expected[token.end() :]))
    match = re.fullmatch(f"({head})(-?[0-9]+)({tail})", name)
    if not match:
        raise Problem(f"{path}: is not a frame of {pattern}; name the files that way, or give the Read another pattern")
    return Clip(posixpath.join(folder, match[1]), int(match[2]), _digits(token), match[3])


def name_output(text: str, hr: Clip, frame: int) -> Clip:
    """The file to write. Without ``text`` it lies beside the HRLS, with ``_fused`` in its name.

    Its number is the HRLS's, or the frame if the HRLS is a still.

    Raises:
        Problem: it is a relative path, which means another folder for every program.
    """
    if not text:
        if hr.number is None:
            return Clip("_fused".join(posixpath.splitext(hr.head)))
        plain = hr.head.rstrip("._-")
        return replace(hr, head=f"{plain}_fused{hr.head[len(plain) :]}")
    if not os.path.isabs(text):
        raise Problem(f"output {text}: is not a full path; begin it with the folder that the frames go to")
    folder, name = posixpath.split(_slashes(text))
    tokens = list(_NUMBER.finditer(name))
    if not tokens:
        return Clip(_slashes(text))
    token, number = tokens[-1], frame if hr.number is None else hr.number
    return Clip(posixpath.join(folder, name[: token.start()]), number, _digits(token), name[token.end() :])


def _slashes(path: str) -> str:
    """A backslash means something else in Nuke's Tcl."""
    return path.replace(os.sep, "/")


def _any_view(text: str) -> str:
    return ".+?".join(re.escape(part) for part in _VIEW.split(text))


def _digits(token: re.Match[str]) -> int:
    return len(token[0]) if token[0].startswith("#") else int(token[2] or 1)


# ---------------------------------------------------------------------------------------------- the command


@dataclass(frozen=True)
class Settings:
    """What the knobs say, as text."""

    model: str = ""
    device: str = "cpu"
    mapping: str = ""
    """A line a feature: ``albedo=my_albedo``."""
    layers: str = ""
    """Patterns with commas between them."""
    options: str = ""
    """Further options, as in a shell."""
    overwrite: bool = True


def build_command(
    program: str, lr: Clip, hr: Clip, out: Clip, settings: Settings, span: tuple[int, int] | None = None
) -> list[str]:
    """The command line for one frame, or for all numbers of a span (first, last).

    Raises:
        Problem: a knob can't be understood.
    """
    files = [c.path if span is None else c.pattern for c in (lr, hr, out)]
    command = [program, files[0], files[1], "-o", files[2], "--device", settings.device]
    if span is not None:
        command += ["--frames", f"{span[0]}-{span[1]}", "--progress", "openjd"]
    # A part a layer, the layer in the part's name, is what Nuke itself writes.
    command += ["--layout", "nuke", "--no-preview"]
    if settings.model:
        command += ["--model", settings.model]
    for line in filter(None, map(str.strip, settings.mapping.splitlines())):
        feature, equals, layer = line.partition("=")
        if not (feature.strip() and equals and layer.strip()):
            raise Problem(f"mapping {line!r}: write a line a feature, such as albedo=my_albedo")
        command += ["--map", f"{feature.strip()}={layer.strip()}"]
    for pattern in filter(None, map(str.strip, settings.layers.split(","))):
        command += ["--layers", pattern]
    if settings.overwrite:
        command.append("--overwrite")
    elif span is not None:
        command.append("--skip-existing")
    try:
        return command + shlex.split(_slashes(settings.options))  # as of paths, or a shell's rules would eat them
    except ValueError as error:
        raise Problem(f"options {settings.options!r}: {error}; write them as in a shell") from error


def find_program(chosen: str, environment: Mapping[str, str]) -> str:
    """Path of msspl-fuse: what was chosen, else ``MSSPL_FUSE``, else the one on ``PATH``.

    Raises:
        Problem: there is none.
    """
    search = environment.get("PATH")
    for source, value in (("the program knob", chosen), ("MSSPL_FUSE", environment.get("MSSPL_FUSE", ""))):
        if value:
            found = shutil.which(os.path.expanduser(value), path=search)
            if found is None:
                raise Problem(f"{source} says {value}, which is no program here; give the path of msspl-fuse")
            return found
    found = shutil.which("msspl-fuse", path=search)
    if found is None:
        raise Problem(
            "msspl-fuse was not found; install oiio_msspl, and put the program's path into the program knob or the "
            "environment variable MSSPL_FUSE"
        )
    return found


def clean_environment(environment: Mapping[str, str], host_folder: str) -> dict[str, str]:
    """The environment without what the host set for its own Python and libraries, which would break another's.

    Libraries outside the host's folder stay: drivers and the site's own may be found through them.
    """
    clean = {key: value for key, value in environment.items() if key not in _PYTHON_VARIABLES}
    folder = os.path.join(os.path.realpath(host_folder), "")
    for key in _LIBRARY_PATHS:
        if key in clean:
            paths = clean.pop(key).split(os.pathsep)
            kept = [p for p in paths if p and not os.path.join(os.path.realpath(p), "").startswith(folder)]
            if kept:
                clean[key] = os.pathsep.join(kept)
    # The process speaks UTF-8 on every platform, and says what it does when it does it.
    return {**clean, "PYTHONUTF8": "1", "PYTHONUNBUFFERED": "1"}


# ---------------------------------------------------------------------------------------------- the process


def run(
    command: list[str],
    environment: Mapping[str, str],
    report: Callable[[int | None, str | None], None],
    cancelled: Callable[[], bool],
) -> list[str]:
    """Run msspl-fuse to its end, from any thread but the host's main one.

    Args:
        report: called with (percent, None) or (None, what is being done).
        cancelled: asked ten times a second; the process and its children are ended when it says so.

    Returns:
        Warnings, one sentence each.

    Raises:
        Problem: it failed; the message is what it said.
        Cancelled: what was finished before stays on disk, nothing is half-written.
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
        raise Problem(f"{command[0]}: can't be started ({error.strerror}); is it msspl-fuse?") from error
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
            elif kind and text not in errors:  # a failure is told to people and to farms, in the same words
                errors.append(text)
        code = process.wait()
    finally:
        if process.poll() is None:
            _end(process)
    if code:
        # A range goes on after a bad frame: the first says what went wrong.
        more = f" ({len(errors) - 1} more frames failed)" if len(errors) > 1 else ""
        raise Problem((errors[0] if errors else last or f"msspl-fuse ended with exit code {code}") + more)
    return warnings


def parse_line(line: str) -> tuple[str, str]:
    """A line of output as (kind, text); the kind of what is only talk is ""."""
    match = _MESSAGE.fullmatch(line.strip())
    return (match[1], match[2].strip()) if match else ("", line.strip())


def _read_lines(process: subprocess.Popen[str], lines: queue.Queue[str | None]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line)
    lines.put(None)


def _own_group() -> dict[str, Any]:
    """A process group of its own, so that cancel ends what msspl-fuse starts as well; no console window."""
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
