# SPDX-License-Identifier: Apache-2.0
"""One method against another: the difference by scene, and a 95 % interval of its mean.

The interval is a bootstrap over scenes: as many scenes as there are, drawn again and again with repetition. It says
what other scenes of the same kind might have given. With five scenes it is rather too narrow than too wide.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.benchmarks import results
from research.benchmarks.results import MEAN, Row
from research.benchmarks.scenes import NOISY_REFERENCE

#: How often the scenes are drawn, and the percentiles of the means that bound the interval.
DRAWS, PERCENTILES = 20_000, (2.5, 97.5)
#: A scene so easy that its PSNR is beyond that of its own reference. Means are also given without it.
TOO_EASY = "cornell-box"


@dataclass(frozen=True)
class Comparison:
    """A method minus another in dB, and the ratio of their mean RelMSE, each as (value, low end, high end)."""

    psnr: tuple[float, float, float]
    relmse: tuple[float, float, float]
    by_scene: Mapping[str, float]
    """Difference in dB of each scene."""

    @property
    def without_too_easy(self) -> float:
        """Mean difference in dB without the scene `TOO_EASY`."""
        return float(np.mean([value for name, value in self.by_scene.items() if name != TOO_EASY]))

    @property
    def wins(self) -> str:
        """On how many scenes the first method has more PSNR."""
        return f"{sum(value > 0 for value in self.by_scene.values())} of {len(self.by_scene)}"

    @property
    def verdicts(self) -> tuple[str, str]:
        """By PSNR and by RelMSE: "ahead" or "behind" where the whole interval says so, else "open"."""
        (_, low, high), (_, least, most) = self.psnr, self.relmse
        return verdict(low > 0, high < 0), verdict(most < 1, least > 1)


def verdict(ahead: bool, behind: bool) -> str:
    return "ahead" if ahead else "behind" if behind else "open"


def clean_scenes(rows: Sequence[Row]) -> list[str]:
    """Names of the scenes that means are over."""
    names = dict.fromkeys(row["scene"] for row in rows)
    return [name for name in names if name != MEAN and name not in NOISY_REFERENCE]


def compare(rows: Sequence[Row], method: str, other: str, spp: int, other_spp: int | None = None) -> Comparison | None:
    """Compare two methods of a table of :mod:`research.benchmarks.quality`; None if one was not measured on every
    scene."""
    found = results.index(rows, "scene", "spp", "method")
    names = clean_scenes(rows)
    pairs = [(found.get((n, spp, method)), found.get((n, other_spp or spp, other))) for n in names]
    both = [(ours, theirs) for ours, theirs in pairs if ours and theirs]
    if not both or len(both) < len(names):
        return None
    psnr, relmse = (np.array([[row[measure] for row in pair] for pair in both]) for measure in ("psnr", "relmse"))
    difference = psnr[:, 0] - psnr[:, 1]
    drawn = draws(len(both))
    ratios = relmse[drawn].mean(axis=1)
    return Comparison(
        psnr=with_interval(difference),
        relmse=(float(relmse[:, 0].mean() / relmse[:, 1].mean()), *_ends(ratios[:, 0] / ratios[:, 1])),
        by_scene=dict(zip(names, difference.tolist(), strict=True)),
    )


def with_interval(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Mean of one value for each scene, and the ends of its interval."""
    return float(values.mean()), *_ends(values[draws(len(values))].mean(axis=1))


@functools.cache
def draws(count: int) -> NDArray[np.int64]:
    """Indices of the drawn scenes, (DRAWS, count). They are the same in every run."""
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


def _ends(means: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(means, PERCENTILES)
    return float(low), float(high)


def cell(value: tuple[float, float, float], form: str) -> str:
    """A value and its interval as text."""
    middle, low, high = (format(number, form) for number in value)
    return f"{middle} ({low} to {high})"


def table(
    tables: Mapping[str, Sequence[Row]], methods: Sequence[str], others: Mapping[str, str], spps: Sequence[int]
) -> str:
    """A line for each table, method, other method and average spp that were measured.

    Args:
        tables: title -> rows.
        others: the other methods -> how they are called in the table.
    """
    body = [
        [title, f"`{method}`", name, str(spp), *_cells(found)]
        for title, rows in tables.items()
        for method in methods
        for other, name in others.items()
        for spp in spps
        if (found := compare(rows, method, other, spp))
    ]
    head = ["renders", "method", "against OIDN", "spp", "PSNR gained, dB", f"without {TOO_EASY}", "better on"]
    return results.markdown([*head, "RelMSE, of OIDN's", "PSNR, RelMSE"], body)


def _cells(found: Comparison) -> list[Any]:
    without = f"{found.without_too_easy:+.2f}" if TOO_EASY in found.by_scene else ""
    return [cell(found.psnr, "+.2f"), without, found.wins, cell(found.relmse, ".2f"), ", ".join(found.verdicts)]
