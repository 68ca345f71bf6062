# SPDX-License-Identifier: Apache-2.0
"""Compare two methods: the difference by scene, and a 95 % interval of its mean.

The interval is a bootstrap over scenes: as many scenes as there are, drawn again and again with repetition. It says
what other scenes of the same kind might have given. With five scenes it is rather too narrow than too wide.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
        """How many of the scenes the first method leads by PSNR."""
        return f"{sum(value > 0 for value in self.by_scene.values())} of {len(self.by_scene)}"

    @property
    def verdicts(self) -> tuple[str, str]:
        """By PSNR and by RelMSE: "ahead" or "behind" where the whole interval says so, else "open"."""
        (_, low, high), (_, least, most) = self.psnr, self.relmse
        return _verdict(low > 0, high < 0), _verdict(most < 1, least > 1)


def _verdict(ahead: bool, behind: bool) -> str:
    return "ahead" if ahead else "behind" if behind else "open"


def clean_scenes(rows: Sequence[Row]) -> list[str]:
    """Return the names of the scenes that means are over."""
    names = dict.fromkeys(row["scene"] for row in rows)
    return [name for name in names if name != MEAN and name not in NOISY_REFERENCE]


def compare(rows: Sequence[Row], method: str, peer: str, spp: int) -> Comparison | None:
    """Compare two methods of a table of accuracy; return None if one of them was not measured on every scene."""
    by_key = results.index(rows, "scene", "spp", "method")
    names = clean_scenes(rows)
    pairs = [(by_key.get((name, spp, method)), by_key.get((name, spp, peer))) for name in names]
    measured = [(ours, theirs) for ours, theirs in pairs if ours and theirs]
    if not measured or len(measured) < len(names):
        return None
    psnr, relmse = (np.array([[row[measure] for row in pair] for pair in measured]) for measure in ("psnr", "relmse"))
    difference = psnr[:, 0] - psnr[:, 1]
    ratios = relmse[_draws(len(measured))].mean(axis=1)
    return Comparison(
        psnr=with_interval(difference),
        relmse=(float(relmse[:, 0].mean() / relmse[:, 1].mean()), *_ends(ratios[:, 0] / ratios[:, 1])),
        by_scene=dict(zip(names, difference.tolist(), strict=True)),
    )


def with_interval(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the mean of one value for each scene, and the ends of its interval."""
    return float(values.mean()), *_ends(values[_draws(len(values))].mean(axis=1))


@functools.cache
def _draws(count: int) -> NDArray[np.int64]:
    """Return the indices of the drawn scenes, (DRAWS, count), equal in every run."""
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


def _ends(means: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(means, PERCENTILES)
    return float(low), float(high)


def cell(value: tuple[float, float, float], form: str) -> str:
    """Return a value and its interval as text."""
    middle, low, high = (format(number, form) for number in value)
    return f"{middle} ({low} to {high})"
