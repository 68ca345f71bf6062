# SPDX-License-Identifier: Apache-2.0
"""Lay out tables of results from specifications: which rows of which CSV files, and what each column shows of them.

Intervals are 95 % of a bootstrap over scenes: as many scenes as there are, drawn again and again with repetition. They
say what other scenes of the same kind might have given. With five scenes they are rather too narrow than too wide.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.benchmarks import accuracy, results
from research.benchmarks.results import MEAN, Row
from research.benchmarks.scenes import NOISY_REFERENCE

#: How often the scenes are drawn, and the percentiles of the means that bound an interval.
DRAWS, PERCENTILES = 20_000, (2.5, 97.5)
#: Value that a row must have, or a test of it.
Wanted = Any


@dataclass(frozen=True)
class Column:
    """What the cells of a column show: a measure of the rows that the line and the column want."""

    title: str
    measure: str
    """A column of the CSV file; two columns with ``/`` between them."""
    where: Mapping[str, Wanted] = field(default_factory=dict)
    how: str = "mean"
    """mean, sum or max of the rows; count (of those whose measure is what stands behind ``=``); quotient of two
    measures' sums; or a comparison with their peers: difference, interval (that with its 95 % interval), ratio (mean of
    ratios), ratio interval (ratio of means with its 95 % interval)."""
    form: str = ""
    """Format of a number; by default that of the measure."""
    against: Mapping[str, Any] | Callable[[Row], Mapping[str, Any]] = field(default_factory=dict)
    """How a row's peer differs from it. Without it, that of the line."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Method of the line -> its name in the rows of this column."""


@dataclass(frozen=True)
class Line:
    """A line's first cells, the rows that it is about, and their peers."""

    cells: Sequence[str]
    where: Mapping[str, Wanted]
    against: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """A table of a page."""

    sources: Sequence[str]
    """CSV files. A row's column ``source`` is the name of its file."""
    keys: Sequence[str]
    """Columns that tell the rows of a file apart."""
    head: Sequence[str]
    """Titles of the lines' first cells."""
    lines: Sequence[Line] | Sequence[str]
    """The lines; or names of columns: then each combination of their values is a line."""
    columns: Sequence[Column]
    means: bool = False
    """Say which scenes means are over."""

    def text(self) -> str:
        """Lay the table out, with what its rows were measured with."""
        rows = [row | {"source": name} for name in self.sources for row in results.read(name)]
        for row in rows:
            row["family"] = re.sub(r"-x\d$", "", row.get("method", ""))
        peers = results.index(rows, "source", *self.keys)
        used: list[Row] = []
        body = []
        for line in self._lines(rows):
            cells = [self._cell(column, line, rows, peers, used) for column in self.columns]
            if any(cells):
                body.append([*line.cells, *cells])
        text = results.markdown([*self.head, *(column.title for column in self.columns)], body)
        first = [row for row in rows if row["source"] == self.sources[0]]
        return f"{text}\n{accuracy.mean_note(first) + ' ' if self.means else ''}{results.stamp_note(used)}\n"

    def _lines(self, rows: Sequence[Row]) -> Iterator[Line]:
        for line in self.lines:
            if isinstance(line, Line):
                yield line
        names = [name for name in self.lines if isinstance(name, str)]
        for values in dict.fromkeys(tuple(row.get(name) for name in names) for row in rows) if names else ():
            yield Line([label(value) for value in values], dict(zip(names, values, strict=True)))

    def _cell(self, column: Column, line: Line, rows: Sequence[Row], peers: Mapping[Any, Row], used: list[Row]) -> str:
        wanted = {**line.where, **column.where}
        if "method" in wanted and column.renamed:
            wanted["method"] = column.renamed.get(wanted["method"], wanted["method"])
        chosen = [row for row in results.where(rows, **wanted) if all(name in row for name in _measures(column))]
        if not chosen:
            return ""
        against = column.against or line.against
        if column.how not in ("difference", "interval", "ratio", "ratio interval"):
            used += chosen
            return _summary(column, chosen)
        keys = ("source", *self.keys)
        changed = [(row, {**row, **(against(row) if callable(against) else against)}) for row in chosen]
        pairs = [(row, peers.get(tuple(peer.get(name) for name in keys))) for row, peer in changed]
        compared = [(row, peer) for row, peer in pairs if peer is not None and column.measure in peer]
        if len(compared) < len(pairs) or all(row == peer for row, peer in pairs):
            return ""
        used += itertools.chain.from_iterable(compared)
        return _comparison(column, compared)


def _measures(column: Column) -> list[str]:
    return column.measure.partition("=")[0].split("/")


def _summary(column: Column, rows: Sequence[Row]) -> str:
    """Return a measure of some rows as text."""
    columns = [[row[name] for row in rows] for name in _measures(column)]
    if column.how == "count":
        _, _, wanted = column.measure.partition("=")
        return str(sum(not wanted or value == wanted for value in columns[0]))
    if column.how == "quotient":
        return column.form.format(sum(columns[0]) / sum(columns[1]))
    functions: dict[str, Callable[[list[float]], Any]] = {"mean": np.mean, "sum": np.sum, "max": np.max}
    reduced = functions[column.how]
    cells = []
    for measure, values in zip(_measures(column), columns, strict=True):
        value, known = float(reduced(values)), measure in accuracy.MEASURES and not column.form
        cells.append(accuracy.cell(measure, value) if known else (column.form or "{:.2f}").format(value))
    return " / ".join(cells)


def _comparison(column: Column, pairs: Sequence[tuple[Row, Row]]) -> str:
    """Return a comparison of rows with their peers as text."""
    ours, theirs = (np.array([pair[side][column.measure] for pair in pairs], float) for side in (0, 1))
    differences = ours - theirs
    if column.how == "interval":
        return _with_ends(with_interval(differences), "+.2f")
    if column.how == "difference":
        return (column.form or "{:+.2f}").format(float(differences.mean()))
    if column.how == "ratio interval":
        return _with_ends(ratio_with_interval(ours, theirs), ".2f")
    return (column.form or "{:.2f}").format(float((ours / theirs).mean()))


def with_interval(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the mean of one value for each scene, and the ends of its interval."""
    return float(values.mean()), *_ends(values[_draws(len(values))].mean(axis=1))


def ratio_with_interval(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the ratio of the means of two methods' values, one for each scene, and the ends of its interval."""
    drawn = _draws(len(ours))
    return float(ours.mean() / theirs.mean()), *_ends(ours[drawn].mean(axis=1) / theirs[drawn].mean(axis=1))


@functools.cache
def _draws(count: int) -> NDArray[np.int64]:
    """Return the indices of the drawn scenes, (DRAWS, count), equal in every run."""
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


def _ends(means: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(means, PERCENTILES)
    return float(low), float(high)


def _with_ends(value: tuple[float, float, float], form: str) -> str:
    middle, low, high = (format(number, form) for number in value)
    return f"{middle} ({low} to {high})"


def label(value: Any) -> str:
    """Return a value as the first cell of a line: a model's name as code."""
    text = "" if value is None else str(value)
    return f"`{text}`" if results.model_of(text) else text


def clean(scene: str) -> bool:
    """Return whether this is a scene that means are over."""
    return scene != MEAN and scene not in NOISY_REFERENCE
