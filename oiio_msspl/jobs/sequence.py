# SPDX-License-Identifier: Apache-2.0
"""Finds the frames of a shot: numbered EXRs, by pattern or folder, paired by frame number.

fileseq reads padding and frame ranges. Where its reading differs from what compositors expect, a comment says so.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import fileseq

from oiio_msspl.aovs.renderers import aov_files
from oiio_msspl.errors import InputError

#: The frame number in a pattern, as Nuke, Katana, Python and Houdini write it. fileseq reads all of these, but splits
#: the name around them differently: it takes the digits of ``v2####.exr`` for a frame range, it finds no number in
#: ``a.####_v2.exr``, it takes ``a.#.##.exr`` for subframes, and it refuses a folder named ``lr#1``.
_NUMBER_FIELD = re.compile(r"##+|@@+|%\d+d|\$F\d*")

#: The shortest forms of a frame number, for names without a longer one. They also occur in ordinary names
#: (``still@2x.exr``, ``100%done.exr``, ``take#2.exr``), so ``@`` counts only between separators, and ``%d`` and ``#``
#: only if no letter or digit follows.
_SHORT_FIELD = re.compile(r"(?<![^._ -])@(?![^._ -])|(%d|#)(?![^\W_])")

#: A name whose number is not at its end, such as ``anim.0001_lr.exr``: head, number, tail. A number after a letter does
#: not count: it may be a version or a size (``v002``, ``x2``).
_NUMBER_INSIDE = re.compile(r"(|.*[._ -])(\d+)([_ -]\D*\.exr)", re.IGNORECASE)

#: A name whose number is at its end. It may follow a letter (``hr0001.exr``), but the number after a ``v`` that stands
#: alone is that of a version (``still_v001.exr``).
_NUMBER_LAST = re.compile(r"(.*?)(?<!\d)(?<!(?<![^\W_])v)(\d+)(\.exr)", re.IGNORECASE)

#: What a sub-frame has beside its frame: ``.50`` in ``shot.1001.50.exr``.
_SUB_FRAME = re.compile(r"(?<=\d)\.\d+(?=\.exr$)", re.IGNORECASE)


@dataclass(frozen=True)
class Pattern:
    """The names of a sequence's files: ``head``, the frame number with at least ``width`` characters, ``tail``."""

    folder: Path
    head: str
    width: int
    tail: str

    def path(self, number: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{self.head}{number:0{self.width}}{self.tail}"

    @property
    def base(self) -> str:
        """The sequence's name without number, separators and extension."""
        return (self.head.rstrip("._- ") + self.tail).removesuffix(".exr")

    @property
    def name(self) -> str:
        """The pattern without its folder, written with ``#``."""
        return f"{self.head}{'#' * self.width}{self.tail}"

    def __str__(self) -> str:
        return str(self.folder / self.name)


@dataclass(frozen=True)
class Sequence:
    """Numbered files that exist."""

    pattern: Pattern
    files: dict[int, Path]


@dataclass(frozen=True)
class FrameFiles:
    """One frame of a shot. ``lr`` or ``hr`` is None if that render is missing."""

    number: int
    lr: Path | None
    hr: Path | None
    output: Path
    preview: Path | None = None
    """The PNG to write beside the EXR, if any."""

    @property
    def pair(self) -> tuple[Path, Path]:
        """The files of both renders, which exist."""
        assert self.lr is not None and self.hr is not None
        return self.lr, self.hr

    @property
    def targets(self) -> list[Path]:
        """The files to write."""
        return [path for path in (self.output, self.preview) if path is not None]


@dataclass(frozen=True)
class Shot:
    """Two sequences and the frames to fuse, in the order in which they are fused. One render a frame is both."""

    lr: Sequence
    hr: Sequence
    output: Pattern
    frames: list[FrameFiles]
    named_as_hr: bool = False
    """Whether the output is a folder, whose files are named as those of the HRLS."""

    @property
    def has_one_render(self) -> bool:
        """Whether each frame has one render."""
        return self.lr is self.hr

    def target(self, number: int) -> Path:
        """Return the file of a fused frame. In a folder it is named as the HRLS, whose frames may differ in padding."""
        if self.named_as_hr and number in self.hr.files:
            return self.output.folder / _with_exr(self.hr.files[number].name)
        return self.output.path(number)


def is_sequence(path: Path) -> bool:
    """Return whether a path is a folder or a pattern, and not a single file."""
    return path.is_dir() or (bool(_number_fields(path.name)) and not path.exists())


def check_exists(path: Path) -> None:
    """Raise InputError if a path is neither a file, nor a folder, nor a pattern."""
    if not (path.exists() or is_sequence(path)):
        hint = "; write the place of the frame number as ####" if "*" in path.name else ""
        raise InputError(f"{path}: no such file or folder{hint}")


def _number_fields(name: str) -> list[re.Match[str]]:
    """Find where a name marks the frame number; nowhere if it is not a pattern."""
    return list(_NUMBER_FIELD.finditer(name)) or list(_SHORT_FIELD.finditer(name))


def find_shot(
    lr: str | Path | None, hr: str | Path, output: str | Path, frames: str | Iterable[int] | None = None
) -> Shot:
    """Pair the frames of two sequences, or find those of one.

    Args:
        lr, hr: folders, or patterns such as ``lr.####.exr``, ``lr.%04d.exr``, ``lr.@@@@.exr`` and ``lr.$F4.exr``. None
            and the only sequence, if each frame has one render.
        output: a pattern, or a folder, whose files are then named as those of the HRLS.
        frames: frame numbers, or a range such as ``1001-1100x2,1200``; None for every frame of either sequence.

    Returns:
        The shot. A frame that only one of the sequences has is included.

    Raises:
        InputError: there are no frames, a pattern can't be read, or several sequences in a folder could be meant.
    """
    found = [_not_written(_sequences(Path(path)), Path(output)) for path in (lr, hr) if path is not None]
    if lr is None:
        low = high = found[0][0]
        if len(found[0]) > 1:
            names = ", ".join(sequence.pattern.name for sequence in found[0][:6])
            raise InputError(
                f"{Path(hr)}: has several sequences ({names}); name the one to fuse, or two that belong together"
            )
    else:
        low, high = _choose(found[0], found[1], Path(lr), Path(hr))
    numbers = sorted(low.files.keys() | high.files.keys()) if frames is None else parse_frames(frames)
    is_pattern, pattern = _output_pattern(Path(output), high.pattern)
    shot = Shot(low, high, pattern, [], named_as_hr=not is_pattern)
    shot.frames.extend(FrameFiles(n, low.files.get(n), high.files.get(n), shot.target(n)) for n in numbers)
    return shot


def _with_exr(name: str) -> str:
    """Append .exr to a name such as hr.exr.####, because programs know an EXR by its extension."""
    return name if name.lower().endswith(".exr") else f"{name}.exr"


def _not_written(sequences: list[Sequence], output: Path) -> list[Sequence]:
    """Leave out the results that a run that resumes finds beside its renders."""
    if output.is_dir() or not output.parent.is_dir() or not _number_fields(output.name):
        return sequences
    # Names are compared, because a pattern may have fewer digits than its numbers: name.#.exr means name.1001.exr, too.
    written = {path.name for path in _files_of(parse_pattern(output)).values()}

    renders = [
        sequence
        for sequence in sequences
        if not sequence.pattern.folder.samefile(output.parent)
        or not written.issuperset(path.name for path in sequence.files.values())
    ]
    return renders or sequences


def format_frames(numbers: Iterable[int]) -> str:
    """Write frame numbers as a range: ``1001-1010,1020-1030x2``."""
    return str(fileseq.framesToFrameRange(numbers))


def parse_frames(frames: str | Iterable[int]) -> list[int]:
    """Return the numbers of a range such as ``1001-1100x2,1200``, or numbers, each once, in the order given."""
    if isinstance(frames, str):
        if re.search(r"\d\s+\d", frames):
            raise InputError(f"--frames {frames!r}: separate numbers and ranges by commas, such as 1001,1005-1010")
        try:
            # Open Job Description and Houdini write a step as :2. fileseq takes that for a staggered range.
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
    """Read a pattern such as ``lr.####.exr``."""
    fields = _number_fields(path.name)
    if len(fields) != 1:
        raise InputError(f"{path}: a pattern has its frame number in one place, such as name.####.exr or name.%04d.exr")
    start, end = fields[0].span()
    # One digit for a #, as in Nuke, Katana and RV. fileseq's default is four digits.
    number = fileseq.FileSequence(fields[0].group(), pad_style=fileseq.constants.PAD_STYLE_HASH1)
    return Pattern(path.parent, path.name[:start], number.zfill(), path.name[end:])


def frame_in_name(path: Path) -> tuple[Pattern, int] | None:
    """Return the pattern and the frame number of a file; None if its name has no frame number."""
    match = _NUMBER_INSIDE.fullmatch(path.name) or _NUMBER_LAST.fullmatch(path.name)
    if match is None:
        return None
    head, number, width, tail = _numbered(match)
    return Pattern(path.parent, head, width, tail), number


def next_file(path: Path) -> Path | None:
    """Return the file of the next frame, which lies beside that of a frame; None if there is none."""
    numbered = frame_in_name(path)
    if numbered is None:
        return None
    file = numbered[0].path(numbered[1] + 1)
    return file if file.is_file() else None


def _numbered(match: re.Match[str]) -> tuple[str, int, int, str]:
    """Return head, number, characters of the number, and tail of a name."""
    head, digits, tail = match.groups()
    # A hyphen after a letter or digit is a separator. Otherwise it is a sign.
    if head.endswith("-") and not head[-2:-1].isalnum():
        head, digits = head[:-1], f"-{digits}"
    return head, int(digits), len(digits), tail


def _sequences(path: Path) -> list[Sequence]:
    """Find the sequence that a pattern names, or all sequences of a folder."""
    if path.is_dir():
        if sequences := _sequences_in(path):
            return sequences
        raise InputError(f"{path}: no numbered EXRs in this folder (a pattern such as name####_lr.exr finds others)")
    check_exists(path)
    if not is_sequence(path):
        raise InputError(f"{path}: is a single file, the other one is a folder or a pattern; give two of a kind")
    pattern = parse_pattern(path)
    if not pattern.folder.is_dir():
        raise InputError(f"{path}: there is no folder {pattern.folder}")
    files = _files_of(pattern)
    if not files:
        names = ", ".join(str(s.pattern) for s in _sequences_in(pattern.folder)[:6]) or "no numbered EXRs"
        raise InputError(f"{path}: no file has such a name; the folder has {names}")
    return [Sequence(pattern, files)]


def _files_of(pattern: Pattern) -> dict[int, Path]:
    """Find the files that a pattern names: ``lr.####.exr`` means lr.0007.exr and not lr.7.exr."""
    # fileseq's findSequenceOnDisk takes [ in a name for a wildcard, finds nothing where the number comes last
    # (hr.exr.####), and fails if names with another padding lie there as well.
    files = {}
    for name in os.listdir(pattern.folder):
        if not (name.startswith(pattern.head) and name.endswith(pattern.tail)):
            continue
        text = name[len(pattern.head) : len(name) - len(pattern.tail)]
        if not re.fullmatch(r"-?\d+", text):
            continue
        number, width = int(text), pattern.width
        # The sign of a negative number may count as a digit (-003) or not (-0003).
        if text in (f"{number:0{width}}", f"-{abs(number):0{width}}"):
            files[number] = pattern.folder / name
    return files


def _sequences_in(folder: Path) -> list[Sequence]:
    """Find the sequences of EXRs in a folder, by name. Versions (``still_v001.exr``) are not frames."""
    # Hidden files may be half written.
    names = sorted(name for name in os.listdir(folder) if name.lower().endswith(".exr") and not name.startswith("."))
    frames = set(names)
    names = [name for name in names if _SUB_FRAME.sub("", name, count=1) not in frames - {name}]
    matches = list(filter(None, map(_NUMBER_LAST.fullmatch, names)))
    if not matches:
        # Beside others, names with the number inside (anim.0001_lr.exr) may be files that belong to their frames.
        matches = list(filter(None, map(_NUMBER_INSIDE.fullmatch, names)))
    by_name: dict[tuple[str, str], list[tuple[int, int, str]]] = {}
    for match in matches:
        head, number, width, tail = _numbered(match)
        by_name.setdefault((head, tail), []).append((number, width, match[0]))
    sequences = []
    for (head, tail), members in sorted(by_name.items()):
        pattern = Pattern(folder, head, min(width for _, width, _ in members), tail)
        files = {number: folder / name for number, _, name in members}
        if len(files) < len(members):
            raise InputError(f"{pattern}: some numbers occur with and without zeros in front; give a pattern")
        sequences.append(Sequence(pattern, files))
    return sequences


def _choose(lows: list[Sequence], highs: list[Sequence], lr: Path, hr: Path) -> tuple[Sequence, Sequence]:
    """Choose the two sequences that belong together: the only ones, or the only ones with equal names.

    Where each AOV has files of its own, those of the beauty count.
    """
    pairs = [(low, high) for low in _with_aovs(lows) for high in _with_aovs(highs)]
    if len(pairs) > 1:
        pairs = [(low, high) for low, high in pairs if low.pattern.base == high.pattern.base]
    if len(pairs) == 1:
        return pairs[0]
    seen = "; ".join(
        f"{path} has {', '.join(sequence.pattern.name for sequence in sequences[:6])}"
        for path, sequences in ((lr, lows), (hr, highs))
    )
    raise InputError(f"which sequences belong together? {seen}; name the two as patterns, the low-resolution one first")


def _with_aovs(sequences: list[Sequence]) -> list[Sequence]:
    """Return the sequences beside whose files lie files of albedo or normals; all if there are none."""
    return [sequence for sequence in sequences if aov_files(next(iter(sequence.files.values())))] or sequences


def _output_pattern(output: Path, hr: Pattern) -> tuple[bool, Pattern]:
    """Return whether the output is a pattern, and not a folder, and the names of the fused frames."""
    is_pattern = bool(_number_fields(output.name)) and not output.is_dir()
    if output.suffix.lower() == ".exr" and not output.is_dir() and not is_pattern:
        raise InputError(f"{output}: one name for many frames; write {output.stem}.####.exr or name a folder")
    pattern = parse_pattern(output) if is_pattern else Pattern(output, hr.head, hr.width, _with_exr(hr.tail))
    if not pattern.tail.lower().endswith(".exr"):
        mark = _number_fields(output.name)[0].group()
        raise InputError(
            f"{output}: {mark} stands for the frame number, and the results are EXRs; name them .exr, or make the "
            "folder first if it is one"
        )
    return is_pattern, pattern
