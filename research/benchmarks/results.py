# SPDX-License-Identifier: Apache-2.0
"""Read and write result tables: CSV files in `research/benchmarks/results/`.

The first line names the columns. Numbers have four significant digits. An empty cell means "does not apply" or "not
measured". The last columns of every table are its `STAMP`: what a row was measured with.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import functools
import platform
import re
from collections.abc import Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

from oiio_msspl._version import full_version
from oiio_msspl.model.catalogue import WEIGHTS
from oiio_msspl.model.digests import digest

FOLDER = Path(__file__).parent / "results"
#: In the column `scene`: the mean over all scenes whose reference is clean.
MEAN = "mean"
#: Columns that say what a row was measured with: the model's name and digest (empty without a model), the version of
#: the package, the processor or GPU, and the date.
STAMP = ("model", "digest", "version", "machine", "date")

Row = dict[str, Any]


def read(table: str | Path) -> list[Row]:
    """Read the rows of a table, given by its path or by its name in `FOLDER`.

    A column that holds nothing but numbers is read as numbers. Empty cells are left out of their row.
    """
    path = table if isinstance(table, Path) else FOLDER / f"{table}.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    text = {"digest", "version", "date"}
    convert = {c: str if c in text else _type_of(row[c] for row in rows) for c in (rows[0] if rows else ())}
    return [{column: convert[column](cell) for column, cell in row.items() if cell != ""} for row in rows]


def _type_of(cells: Iterable[str]) -> type:
    """Return int, float or str: the first that can read every cell that is not empty."""
    filled = [cell for cell in cells if cell != ""]
    for kind in (int, float):
        try:
            for cell in filled:
                kind(cell)
        except ValueError:
            continue
        return kind
    return str


def write(path: Path, rows: Sequence[Row], keys: Sequence[str] = ()) -> None:
    """Write a table. Every benchmark writes through this function, which stamps the rows that have no date yet.

    Args:
        rows: those with a ``model`` name a shipped model, ``gpu/NAME`` for its file for GPUs.
        keys: the columns that tell rows apart. With them, rows of the existing table stay if no new row replaces them;
            without them, the table is replaced.
    """
    stamped = [row if "date" in row else row | stamp(row.get("model"), row.get("machine")) for row in rows]
    if keys and path.exists():
        stamped = list((index(read(path), *keys) | index(stamped, *keys)).values())
    measured = dict.fromkeys(column for row in stamped for column in row if column not in STAMP)
    columns = [*measured, *STAMP]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_cell(row.get(column)) for column in columns] for row in stamped)


def stamp(model: str | None = None, machine: str | None = None) -> Row:
    """Return the columns `STAMP` for a row that is measured now with a shipped model, or without a model.

    Args:
        machine: what computes; by default the processor.
    """
    used = {"model": model, "digest": shipped_digest(model)} if model else {}
    today = datetime.date.today().isoformat()
    return used | {"version": full_version(), "machine": machine or processor(), "date": today}


def oldest_stamp(rows: Iterable[Row]) -> Row:
    """Return the `STAMP` of the oldest row, which a mean of these rows gets. It is empty if a row has none yet."""
    stamps = [{column: row[column] for column in STAMP if column in row} for row in rows]
    return min(stamps, key=lambda stamp: stamp["date"]) if all("date" in stamp for stamp in stamps) else {}


@functools.cache
def shipped_digest(model: str) -> str | None:
    """Return the digest of a model that ships now; None if it does not ship (any more)."""
    path = WEIGHTS / f"{model}.onnx"
    return digest(path) if path.exists() else None


def model_of(method: str) -> Row:
    """Return the column ``model`` of a method's name, such as "joint-x2, 3:1"; nothing for a method without a model."""
    name = re.match(r"(?:paper|joint)[a-z-]*-x\d", method)
    return {"model": name[0]} if name else {}


def processor() -> str:
    """Return the processor's name, and whether it has AMX or VNNI, with which networks of 8 bits are faster.

    On Linux Python does not know the name, so it comes from /proc/cpuinfo. Elsewhere, neither is mentioned.
    """
    cpuinfo = Path("/proc/cpuinfo")
    return processor_in(cpuinfo.read_text()) if cpuinfo.exists() else platform.processor()


def processor_in(cpuinfo: str) -> str:
    """Return the processor's name from the text of /proc/cpuinfo."""
    names, flags = (re.findall(rf"{key}\s*: (.*)", cpuinfo) for key in ("model name", "flags"))
    name = names[0] if names else platform.processor()
    if not flags:
        return name
    instructions = next((kind for kind in ("AMX", "VNNI") if kind.lower() in flags[0]), None)
    return f"{name} with {instructions}" if instructions else f"{name} without VNNI"


def stamp_note(rows: Iterable[Row]) -> str:
    """Say when, with which versions and on which machines rows were measured, and which are older than their model.

    A row is older if the digest of its model is not that of the model that ships, or is not known.
    """
    rows = list(rows)
    if not rows:
        return ""
    dates, machines = ({row[name] for row in rows if name in row} for name in ("date", "machine"))
    some = "" if all("machine" in row for row in rows) else "partly "
    by_date = sorted({(row["date"], row["version"]) for row in rows})
    versions = list(dict.fromkeys(version for _, version in by_date))
    when = " to ".join(dict.fromkeys((min(dates), max(dates))))
    note = f"*Measured {when} with version {' to '.join(dict.fromkeys((versions[0], versions[-1])))}"
    note += f", {some}on {', '.join(sorted(machines))}.*" if machines else ".*"
    older = sorted({r["model"] for r in rows if "model" in r and r.get("digest") != shipped_digest(r["model"])})
    if older:
        names = ", ".join(f"`{name}`" for name in older)
        note += f" **Older than the model that ships** are rows of {names}."
    return note


def _cell(value: Any) -> Any:
    """Return a float with four significant digits, without an exponent where that is as short."""
    return f"{value:.4g}" if isinstance(value, float) else value


def index(rows: Iterable[Row], *keys: str) -> dict[Hashable, Row]:
    """Return rows by their value in one column, or by the tuple of their values in several."""
    if len(keys) == 1:
        return {row[keys[0]]: row for row in rows}
    return {tuple(row.get(key) for key in keys): row for row in rows}


def where(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Return the rows that have these values, or whose values pass these tests."""

    def fits(value: Any, wish: Any) -> bool:
        return bool(wish(value)) if callable(wish) else value == wish

    return [row for row in rows if all(fits(row.get(column), wish) for column, wish in wanted.items())]


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def plain(rows: Sequence[Row]) -> str:
    """Return a Markdown table of all columns and rows."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    return markdown(columns, [[str(_cell(row.get(column, ""))) for column in columns] for row in rows])


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option that every benchmark has."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--table", type=Path, metavar="FILE.csv", help="also write the results to this table")
    return made


def show(rows: list[Row], table: Path | None, keys: Sequence[str] = ()) -> None:
    """Print rows, and write them to a table if there is one."""
    print(plain(rows))
    if table:
        write(table, rows, keys)
