# SPDX-License-Identifier: Apache-2.0
"""Tells whether the renders of a frame fit, and what more would help, without fusing them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.findings import Finding, as_data, codes_of
from oiio_msspl.fusion.checks.pair import BOTH_BLACK, check_renders
from oiio_msspl.fusion.checks.spread_noise import is_noise_spread
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.jobs.advice import advise
from oiio_msspl.jobs.inputs import InputOptions, both_paths, map_pair
from oiio_msspl.jobs.report import merged
from oiio_msspl.jobs.sequence import next_file
from oiio_msspl.jobs.views import find_other_views


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
        others = find_other_views(*first, inputs)
        views = [first, *((view.lr, view.hr) for view in others.views)]
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
            passed_on=others.passed_on,
            size=first.hr.display_window.size,
            aovs=tuple(sorted(first.hr.features)),
        )
    except InputError as error:
        return PairCheck(lr, hr, problem=str(error))
