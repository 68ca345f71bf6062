# SPDX-License-Identifier: Apache-2.0
"""Reads and writes result tables: a CSV file a benchmark, in `research/benchmarks/results/`.

The first line names the columns. Numbers have four significant digits. An empty cell means "does not apply" or
"not measured".
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "results"
#: In the column `scene`: the mean over all scenes whose reference is clean.
MEAN = "mean"

Row = dict[str, Any]


def read(table: str | Path) -> list[Row]:
    """Rows of a table, given by its path or by its name in `research/benchmarks/results/`.

    A column that holds nothing but numbers is read as numbers. Empty cells are left out of their row.
    """
    path = table if isinstance(table, Path) else FOLDER / f"{table}.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    convert = {column: _type_of(row[column] for row in rows) for column in (rows[0] if rows else ())}
    return [{column: convert[column](cell) for column, cell in row.items() if cell != ""} for row in rows]


def _type_of(cells: Iterable[str]) -> type:
    """int, float or str: the first that can read every cell that is not empty."""
    filled = [cell for cell in cells if cell != ""]
    for kind in (int, float):
        try:
            for cell in filled:
                kind(cell)
        except ValueError:
            continue
        return kind
    return str


def write(path: Path, rows: Sequence[Row]) -> None:
    """Replace a table. Columns stand in the order in which the rows first name them."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_cell(row.get(column)) for column in columns] for row in rows)


def merge(path: Path, rows: Sequence[Row], keys: Sequence[str]) -> None:
    """Put rows into a table: each replaces the row that has the same values in the columns `keys`, or comes last."""
    old = read(path) if path.exists() else []
    write(path, list((index(old, *keys) | index(rows, *keys)).values()))


def _cell(value: Any) -> Any:
    """A float with four significant digits, without an exponent where that is as short."""
    return f"{value:.4g}" if isinstance(value, float) else value


def index(rows: Iterable[Row], *keys: str) -> dict[Hashable, Row]:
    """Rows by their value in one column, or by the tuple of their values in several."""
    if len(keys) == 1:
        return {row[keys[0]]: row for row in rows}
    return {tuple(row[key] for key in keys): row for row in rows}


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add the option `--table FILE.csv`, which is the same in every benchmark."""
    parser.add_argument("--table", type=Path, metavar="FILE.csv", help="also write the results to this table")
