# SPDX-License-Identifier: Apache-2.0
"""What is said of a shot: while it goes on, to people and to programs, and the table at its end."""

from __future__ import annotations

import json
import re
import sys
from typing import TYPE_CHECKING, Any

import typer

from msspl_cli import show
from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from oiio_msspl.jobs.shot import FrameResult, ShotReport

#: What --progress prints to standard output after each frame.
PROGRESS = ("openjd", "json")


class ShotPrinter:
    """Told of each frame as it ends; an error or warning is said at once, and the same words only once."""

    def __init__(self, verbose: int, quiet: bool, as_json: bool, progress: str | None) -> None:
        if progress is not None and progress not in PROGRESS:
            raise InputError(f"--progress {progress!r}: use one of {', '.join(PROGRESS)}")
        if progress is not None and as_json:
            raise InputError("--json and --progress both print to standard output; use --report FILE for the report")
        self.verbose, self.quiet, self.progress = verbose, quiet, progress
        self.as_json = as_json
        self.tables = not quiet and not as_json and progress != "json"
        self.report: ShotReport | None = None
        self._said: set[str] = set()
        self._bar: Any = None

    def __call__(self, result: FrameResult, report: ShotReport) -> None:
        self.report = report
        if self.progress == "openjd":
            _print_openjd(result, report)
        elif self.progress == "json":
            _print_json(result, report)
        if result.message:
            self._say("error", result.frame, result.message)
        for warning in () if self.quiet else result.warnings:
            self._say("warning", result.frame, warning)
        if self.verbose:
            times = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in result.seconds.items())
            self._line(f"frame {result.frame}: {result.status}" + (f" ({times})" if times else ""))
        elif not self.quiet and self.progress is None and sys.stderr.isatty():
            self._advance(report)

    def end(self) -> None:
        """Print the table, or the report for machines, of the frames that were reached."""
        if self._bar is not None:
            self._bar.render_finish()
        if self.report is not None and self.as_json:
            print(json.dumps(self.report.as_dict(), indent=2))
        if self.report is not None and self.tables:
            print_table(self.report)

    def _say(self, kind: str, frame: int, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._line(f"{kind}: frame {frame}: {text}")

    def _line(self, text: str) -> None:
        # On a terminal the bar's line is wiped first; it is drawn again after the frame.
        print(("\r\033[K" if self._bar is not None else "") + text, file=sys.stderr)

    def _advance(self, report: ShotReport) -> None:
        if self._bar is None:
            self._bar = typer.progressbar(length=len(report.shot.frames), show_pos=True, file=sys.stderr)
        bad = sum(bool(result.message) for result in report.results.values())
        self._bar.label = "fusing" + (f", {bad} not" if bad else "")
        self._bar.update(len(report.results) - self._bar.pos)


def _print_openjd(result: FrameResult, report: ShotReport) -> None:
    """Lines that an Open Job Description worker understands."""
    done, count = len(report.results), len(report.shot.frames)
    print(f"openjd_progress: {100 * done / count:.1f}")
    print(f"openjd_status: frame {result.frame} {result.status}, {done} of {count} done", flush=True)
    if result.message:
        print(f"openjd_fail: frame {result.frame}: {' '.join(result.message.split())}", flush=True)


def _print_json(result: FrameResult, report: ShotReport) -> None:
    line = {name: getattr(result, name) for name in ("frame", "status", "message", "warnings", "output")}
    print(json.dumps({**line, "done": len(report.results), "count": len(report.shot.frames)}), flush=True)


def print_table(report: ShotReport) -> None:
    """Which layers were read, and how many frames, and which, ended how and why."""
    from oiio_msspl.jobs.sequence import format_frames

    if report.first is not None:
        print(
            f"{report.first['renderer']} pairs at x{report.first['scale']}, read as in frame {report.first['frame']}:"
        )
        show.aov_table(report.first["aovs"], report.first["notes"])
    # Sentences that differ only in their numbers (a frame's own among them) share a row, which shows the first.
    groups: dict[tuple[str, str], tuple[list[int], str]] = {}
    for frame in report.shot.frames:
        result = report.results.get(frame.number)
        rows = [(result.status, result.message)] if result else [("not done", "run again with --skip-existing")]
        rows += [("warning", text) for text in (result.warnings if result else ())]
        for kind, text in rows:
            groups.setdefault((kind, re.sub(r"-?[\d.]+", "0", text)), ([], text))[0].append(frame.number)
    order = ("fused", "skipped", "failed", "missing", "not done", "warning")
    rows_in_order = sorted(groups.items(), key=lambda item: order.index(item[0][0]))
    print("frames")
    show.table([(kind, str(len(n)), format_frames(n), text) for (kind, _), (n, text) in rows_in_order])
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in report.stage_seconds.items() if name != "network")
    print(f"{report.shot.output}: {report.seconds:.1f} s" + (f" ({stages} s, overlapping)" if stages else ""))
