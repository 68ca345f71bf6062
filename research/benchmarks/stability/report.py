# SPDX-License-Identifier: Apache-2.0
"""The stability benchmark's rows as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.stability.measures import (
    AWAY,
    CELL,
    COST,
    EXCESS,
    FLOOR,
    HOLE,
    HOLE_AROUND,
    HOLE_REACH,
    HRLS_REACH,
    LRHS_REACH,
    NEAR,
    STEP,
    STEP_INSIDE,
    TRIMMED,
    verdict,
)

INTRODUCTION = """\
Pairs are disturbed in every way that goes wrong in production. Their references are exact: the scenes are analytic
pictures, rendered with the noise of one-sample Monte Carlo. The HRLS has 1 spp, or 4 where layers or the variance are
disturbed. The LRHS has one sample for every HRLS pixel. A case may say otherwise.

* **worst pixel**: the largest value, divided by the largest one of the reference within {hrls_reach} pixels.
* **RelMSE** (0.5, 0.01), **trimmed** of the worst {trimmed:g} % of the pixels, and **PSNR** (sRGB): of pictures whose
  reference is exposed to mid-grey, so that dark and bright frames can be compared.
* **cost**: PSNR that the disturbance costs the method.
* **range**: how far a value lies beyond those of both inputs and of the reference around its pixel ({lrhs} x {lrhs}
  LRHS and {hrls} x {hrls} HRLS pixels), as a factor. x1 is inside. Values below {floor:g} of mid-grey do not count.
* **holes**: pixels below {hole:g} of the reference and below {hole_around:g} of the median within {hole_reach} LRHS
  pixels.
* **stamps**: rectangles along a grid of {cell} x {cell} pixels that stand out. They are counted by their corners:
  squares in which the ratio of result and reference changes at a vertical and at a horizontal side, by a factor of
  {step:g} or more, and by {inside:g} times the largest change inside the squares around.

A method **fails** where the enlarged LRHS is closer to the reference, where NaN or Inf comes out, or where a pair that
does not belong together costs more than {cost:g} dB without a warning. It **suffers** where a value is more than
{excess:.0f} % outside the range, where there is a hole or a stamp, where a disturbance costs more than {cost:g} dB,
where a scaled scene does not give a scaled result, or where the result changes by more than {away:.0f} % at a distance
of more than {near} LRHS pixels from the change. OIDN gets the HRLS with albedo and normal; "prefiltered" means that it
denoises these two first. *The tool warns* means that `msspl-fuse` prints a warning.
""".format(
    hrls_reach=HRLS_REACH,
    trimmed=100 * TRIMMED,
    lrhs=2 * LRHS_REACH + 1,
    hrls=2 * HRLS_REACH + 1,
    floor=FLOOR,
    cost=COST,
    excess=100 * (EXCESS - 1),
    away=100 * AWAY,
    near=NEAR,
    hole=HOLE,
    hole_around=HOLE_AROUND,
    hole_reach=HOLE_REACH,
    cell=CELL,
    step=STEP,
    inside=STEP_INSIDE,
)
ENLARGED = "LRHS enlarged"
#: Column -> its title and its format.
COLUMNS = {
    "worst_pixel": ("worst pixel", "x{:.3g}"),
    "relmse": ("RelMSE", "{:.4g}"),
    "relmse_trimmed": ("trimmed", "{:.4g}"),
    "psnr": ("PSNR", "{:.2f}"),
    "cost": ("cost, dB", "{:.2f}"),
    "range": ("range", "x{:.3g}"),
    "holes": ("holes", "{}"),
    "stamps": ("stamps", "{}"),
}
KEYS = ("scale", "scenes", "group", "case", "method")


def judged(measured: Sequence[dict[str, Any]]) -> list[Row]:
    """The table's rows: `KEYS`, `COLUMNS`, and, except for the enlarged LRHS, ``verdict`` and ``sentence``.

    Several views count as one row: the worst of what is a maximum, the sum of what is a
    count, the mean of everything else.
    """
    maxima, sums = ("worst_pixel", "range", "deviation", "away"), ("holes", "stamps")
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in measured:
        groups.setdefault(tuple(row[key] for key in KEYS), []).append(row)
    rows = []
    for members in groups.values():
        pooled = dict(members[0])
        for key, value in members[0].items():
            if isinstance(value, float):
                values = [member.get(key, 0.0) for member in members]
                pooled[key] = max(values) if key in maxima else float(np.mean(values))
        pooled |= {key: sum(member[key] for member in members) for key in sums}
        pooled["finite"] = all(member["finite"] for member in members)
        pooled["warnings"] = [warning for member in members for warning in member["warnings"]]
        row = {key: pooled[key] for key in (*KEYS, *COLUMNS) if key in pooled}
        if row["method"] != ENLARGED:
            row["verdict"], row["sentence"] = verdict(pooled)
        rows.append(row)
    return rows


def document(rows: Sequence[Row]) -> str:
    """What is measured, then for each scale and kind of scenes a summary and a table for each group."""
    text = INTRODUCTION
    for scale, scenes in dict.fromkeys((row["scale"], row["scenes"]) for row in rows):
        mine = [row for row in rows if (row["scale"], row["scenes"]) == (scale, scenes)]
        text += f"\n## x{scale}, {'analytic scenes' if scenes == 'analytic' else 'rendered views'}\n\n{summary(mine)}"
        for group in dict.fromkeys(row["group"] for row in mine):
            members = [row for row in mine if row["group"] == group]
            text += f"\n### {group[0].upper() + group[1:]}\n\n{_group(members)}"
    return text


def summary(rows: Sequence[Row]) -> str:
    """A line for each method: how often it holds, suffers and fails, and its holes and stamps in all cases."""
    body = []
    for method in dict.fromkeys(row["method"] for row in rows if row["method"] != ENLARGED):
        mine = [row for row in rows if row["method"] == method]
        counts = [str(sum(row["verdict"] == grade for row in mine)) for grade in ("holds", "suffers", "fails")]
        worst = max(mine, key=lambda row: row["range"])
        factor = f"x{float(format(worst['range'], '.3g')):g}"
        where = f"{factor} ({worst['group']}: {worst['case']})" if worst["range"] > EXCESS else "inside"
        body.append([method, *counts, where, *(_found(mine, column) for column in ("holes", "stamps"))])
    head = ["method", "holds", "suffers", "fails", "furthest outside the inputs' range", "holes", "stamps"]
    return results.markdown(head, body)


def _found(rows: Sequence[Row], column: str) -> str:
    """How many there are, and in how many cases."""
    counts = [row[column] for row in rows if row[column]]
    return f"{sum(counts)} in {len(counts)} case{'s' * (len(counts) > 1)}" if counts else "none"


def _group(rows: Sequence[Row]) -> str:
    """A line for each case and method."""
    body = []
    shown = None
    for row in rows:
        case = "" if row["case"] == shown else row["case"]
        shown = row["case"]
        cells = (form.format(row[column]) if column in row else "" for column, (_, form) in COLUMNS.items())
        sentence = f"**{row['verdict']}**: {row['sentence']}" if "verdict" in row else ""
        body.append([case, row["method"], *cells, sentence])
    return results.markdown(["case", "method", *(title for title, _ in COLUMNS.values()), ""], body)
