# SPDX-License-Identifier: Apache-2.0
"""Prints tables and progress bars, which rich draws on a terminal.

In a pipe or a file a table is plain text with aligned columns: no colours, no boxes, and no line is wrapped. A progress
bar is drawn on a terminal only. Results go to standard output, messages and progress to standard error.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from oiio_msspl.errors import printable

if TYPE_CHECKING:
    from rich.console import Console

#: Columns of a console that is no terminal: wider than any row.
_UNLIMITED = 100_000

#: Colours of the words that say how a frame ended.
_STYLES = {"fused": "green", "failed": "red", "missing": "red", "not done": "yellow", "warning": "yellow"}


def say(text: str, *, error: bool = False) -> None:
    """Print a line, on standard error if it is an ``error``. Control characters in names out of a file are escaped."""
    print(printable(text), file=sys.stderr if error else sys.stdout, flush=True)


def table(rows: Sequence[Sequence[str]], *, header: bool = False, indent: int = 2) -> None:
    """Print rows of equally many cells, as aligned columns. With ``header``, the first row holds the titles."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = _console(stderr=False)
    grid = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    # rich would fold the cells before an empty column.
    filled = [column for column in range(len(rows[0])) if any(row[column] for row in rows)]
    for _ in filled:
        grid.add_column(overflow="fold")
    for index, row in enumerate(rows):
        style = "bold" if header and index == 0 else ""
        grid.add_row(
            *(Text(printable(row[column]), style=_STYLES.get(row[column], "")) for column in filled), style=style
        )
    with console.capture() as captured:
        console.print(Padding.indent(grid, indent))
    for line in captured.get().splitlines():
        print(line.rstrip())


def aov_table(rows: Sequence[Mapping[str, str]], notes: Sequence[str]) -> None:
    """Print the rows of :meth:`.MappedRender.table`: which layer each feature is read from. Notes follow below."""
    from oiio_msspl.aovs.mapped_render import origin

    table([(row["feature"], origin(row)) for row in rows])
    for note in notes:
        say(f"  note: {note}")


def views_in_words(names: Sequence[str]) -> str:
    """Continue a sentence with the views that were fused, if there are several in the file."""
    return f", view{'s' if len(names) > 1 else ''} {', '.join(names)}" if names else ""


class ProgressBar:
    """A progress bar for a ``with`` statement. It appears on standard error at the first update, on a terminal only."""

    def __init__(self, shown: bool = True) -> None:
        self.shown = shown and sys.stderr.isatty()
        self._progress: Any = None
        self._task: Any = None

    def update(self, label: str, done: float, total: float) -> None:
        """Show ``done`` of ``total`` beside a label."""
        if not self.shown:
            return
        if self._progress is None:
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

            self._progress = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TaskProgressColumn(),
                TimeRemainingColumn(compact=True),
                console=_console(stderr=True),
                transient=True,
                redirect_stdout=False,  # standard output may be a file
            )
            self._task = self._progress.add_task(label)
            self._progress.start()
        self._progress.update(self._task, description=printable(label), completed=done, total=total)

    def hide(self) -> None:
        """Remove the bar from the terminal. The next update draws it again."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self.hide()


def _console(*, stderr: bool) -> Console:
    """Make a console that prints text as it is, because rich would take brackets in layer names for markup."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else _UNLIMITED
    return Console(stderr=stderr, width=width, markup=False, highlight=False, emoji=False)
