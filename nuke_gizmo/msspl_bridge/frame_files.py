# SPDX-License-Identifier: Apache-2.0
"""Reads file names of numbered frames: finds number and view, names the output, and checks a range."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from msspl_bridge import FuseError

#: The last frame number in the name of a pattern: ``%04d`` or ``####``.
_NUMBER = re.compile(r"(?:%(\d*)d|#+)(?!.*(?:%\d*d|#))(?=[^/]*$)")
_VIEW = re.compile(r"%[vV]")


@dataclass(frozen=True)
class FrameFile:
    """The file of one frame of a numbered sequence, or a still. ``%V`` and ``%v`` stand for the view."""

    pattern: str
    """The name of the whole sequence, such as ``/shot/hr.%04d.exr``. Nuke and msspl-fuse both read this form."""
    number: int | None = None
    """None for a still, whose pattern is its path."""

    @property
    def path(self) -> str:
        if self.number is None:
            return self.pattern
        return _NUMBER.sub(lambda token: f"{self.number:0{int(token[1])}d}", self.pattern)

    def in_view(self, view: str) -> FrameFile:
        """Return the file of a view: ``%V`` is its name, ``%v`` its first letter."""
        return replace(self, pattern=self.pattern.replace("%V", view).replace("%v", view[:1]))


@dataclass(frozen=True)
class ReadRange:
    """The files that a Read node reads at the first and at the last frame of a range."""

    read: str
    """Name of the node, for messages."""
    first: FrameFile
    last: FrameFile


def find_number(pattern: str, path: str) -> FrameFile:
    """Find the frame number in the path of a frame.

    Args:
        pattern: the file knob of the Read, with ``%04d`` or ``####`` for the number. If it has ``%V`` or ``%v`` for the
            view, the result has it, too.
        path: the file that Nuke found through the pattern.
    """
    pattern, path = with_slashes(pattern), with_slashes(path)
    folder, name = posixpath.split(pattern)
    stereo = bool(_VIEW.search(pattern))
    token = _NUMBER.search(name)
    if token is None:
        return FrameFile(pattern if stereo else path)
    around = name[: token.start()], name[token.end() :]
    before, after = (".+?".join(map(re.escape, _VIEW.split(part))) for part in around)  # of any view
    match = re.fullmatch(f"{before}(-?[0-9]+){after}", posixpath.basename(path))
    if not match:
        raise FuseError(f"{path}: does not match the pattern {pattern}; rename the file, or correct the Read's file")
    return FrameFile(posixpath.join(folder if stereo else posixpath.dirname(path), _with_width(name)), int(match[1]))


def parse_range(text: str) -> range:
    """Return the frames of ``1001-1100``, or of ``1001``."""
    match = re.fullmatch(r"(-?\d+)(?:-(-?\d+))?", text)
    frames = range(int(match[1]), int(match[2] or match[1]) + 1) if match else range(0)
    if not frames:
        raise FuseError(f"range {text!r}: write the first and the last frame, such as 1001-1100, or leave it empty")
    return frames


def name_output(text: str, hrls: FrameFile, frame: int) -> FrameFile:
    """Name the file to write.

    Args:
        text: the output knob. If it is empty, the output goes beside the HRLS, with ``_fused`` added to the name.
        hrls: the HRLS, whose number becomes the output's number.
        frame: the output's number if the HRLS is a still.
    """
    if not text:
        if hrls.number is None:
            return FrameFile("_fused".join(posixpath.splitext(hrls.pattern)))
        return replace(hrls, pattern=re.sub(r"(?=[._-]*%\d+d[^/]*$)", "_fused", hrls.pattern, count=1))
    if not os.path.isabs(text):
        raise FuseError(f"output {text}: is a relative path; give the full path, folder included")
    pattern = _with_width(with_slashes(text))
    number = frame if hrls.number is None else hrls.number
    return FrameFile(pattern, number if _NUMBER.search(pattern) else None)


def file_numbers(inputs: Sequence[ReadRange], out: FrameFile, first: int, last: int) -> tuple[int, int]:
    """Return the first and last number in the file names of a range, which need not be the host's frames.

    msspl-fuse pairs the files of a range by number, so the files of all inputs must have the same numbers.

    Args:
        first, last: the range in the host's frames.
    """
    for source in inputs:
        begin, end = source.first.number, source.last.number
        if begin is None or end is None or end - begin != last - first:
            raise FuseError(
                f"{source.read} does not have one numbered file per frame from {first} to {last}; "
                "change the range or the Read"
            )
    if len({source.first.number for source in inputs}) > 1:
        seen = " and ".join(f"{source.read} reads file number {source.first.number}" for source in inputs)
        raise FuseError(f"at frame {first}, {seen}; for a range, both need the same numbers in their file names")
    if out.number is None:
        raise FuseError(f"output {out.path}: a range needs a frame number in the name, such as name.####.exr")
    return out.number, out.number + last - first


def with_slashes(path: str) -> str:
    """Replace the separators of Windows, because a backslash is an escape character in Tcl and in a shell."""
    return path.replace(os.sep, "/")


def _with_width(pattern: str) -> str:
    """Write the frame number of a pattern with its width, as ``%04d``."""
    return _NUMBER.sub(lambda token: f"%0{len(token[0]) if token[0][0] == '#' else int(token[1] or 1)}d", pattern)
