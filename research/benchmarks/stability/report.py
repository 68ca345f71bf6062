# SPDX-License-Identifier: Apache-2.0
"""Pool and judge what the stability benchmark measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.stability.measures import verdict

ENLARGED = "LRHS enlarged"
#: Figures of a row.
COLUMNS = ("worst_pixel", "relmse", "relmse_trimmed", "psnr", "cost", "range", "holes", "stamps")
KEYS = ("scale", "scenes", "group", "case", "method")


def judged(measured: Sequence[dict[str, Any]]) -> list[Row]:
    """Return the table's rows: `KEYS`, `COLUMNS`, and, except for the enlarged LRHS, ``verdict`` and ``sentence``."""
    rows = []
    for figures in measured:
        row = {key: figures[key] for key in (*KEYS, *COLUMNS) if key in figures} | results.model_of(figures["method"])
        if row["method"] != ENLARGED:
            row["verdict"], row["sentence"] = verdict(figures)
        rows.append(row)
    return rows
