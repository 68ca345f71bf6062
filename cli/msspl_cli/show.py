# SPDX-License-Identifier: Apache-2.0
"""Text tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def table(rows: Sequence[Sequence[str]], indent: str = "  ") -> None:
    """Print rows with their columns aligned."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print((indent + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))).rstrip())


def aov_table(rows: Sequence[Mapping[str, str]], notes: Sequence[str]) -> None:
    """What each feature is read from: ``table()`` and ``notes`` of a :class:`~oiio_msspl.aovs.mapped_render.MappedRender`."""
    table([(r["feature"], r["status"], r["source"] + (f" ({r['note']})" if r["note"] else "")) for r in rows])
    for note in notes:
        print(f"  note: {note}")
