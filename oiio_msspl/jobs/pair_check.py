# SPDX-License-Identifier: Apache-2.0
"""Tells whether the two renders of a frame fit, without fusing them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.errors import InputError
from oiio_msspl.fusion.pair_checks import BOTH_BLACK, check_renders
from oiio_msspl.jobs.inputs import InputOptions, map_pair


@dataclass(frozen=True)
class PairCheck:
    """What was found about one pair."""

    lr: Path
    hr: Path
    problem: str | None = None
    """Why the pair can't be fused; None if it can."""
    warnings: list[str] = field(default_factory=list)
    """Why the renders may not show the same frame, one sentence each."""

    @property
    def fits(self) -> bool:
        """Whether the pair can be fused and nothing speaks against it."""
        return self.problem is None and all(warning == BOTH_BLACK for warning in self.warnings)

    def as_dict(self) -> dict[str, Any]:
        """The check as JSON values."""
        return {
            "lrhs": str(self.lr),
            "hrls": str(self.hr),
            "fits": self.fits,
            "problem": self.problem,
            "warnings": self.warnings,
        }


def check_files(lr: str | Path, hr: str | Path, inputs: InputOptions = InputOptions()) -> PairCheck:
    """Check whether two files show the same frame, see :func:`oiio_msspl.fusion.pair_checks.check_pair`.

    Args:
        lr, hr: the low-resolution and the high-resolution render.
        inputs: mapping, view and colour space of the two files.

    Returns:
        What was found. A pair that can't be fused is described in ``problem``; nothing is raised for it.
    """
    lr, hr = Path(lr), Path(hr)
    try:
        return PairCheck(lr, hr, warnings=check_renders(*map_pair(lr, hr, inputs)))
    except InputError as error:
        return PairCheck(lr, hr, problem=str(error))
