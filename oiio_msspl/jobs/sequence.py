# SPDX-License-Identifier: Apache-2.0
"""Which files are the frames of a shot: numbered EXRs, by pattern or folder, paired by frame number."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from oiio_msspl.errors import InputError

#: Where a file name's frame number stands, as Nuke, Katana, Python and Houdini write it.
_FIELD = re.compile(r"#+|@+|%\d*d|\$F\d*")


@dataclass(frozen=True)
class Pattern:
    """Names of numbered files."""

    folder: Path
    head: str
    width: int
    """Digits that the number is padded to."""
    tail: str

    def path(self, number: int) -> Path:
        return self.folder / f"{self.head}{number:0{self.width}d}{self.tail}"

    @property
    def base(self) -> str:
        """What a sequence is called: the name without number, separators and extension."""
        return (self.head.rstrip("._- ") + self.tail).removesuffix(".exr")

    @property
    def name(self) -> str:
        return f"{self.head}{'#' * self.width}{self.tail}"

    def __str__(self) -> str:
        return str(self.folder / self.name)


@dataclass(frozen=True)
class Sequence:
    """Numbered files that exist."""

    pattern: Pattern
    files: dict[int, Path]


@dataclass(frozen=True)
class Frame:
    """One frame of a shot."""

    number: int
    lr: Path | None
    hr: Path | None
    output: Path


@dataclass(frozen=True)
class Shot:
    """What is to be fused: frames in the order in which they are to be done."""

    lr: Sequence
    hr: Sequence
    output: Pattern
    frames: list[Frame]


def is_sequence(path: Path) -> bool:
    """Is this a folder or a pattern, and not a file?"""
    return path.is_dir() or (_FIELD.search(path.name) is not None and not path.exists())


def find_shot(lr: str | Path, hr: str | Path, output: str | Path, frames: str | Iterable[int] | None = None) -> Shot:
    """Pair the frames of two sequences.

    Args:
        lr, hr: folders, or patterns such as ``lr.####.exr``, ``lr.%04d.exr`` and ``lr.@@@@.exr``.
        output: a pattern, or a folder that gets files named as the HRLS's.
        frames: frame numbers, or a range such as ``1001-1100x2,1200``; None for every frame that either sequence has.

    Raises:
        InputError: no frames, no pattern, or a folder whose sequences can't be told apart.
    """
    lows, highs = _sequences(Path(lr)), _sequences(Path(hr))
    low, high = _choose(lows, highs, Path(lr), Path(hr))
    numbers = sorted(low.files.keys() | high.files.keys()) if frames is None else parse_frames(frames)
    target = _output_pattern(Path(output), high.pattern)
    return Shot(low, high, target, [Frame(n, low.files.get(n), high.files.get(n), target.path(n)) for n in numbers])


def format_frames(numbers: Iterable[int]) -> str:
    """``1001-1010,1020-1030x2``"""
    import fileseq

    return str(fileseq.framesToFrameRange(numbers))


def parse_frames(frames: str | Iterable[int]) -> list[int]:
    import fileseq

    if isinstance(frames, str):
        try:
            # A step is x2, or :2 as Open Job Description and Houdini write it; fileseq has another meaning for that.
            parsed = list(fileseq.FrameSet(frames.replace(":", "x")))
        except ValueError as error:
            raise InputError(f"--frames {frames!r}: write it as 1001-1100, 1001-1100x2 or 1001,1005-1010") from error
        if any(number != int(number) for number in parsed):
            raise InputError(f"--frames {frames!r}: whole frames only")
        frames = map(int, parsed)
    numbers = list(dict.fromkeys(frames))
    if not numbers:
        raise InputError("--frames: names no frame")
    return numbers


def parse_pattern(path: Path) -> Pattern:
    import fileseq

    fields = list(_FIELD.finditer(path.name))
    if len(fields) != 1:
        raise InputError(f"{path}: a pattern has its frame number in one place, such as name.####.exr or name.%04d.exr")
    start, end = fields[0].span()
    # One digit a sign, as Nuke, Katana and RV read it; fileseq's own default takes # for four.
    width = fileseq.FileSequence.getPaddingNum(fields[0].group(), pad_style=fileseq.constants.PAD_STYLE_HASH1)
    return Pattern(path.parent, path.name[:start], width, path.name[end:])


def _sequences(path: Path) -> list[Sequence]:
    """The sequence that a pattern means, or all of a folder."""
    if path.is_dir():
        found = _sequences_in(path)
        if not found:
            raise InputError(f"{path}: no numbered EXRs in this folder")
        return found
    if not is_sequence(path):
        raise InputError(f"{path}: is a single file, the other one is a folder or a pattern; give two of a kind")
    pattern = parse_pattern(path)
    if not pattern.folder.is_dir():
        raise InputError(f"{path}: there is no folder {pattern.folder}")
    files = {}
    for name in os.listdir(pattern.folder):
        number = name.removeprefix(pattern.head).removesuffix(pattern.tail)
        # Only names that the pattern itself would give: lr.####.exr means lr.0007.exr, not lr.7.exr.
        if re.fullmatch(r"-?\d+", number) and pattern.path(int(number)).name == name:
            files[int(number)] = pattern.folder / name
    if not files:
        there = ", ".join(str(s.pattern) for s in _sequences_in(pattern.folder)[:6]) or "no numbered EXRs"
        raise InputError(f"{path}: no file has such a name; the folder has {there}")
    return [Sequence(pattern, files)]


def _sequences_in(folder: Path) -> list[Sequence]:
    """The sequences of EXRs in a folder. Hidden files are none: they may be half written."""
    import fileseq

    names = [n for n in os.listdir(folder) if n.lower().endswith(".exr") and not n.startswith(".")]
    by_name: dict[tuple[str, str], list[tuple[int, int, str]]] = {}
    for found in fileseq.FileSequence.findSequencesInList(names):
        if found.frameSet() is None:
            continue
        for number, name in zip(map(int, found.frameSet() or ()), map(str, found), strict=True):
            head, width = found.basename(), found.zfill()
            if number < 0 and head and head[-1].isalnum():  # shot-0001.exr: a hyphen, not a sign
                head, number, width = f"{head}-", -number, width - 1
            by_name.setdefault((head, found.extension()), []).append((number, width, name))
    sequences = []
    for (head, tail), members in sorted(by_name.items()):
        pattern = Pattern(folder, head, min(width for _, width, _ in members), tail)
        files = {number: folder / name for number, _, name in members}
        if len(files) < len(members):
            raise InputError(f"{pattern}: some numbers occur with and without zeros in front; give a pattern")
        sequences.append(Sequence(pattern, files))
    return sequences


def _choose(lows: list[Sequence], highs: list[Sequence], lr: Path, hr: Path) -> tuple[Sequence, Sequence]:
    """The two sequences that belong together: the only ones, or the only ones of the same name."""
    pairs = [(low, high) for low in lows for high in highs]
    if len(pairs) > 1:
        pairs = [(low, high) for low, high in pairs if low.pattern.base == high.pattern.base]
    if len(pairs) == 1:
        return pairs[0]
    seen = "; ".join(
        f"{path} has {', '.join(sequence.pattern.name for sequence in found[:6])}"
        for path, found in ((lr, lows), (hr, highs))
    )
    example = f"{lows[0].pattern} {highs[0].pattern}"
    why = f"{len(pairs)} sequences go by the same name in both" if pairs else "none has the same name in both"
    raise InputError(f"which sequences belong together? {seen}, and {why}; name the two, such as {example}")


def _output_pattern(output: Path, hr: Pattern) -> Pattern:
    if _FIELD.search(output.name) and not output.is_dir():
        pattern = parse_pattern(output)
        if not pattern.tail.lower().endswith(".exr"):
            raise InputError(f"{output}: the results are EXRs; name them .exr")
        return pattern
    if output.suffix.lower() == ".exr" and not output.is_dir():
        raise InputError(f"{output}: one name for many frames; write {output.stem}.####.exr or name a folder")
    # The HRLS may be named hr.exr.####; what is written must be known for an EXR.
    return Pattern(output, hr.head, hr.width, hr.tail if hr.tail.lower().endswith(".exr") else f"{hr.tail}.exr")
