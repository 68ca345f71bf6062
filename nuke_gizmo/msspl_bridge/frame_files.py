# SPDX-License-Identifier: Apache-2.0
"""Reads file names of numbered frames: finds number and view, names the output, and checks a range."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from msspl_bridge import FuseError

_NUMBER = re.compile(r"%(0?)(\d*)d|#+")
_VIEW = re.compile(r"%[vV]")


@dataclass(frozen=True)
class FrameFile:
    """The file of one frame of a numbered sequence, or a still. ``%V`` and ``%v`` stand for the view."""

    head: str
    """The path up to the number. For a still, the whole path."""
    number: int | None = None
    """None for a still."""
    digits: int = 0
    """The number is padded with zeros to this width."""
    tail: str = ""

    @property
    def path(self) -> str:
        return self.head if self.number is None else f"{self.head}{self.number:0{self.digits}d}{self.tail}"

    @property
    def pattern(self) -> str:
        """The name of the whole sequence, such as ``/shot/hr.%04d.exr``. Nuke and msspl-fuse both read this form."""
        return self.head if self.number is None else f"{self.head}%0{self.digits}d{self.tail}"

    def in_view(self, view: str) -> FrameFile:
        """Return the file of a view: ``%V`` is its name, ``%v`` its first letter."""
        head, tail = (part.replace("%V", view).replace("%v", view[:1]) for part in (self.head, self.tail))
        return replace(self, head=head, tail=tail)


@dataclass(frozen=True)
class ReadRange:
    """The files that a Read node reads at the first and at the last frame of a range."""

    read: str
    """Name of the node, for messages."""
    first: FrameFile
    last: FrameFile


def find_number(pattern: str, path: str) -> FrameFile:
    """Split the path of a frame into head, number and tail.

    Args:
        pattern: the file knob of the Read, with ``%04d`` or ``####`` for the number. If it has ``%V`` or ``%v`` for the
            view, head and tail have it, too.
        path: the file that Nuke found through the pattern.
    """
    pattern, path = with_slashes(pattern), with_slashes(path)
    folder, expected = posixpath.split(pattern)
    stereo = bool(_VIEW.search(pattern))
    folder = folder if stereo else posixpath.dirname(path)
    tokens = list(_NUMBER.finditer(expected))
    if not tokens:
        return FrameFile(pattern if stereo else path)
    token = tokens[-1]
    before, after = expected[: token.start()], expected[token.end() :]
    match = re.fullmatch(f"{_match_any_view(before)}(-?[0-9]+){_match_any_view(after)}", posixpath.basename(path))
    if not match:
        raise FuseError(f"{path}: does not match the pattern {pattern}; rename the file, or correct the Read's file")
    return FrameFile(posixpath.join(folder, before), int(match[1]), _digits(token), after)


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
            return FrameFile("_fused".join(posixpath.splitext(hrls.head)))
        plain = hrls.head.rstrip("._-")
        return replace(hrls, head=f"{plain}_fused{hrls.head[len(plain) :]}")
    if not os.path.isabs(text):
        raise FuseError(f"output {text}: is a relative path; give the full path, folder included")
    folder, name = posixpath.split(with_slashes(text))
    tokens = list(_NUMBER.finditer(name))
    if not tokens:
        return FrameFile(with_slashes(text))
    token, number = tokens[-1], frame if hrls.number is None else hrls.number
    return FrameFile(posixpath.join(folder, name[: token.start()]), number, _digits(token), name[token.end() :])


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


def _match_any_view(text: str) -> str:
    return ".+?".join(re.escape(part) for part in _VIEW.split(text))


def _digits(token: re.Match[str]) -> int:
    return len(token[0]) if token[0].startswith("#") else int(token[2] or 1)
