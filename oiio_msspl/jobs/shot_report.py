# SPDX-License-Identifier: Apache-2.0
"""Reports what became of a shot and of each of its frames, in memory and as a JSON file."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl._version import __version__
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_target, replacing
from oiio_msspl.jobs.sequence import FrameFiles, Shot

#: What is read of ``first_fused`` in an earlier report. A report of another version may lack some of it.
FIRST_FUSED = {"frame", "renderer", "view", "scale", "model", "aovs", "notes", "passes"}

#: A warning about layers names so many of them.
MOST_NAMES = 6

#: Bytes of the largest file that is read as an earlier report. A frame takes one or two thousand.
LARGEST_REPORT = 128 << 20

#: What :func:`older_than` returns.
_OLDER = re.compile(r"is older than .*; --update fuses such frames again", re.DOTALL)

FUSED, SKIPPED, FAILED, MISSING = STATUSES = ("fused", "skipped", "failed", "missing")


@dataclass
class FrameResult:
    """What became of one frame."""

    frame: int
    status: str
    """``fused``; ``skipped``: its EXR existed; ``failed``; ``missing``: its LRHS or HRLS does not exist."""
    message: str = ""
    """Why it was not fused."""
    exit_code: int = 0
    """0, 2 for the caller's mistake, or 1 for any other failure."""
    warnings: list[str] = field(default_factory=list)
    repaired: dict[str, int] = field(default_factory=dict)
    """Number of values that were NaN or infinite, by layer, see :class:`oiio_msspl.fusion.fuse.FusedFrame`."""
    seconds: dict[str, float] = field(default_factory=dict)
    """As in :class:`oiio_msspl.jobs.report.FrameReport`. Neighbouring frames overlap in time."""
    lrhs: str | None = None
    hrls: str | None = None
    output: str = ""


@dataclass
class ShotReport:
    """What became of a shot."""

    shot: Shot
    results: dict[int, FrameResult] = field(default_factory=dict)
    """By frame number. A frame that the run has not reached has no entry."""
    others: list[dict[str, Any]] = field(default_factory=list)
    """Entries of an earlier report about frames that are not in this run."""
    first: dict[str, Any] | None = None
    """The whole report of the first fused frame: scale, model and the layers that were read."""
    seconds: float = 0.0
    """Wall time."""
    temporal: str = ""
    """Which neighbours frames are averaged with, and how motion is known; empty if that is switched off."""
    neighbours: int = 0
    """Frames before and after each that it is averaged with."""

    @property
    def exit_code(self) -> int:
        """0 if every frame is fused or was skipped; otherwise 1 if any frame has exit code 1, and 2 if none has."""
        codes = {result.exit_code for result in self.results.values()}
        return 1 if 1 in codes else max(codes, default=0)

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds spent in each stage, summed over the fused frames. Stages overlap: the sum exceeds the wall time."""
        total: Counter[str] = Counter()
        for result in self.results.values():
            if result.status == FUSED:
                total.update(result.seconds)
        return dict(total)

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON values."""
        entries = [asdict(self.results[f.number]) for f in self.shot.frames if f.number in self.results]
        entries = [*self.others, *entries]
        count = len(self.shot.frames) + len(self.others)
        counts = Counter(entry.get("status") for entry in entries)
        finished = len(self.results) == len(self.shot.frames)
        return {
            "lrhs": str(self.shot.lr.pattern),
            "hrls": str(self.shot.hr.pattern),
            "output": os.path.abspath(str(self.shot.output)),  # a run that resumes may have another working directory
            "finished": finished,
            "exit_code": self.exit_code if finished else None,
            "counts": {"all": count, **{status: counts[status] for status in STATUSES}},
            "seconds": {k: round(v, 3) for k, v in {"wall": self.seconds, **self.stage_seconds}.items()},
            "temporal": self.temporal,
            "first_fused": self.first,
            "frames": entries,
            "version": __version__,
        }

    def save(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all: a killed run leaves the report of its last saved frame.

        Raises:
            MssplError: the file system refused.
        """
        with replacing(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")


def result_of(frame: FrameFiles, status: str, message: str = "", exit_code: int = 0, **more: Any) -> FrameResult:
    """The result of a frame with its three paths filled in; ``more`` are other fields of :class:`FrameResult`."""
    lrhs, hrls = (None if path is None else str(path) for path in (frame.lr, frame.hr))
    return FrameResult(frame.number, status, message, exit_code, lrhs=lrhs, hrls=hrls, output=str(frame.output), **more)


def fused_result(frame: FrameFiles, frame_report: dict[str, Any], report: ShotReport) -> FrameResult:
    """The result of a fused frame. The first one becomes ``report.first``.

    Args:
        frame: the frame.
        frame_report: its :meth:`oiio_msspl.jobs.report.FrameReport.as_dict`.
        report: of the shot. What differs from the first fused frame and may flicker gives a warning, see
            :func:`_differences`.
    """
    here = {"frame": frame.number, "neighbours": report.neighbours, **frame_report}
    first = report.first = report.first or here
    warnings = list(frame_report["warnings"])
    if frame_report["repaired"]:
        warnings.append(f"repaired values that were NaN or infinite in {', '.join(frame_report['repaired'])}")
    warnings += [f"{text} in frame {first['frame']}: it may flicker" for text in _differences(here, first)]
    return result_of(
        frame, FUSED, warnings=warnings, repaired=frame_report["repaired"], seconds=frame_report["seconds"]
    )


def _differences(here: dict[str, Any], first: dict[str, Any]) -> list[str]:
    """What differs between the reports of two fused frames: "WHAT is X here and Y" for each feature, the scale, the
    model, the number of neighbours, the layers, the views and the sets of passes."""
    statuses = {row["feature"]: row["status"] for row in first["aovs"]}
    changes = {
        row["feature"]: (row["status"], statuses[row["feature"]]) for row in here["aovs"] if row["feature"] in statuses
    }
    changes["the scale"] = f"x{here['scale']}", f"x{first['scale']}"
    if here["scale"] == first["scale"]:  # each scale has models of its own
        changes["the model"] = here["model"], first["model"]
    if "neighbours" in first:  # those of earlier versions lack it
        changes["--temporal"] = str(here["neighbours"] or "off"), str(first["neighbours"] or "off")
    words = {"default": "not found", "absent": "not found"}
    found = []
    for what, states in changes.items():
        own, its = (words.get(state, state) for state in states)
        if states[0] != states[1] and "unused" not in states:  # another model reads other features
            found.append(f"{what} is {own} here and {its}")
    return [
        *found,
        *_changed_layers(here, first),
        *_changed_views(here, first),
        *_changed_sets(here["passes"], first["passes"]),
    ]


def _changed_layers(here: dict[str, Any], first: dict[str, Any]) -> list[str]:
    """The same for the layers that are written, but for those that are told as features."""
    if "layers" not in first:
        return []  # of an earlier version
    features = {row["source"] for report in (here, first) for row in report["aovs"] if row["status"] == "found"}
    found = []
    for own, its, states in ((first, here, "missing here and present"), (here, first, "present here and missing")):
        names = [name for name in own["layers"] if name not in its["layers"] and name not in features]
        if names:
            listed = ", ".join(names[:MOST_NAMES]) + (", ..." if len(names) > MOST_NAMES else "")
            found.append(f"the layer{'s' * (len(names) > 1)} {listed} {'are' if len(names) > 1 else 'is'} {states}")
    return found


def _changed_views(here: dict[str, Any], first: dict[str, Any]) -> list[str]:
    """The same for the views that are fused."""
    # The report on a file with only one view has an empty list.
    own, its = (
        [name_of(each["view"] or "") for each in report.get("fused_views") or [report]] for report in (here, first)
    )
    if max(len(own), len(its)) == 1:
        return []
    lacking = [f"{view} is not fused here and fused" for view in its if view not in own]
    return lacking + [f"{view} is fused here and not fused" for view in own if view not in its]


def _changed_sets(here: dict[str, str], first: dict[str, str]) -> list[str]:
    """The same for the sets of passes, with the reason if one is not fused.

    Args:
        here, first: what was done with each set, by its name.
    """
    found = []
    for name in dict.fromkeys([*first, *here]):
        (own, reason), (its, _) = (each.get(name, "missing").partition(": ")[::2] for each in (here, first))
        if own != its:
            because = f" ({reason})" if reason and own != "fused" else ""
            found.append(f"{name}: {own} here{because} and {its}")
    return found


def read_earlier(
    report: ShotReport, path: Path | None, overwrite: bool, skip_existing: bool
) -> dict[int, dict[str, Any]]:
    """Read the report of the run that ``skip_existing`` resumes, and check that a report can be written.

    Args:
        report: gets ``first`` and ``others`` from the earlier report.
        path: the report's file; None for no report.
        overwrite, skip_existing: whether the file may exist.

    Returns:
        ``warnings``, ``repaired`` and ``seconds`` of each frame in the earlier report, without warnings that each run
        makes anew.

    Raises:
        InputError: the file exists and may not be replaced, or it is no report of this shot. An option that names the
            wrong file must not turn a render into a report, with ``--overwrite`` neither.
    """
    if path is None:
        return {}
    check_target(path, overwrite=overwrite or skip_existing)
    if not path.exists():
        return {}
    if path.stat().st_size > LARGEST_REPORT:
        raise InputError(f"{path}: exists and is too large for a report of a shot; name another file")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        entries = {
            entry["frame"]: {k: entry[k] for k in ("repaired", "seconds")} | {"warnings": _lasting(entry["warnings"])}
            for entry in data["frames"]
        }
        output = data.get("output")
        first = data["first_fused"]
        if skip_existing:
            numbers = {frame.number for frame in report.shot.frames}
            report.others = [entry for entry in data["frames"] if entry["frame"] not in numbers]
            if first is not None and first.keys() >= FIRST_FUSED:
                report.first = first
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: exists and is no report of a shot; name another file") from error
    if not skip_existing:
        return {}
    if isinstance(output, str) and os.path.realpath(output) != os.path.realpath(str(report.shot.output)):
        raise InputError(f"{path}: is the report of another shot, whose frames are {output}; name another file")
    return entries


def older_than(path: Path) -> str:
    """The warning that a result is older than a file that it is made from."""
    return f"is older than {path}; --update fuses such frames again"


def _lasting(warnings: list[str]) -> list[str]:
    """Those of an earlier report that are still true: whether an input is newer is found out in each run."""
    return [text for text in warnings if not _OLDER.fullmatch(text)]
