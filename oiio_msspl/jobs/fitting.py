# SPDX-License-Identifier: Apache-2.0
"""Tells whether the renders of a frame or of a shot fit, and what more would help, without fusing them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.findings import Finding, as_data, codes_of
from oiio_msspl.fusion.checks.noise import is_noise_spread
from oiio_msspl.fusion.checks.pair import BOTH_BLACK, check_renders
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.jobs.advice import advise
from oiio_msspl.jobs.inputs import InputOptions, both_paths, find_views, map_pair
from oiio_msspl.jobs.plan import TemporalOptions, plan_temporal
from oiio_msspl.jobs.report import merged
from oiio_msspl.jobs.sequence import Shot, find_shot, next_file


@dataclass(frozen=True)
class PairCheck:
    """The result of :func:`check_files`."""

    lr: Path | None
    """None for one render."""
    hr: Path
    problem: str | None = None
    """Why the pair can't be fused; None if it can."""
    warnings: list[Finding] = field(default_factory=list)
    """Why the renders may not show the same frame, one sentence each. A sentence about some views names them."""
    advice: list[Finding] = field(default_factory=list)
    """What more would help, and what it costs."""
    not_judged: list[Finding] = field(default_factory=list)
    """What could not be judged, for lack of light, of structure or of pixels: a few words each."""
    passed_on: tuple[str, ...] = ()
    """Why views beside the first one can't be fused, one sentence each."""

    size: str = ""
    """Width and height of the HRLS, as ``1920x1080``."""
    aovs: tuple[str, ...] = ()
    """The features that were found in the HRLS, such as ``albedo``."""

    @property
    def fits(self) -> bool:
        """True if the pair can be fused and nothing speaks against it."""
        return self.problem is None and all(warning.code == BOTH_BLACK.code for warning in self.warnings)

    @property
    def codes(self) -> set[str]:
        """The codes of all warnings, see ``docs/api.md``, and of the advice."""
        return {*codes_of(self.warnings), *codes_of(self.advice)}

    def as_dict(self) -> dict[str, Any]:
        """Return the check as JSON values."""
        return {
            "lrhs": None if self.lr is None else str(self.lr),
            "hrls": str(self.hr),
            "fits": self.fits,
            "problem": self.problem,
            "warnings": self.warnings,
            "warning_codes": codes_of(self.warnings),
            "not_judged": self.not_judged,
            "advice": [as_data(text) for text in self.advice],
            "size": self.size,
            "aovs": self.aovs,
            "passed_on": self.passed_on,
        }


def check_files(
    lr: str | Path | None, hr: str | Path, inputs: InputOptions = InputOptions(), *, in_shot: bool | None = None
) -> PairCheck:
    """Check whether two files show the same frame, see :func:`oiio_msspl.fusion.checks.pair.check_pair`.

    Args:
        lr, hr: the low-resolution and the high-resolution render; None and the only render.
        inputs: mapping, view and colour space of the two files. If it names no view, all are checked.
        in_shot: whether the frame is one of several; None looks for the file of the next frame.

    Returns:
        The check. If the pair can't be fused, ``problem`` says why, and nothing is raised.
    """
    lr, hr = None if lr is None else Path(lr), Path(hr)
    try:
        first = map_pair(*both_paths(lr, hr), inputs)
        views, passed_on = find_views(*first, inputs)
        judgements = {high.view: check_renders(low, high) for low, high in views if low is not high}
        warnings, not_judged = (
            merged({view: getattr(judgement, name) for view, judgement in judgements.items()})
            for name in ("warnings", "not_judged")
        )
        spread = is_noise_spread(*first, align(*first))
        in_shot = next_file(hr) is not None if in_shot is None else in_shot
        return PairCheck(
            lr,
            hr,
            warnings=warnings,
            advice=advise(*first, spread, in_shot=in_shot),
            not_judged=not_judged,
            passed_on=passed_on,
            size=first.hr.display_window.size,
            aovs=tuple(sorted(first.hr.features)),
        )
    except InputError as error:
        return PairCheck(lr, hr, problem=str(error))


@dataclass
class ShotCheck:
    """The result of :func:`check_shot`."""

    shot: Shot
    frames: dict[int, PairCheck] = field(default_factory=dict)
    """The check of each frame, by number."""
    temporal: str = ""
    """A sentence on the neighbours that frames would be averaged with, and how motion is known."""
    warnings: list[Finding] = field(default_factory=list)
    """What is wrong with the shot as a whole: frames that differ from the first one, or can't be averaged."""
    advice: list[Finding] = field(default_factory=list)
    """What more would help, and what it costs: that of the first frame that can be fused."""

    @property
    def fits(self) -> bool:
        """True if every frame fits."""
        return all(pair.fits for pair in self.frames.values())

    @property
    def codes(self) -> set[str]:
        """The codes of all warnings, about the shot and about its frames, and of the advice."""
        return {*codes_of([*self.warnings, *self.advice])}.union(
            *(codes_of(pair.warnings) for pair in self.frames.values())
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the check as JSON values."""
        return {
            "fits": self.fits,
            "temporal": self.temporal,
            "warnings": self.warnings,
            "warning_codes": codes_of(self.warnings),
            "advice": [as_data(text) for text in self.advice],
            "frames": [{"frame": number} | pair.as_dict() for number, pair in self.frames.items()],
        }


def check_shot(
    lr: str | Path | None,
    hr: str | Path,
    frames: str | Iterable[int] | None = None,
    inputs: InputOptions = InputOptions(),
    *,
    temporal: TemporalOptions = TemporalOptions(),
    progress: Callable[[int, PairCheck], None] | None = None,
) -> ShotCheck:
    """Check a shot without fusing it. A frame that can't be read has a ``problem``, and the others go on.

    Args:
        lr, hr: folders or patterns, see :func:`oiio_msspl.find_shot`; None and the only one.
        frames: numbers, or a range such as ``1001-1100x10``; None for all frames that exist.
        inputs: as in :func:`oiio_msspl.check_files`.
        temporal: how the shot is to be averaged with neighbours.
        progress: called after each frame with its number and check.

    Returns:
        The check of every frame and of the shot.

    Raises:
        InputError: there are no frames, a pattern can't be read, or neighbours are asked for and the motion is unknown.
    """
    shot = find_shot(lr, hr, Path(), frames)
    result = ShotCheck(shot)
    for files in shot.frames:
        low, high = (
            path or side.pattern.path(files.number) for path, side in ((files.lr, shot.lr), (files.hr, shot.hr))
        )
        pair = check_files(None if lr is None else low, high, inputs, in_shot=len(shot.hr.files) > 1)
        result.frames[files.number] = pair
        if progress is not None:
            progress(files.number, pair)
    usable = {number: pair for number, pair in result.frames.items() if pair.problem is None}
    result.warnings = _differences(usable)
    if usable:
        plan = plan_temporal(shot, inputs, temporal)
        result.temporal = plan.text
        result.warnings += plan.warnings
        first = next(iter(usable.values()))
        result.advice = [text for text in first.advice if not (text.code == "add_motion" and plan.count)]
    return result


def _differences(frames: dict[int, PairCheck]) -> list[Finding]:
    """Return a warning for each frame whose size or layers are not those of the first one."""
    if not frames:
        return []
    first, reference = next(iter(frames.items()))
    warnings = []
    for number, pair in frames.items():
        layers = ("the layers found are", ", ".join(pair.aovs), ", ".join(reference.aovs))
        for what, here, there in (("the frame is", pair.size, reference.size), layers):
            if here != there:
                text = f"frame {number}: {what} {here} here and {there} in frame {first}: it may flicker"
                warnings.append(Finding("flicker", text))
    return warnings
