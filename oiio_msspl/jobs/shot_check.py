# SPDX-License-Identifier: Apache-2.0
"""Checks a shot before it is fused: each frame by itself, the frames with each other, and the motion."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.findings import Finding, as_data, codes_of
from oiio_msspl.jobs.inputs import InputOptions
from oiio_msspl.jobs.pair_check import PairCheck, check_files
from oiio_msspl.jobs.plan import TemporalOptions, plan_temporal
from oiio_msspl.jobs.sequence import Shot, find_shot


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
        pairs = {"the frame is": (pair.size, reference.size)}
        pairs["the layers found are"] = ", ".join(pair.aovs), ", ".join(reference.aovs)
        warnings += [
            Finding("flicker", f"frame {number}: {what} {here} here and {there} in frame {first}: it may flicker")
            for what, (here, there) in pairs.items()
            if here != there
        ]
    return warnings
