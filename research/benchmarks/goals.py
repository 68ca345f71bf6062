# SPDX-License-Identifier: Apache-2.0
"""What the three qualities were to reach at x2, against Open Image Denoise (OIDN) at its best, and what they reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from research.benchmarks import results, versus
from research.benchmarks.quality import AVERAGES
from research.benchmarks.results import Row
from research.benchmarks.runtime import OIDN, OIDN_BASE_GUIDES, OIDN_PREFILTERED

FAST, BALANCED, BEST = "joint-small-x2", "joint-x2", "joint-large-x2"
ON_HRLS, SAME_SAMPLES = "OIDN prefiltered on the HRLS", "OIDN prefiltered, same samples"


@dataclass(frozen=True)
class Goal:
    """A difference of PSNR that should be at least so large, or a ratio of RelMSE that should be at most so large."""

    title: str
    method: str
    other: str
    wanted: tuple[float, float, float]
    """For each of ``AVERAGES``. With unequal shares, 2 spp can't be rendered."""
    measure: str = "PSNR"

    def cell(self, rows: Sequence[Row]) -> tuple[list[str], int, int]:
        """The values of one table of :mod:`research.benchmarks.quality`, how many reach the goal, and how many there
        are."""
        values, reached = [], 0
        for spp, wanted in zip(AVERAGES, self.wanted, strict=True):
            found = versus.compare(rows, self.method, self.other, spp)
            if found is None:
                continue
            if self.measure == "PSNR":
                values.append(f"{found.psnr[0]:+.2f}")
                reached += round(found.psnr[0], 2) >= wanted
            else:
                values.append(f"{found.relmse[0]:.2f}")
                reached += round(found.relmse[0], 2) <= wanted
        return values, reached, len(values)


ACCURACY = (
    Goal("`best` and OIDN on the HRLS", BEST, ON_HRLS, (0.5, 0.5, 0.5)),
    Goal("`best` and OIDN on the HRLS", BEST, ON_HRLS, (0.8, 0.8, 0.8), "RelMSE"),
    Goal("`balanced` and OIDN on the HRLS", BALANCED, ON_HRLS, (0, 0, 0)),
    Goal("`fast` and OIDN's quality fast on the HRLS", FAST, "OIDN fast on the HRLS", (0, 0, 0)),
    Goal("`best` and OIDN with the same samples", BEST, SAME_SAMPLES, (-0.1, 0, 0)),
    Goal("`best` and OIDN with the same samples", BEST, SAME_SAMPLES, (1, 1, 1), "RelMSE"),
    Goal("the same, HRLS with 3/4 of the samples", f"{BEST}, 3:1", SAME_SAMPLES, (0, 0, 0)),
    Goal("the same, HRLS with 3/4 of the samples", f"{BEST}, 3:1", SAME_SAMPLES, (1, 1, 1), "RelMSE"),
)
#: A method, what its time is compared with, and the largest ratio.
TIME = (
    ("`best`", BEST, OIDN_PREFILTERED, 0.5),
    ("`best`", BEST, OIDN_BASE_GUIDES, 0.5),
    ("`balanced`", BALANCED, OIDN, 0.6),
    ("`fast`", FAST, "OIDN fast", 0.5),
)


def accuracy(tables: Mapping[str, Sequence[Row]]) -> str:
    """A line for each goal; in each cell the values at 2, 4 and 8 spp that were measured.

    Args:
        tables: title -> rows of :mod:`research.benchmarks.quality`.
    """
    body = []
    for goal in ACCURACY:
        cells = [goal.cell(rows) for rows in tables.values()]
        sign = "at least" if goal.measure == "PSNR" else "at most"
        wanted = ", ".join(f"{value:g}" for value in (goal.wanted if len(set(goal.wanted)) > 1 else goal.wanted[:1]))
        reached = f"{sum(cell[1] for cell in cells)} of {sum(cell[2] for cell in cells)}"
        body.append([goal.title, goal.measure, f"{sign} {wanted}", *(", ".join(cell[0]) for cell in cells), reached])
    return results.markdown(["compared", "measure", "wanted", *tables, "reached"], body)


def time(machines: Mapping[str, Sequence[Row]]) -> str:
    """A line for each quality, with its share of OIDN's time on each machine.

    Args:
        machines: title -> rows of :mod:`research.benchmarks.runtime`.
    """
    body = []
    for title, method, other, wanted in TIME:
        cells = []
        for rows in machines.values():
            seconds = {row["method"]: row["seconds"] for row in rows}
            both = method in seconds and other in seconds
            cells.append(f"{seconds[method] / seconds[other]:.2f}" if both else "")
        body.append([title, other, f"{wanted:g}", *cells])
    return results.markdown(["time of", "compared with", "wanted", *machines], body)
