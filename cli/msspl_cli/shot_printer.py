# SPDX-License-Identifier: Apache-2.0
"""Prints a shot: progress for people and for programs while it runs, and a table at its end."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

from msspl_cli import console
from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from oiio_msspl.jobs.shot_report import FrameResult, ShotReport

#: The forms of ``--progress``, which prints to standard output before the first frame is fused and after each frame.
PROGRESS = ("openjd", "json")


class ShotPrinter:
    """The ``progress`` of :func:`oiio_msspl.jobs.shot.fuse_shot`: prints errors and warnings as frames end.

    Of sentences that differ only in their numbers, the first is printed. The table at the end counts their frames.

    Raises:
        InputError: an unknown form of progress, or one that would mix with ``--json``.
    """

    def __init__(self, verbose: int, quiet: bool, as_json: bool, progress: str | None) -> None:
        if progress is not None and progress not in PROGRESS:
            raise InputError(f"--progress {progress!r}: use one of {', '.join(PROGRESS)}")
        if progress is not None and as_json:
            raise InputError("--json and --progress both print to standard output; use --report FILE for the report")
        self._verbose, self._quiet, self._as_json, self._progress = verbose, quiet, as_json, progress
        self._bar = console.ProgressBar(shown=not verbose and not quiet and progress is None)
        self._report: ShotReport | None = None
        self._printed: set[str] = set()

    def begin(self, report: ShotReport) -> None:
        """Print what was found and what will be done, before the first frame is fused."""
        if self._progress == "json":
            print(json.dumps({"found": report.found, "temporal": report.temporal}), flush=True)
        if self._as_json or self._quiet or self._progress == "json":
            return
        if found := report.found:
            views = console.views_in_words(found["views"])
            pairs = "Pairs" if found["renderer"] == "unknown" else f"{found['renderer']} pairs"
            pairs += f" at x{found['scale']}, {found['model']}"
            console.say(f"{pairs}{views}; layers of frame {found['frame']}:")
            console.aov_table(found["aovs"], found["notes"])
            for name, layers in found["sets"].items():
                console.say(f"  {name}: fused if they sum to the beauty: {layers}")
        if report.temporal:
            console.say(f"Fuses {report.temporal}")

    def __call__(self, result: FrameResult, report: ShotReport) -> None:
        """Print the progress, the errors and the warnings of a frame that ended."""
        self._report = report
        done, count = len(report.results), len(report.shot.frames)
        if self._progress == "openjd":
            console.say(f"openjd_progress: {100 * done / count:.1f}")
            console.say(f"openjd_status: frame {result.frame} {result.status}, {done} of {count} done")
            if result.message:
                console.say(f"openjd_fail: frame {result.frame}: {result.message}")
        elif self._progress == "json":
            line = {name: getattr(result, name) for name in ("frame", "status", "message", "warnings", "output")}
            print(json.dumps({**line, "done": done, "count": count}), flush=True)
        if result.message:
            self._print_once("error", result.frame, result.message)
        for warning in () if self._quiet else result.warnings:
            self._print_once("warning", result.frame, warning)
        if self._verbose:
            times = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in result.seconds.items())
            console.say(f"frame {result.frame}: {result.status}" + (f" ({times})" if times else ""), error=True)
        bad = sum(bool(ended.message) for ended in report.results.values())
        self._bar.update(f"{done} of {count} frames" + (f", {bad} not fused" if bad else ""), done, count)

    def end(self) -> None:
        """Print the table, or with ``--json`` the report, of the frames that were reached."""
        self._bar.hide()
        if self._report is None:
            return
        if self._as_json:
            print(json.dumps(self._report.as_dict(), indent=2))
        elif not self._quiet and self._progress != "json":
            _print_table(self._report)

    def _print_once(self, kind: str, frame: int, text: str) -> None:
        if (key := _without_numbers(text)) not in self._printed:
            self._printed.add(key)
            console.say(f"{kind}: frame {frame}: {text}", error=True)


def _without_numbers(text: str) -> str:
    """Replace the numbers of a sentence, which differ between the frames of a shot."""
    return re.sub(r"-?[\d.]+", "0", text)


def _print_table(report: ShotReport) -> None:
    """Print what became of passes, and which frames ended in which way and why."""
    from oiio_msspl.jobs.sequence import format_frames

    for name, outcome in (report.first or {}).get("passes", {}).items():
        console.say(f"{name}: {outcome}")
    if report.temporal and any(result.status == "fused" for result in report.results.values()):
        console.say(f"Fused {report.temporal_text}")
    # Sentences that differ only in their numbers share a row, which shows the first of them.
    groups: dict[tuple[str, str], tuple[list[int], str]] = {}
    for frame in report.shot.frames:
        result = report.results.get(frame.number)
        rows = [(result.status, result.message)] if result else [("not done", "run again with --skip-existing")]
        rows += [("warning", text) for text in (result.warnings if result else ())]
        for kind, text in rows:
            numbers, _ = groups.setdefault((kind, _without_numbers(text)), ([], text))
            if frame.number not in numbers[-1:]:
                numbers.append(frame.number)
    order = ("fused", "skipped", "failed", "missing", "not done", "warning")
    rows_in_order = sorted(groups.items(), key=lambda item: order.index(item[0][0]))
    print("frames")
    console.table([(kind, str(len(n)), format_frames(n), text) for (kind, _), (n, text) in rows_in_order])
    verbs = {"read": "reading", "fuse": "fusing", "write": "writing"}
    stages = ", ".join(
        f"{verbs[name]} {seconds:.1f} s" for name, seconds in report.stage_seconds.items() if name in verbs
    )
    console.say(f"{report.shot.output}: {report.seconds:.1f} s" + (f" ({stages}; stages overlap)" if stages else ""))
