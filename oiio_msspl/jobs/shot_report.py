# SPDX-License-Identifier: Apache-2.0
"""Reports on a shot and on each of its frames, in memory and as a JSON file."""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl._version import full_version
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_target, replacing
from oiio_msspl.findings import Finding, codes_of
from oiio_msspl.jobs.sequence import FrameFiles, Shot
from oiio_msspl.model.digests import as_text

#: The keys that are read of ``first_fused`` in an earlier report. If a report of another version lacks some of them,
#: frames are compared with the first one that this run fuses.
FIRST_FUSED = {
    *("frame", "neighbours", "renderer", "view", "size", "scale", "model", "weights", "version"),
    *("aovs", "layers", "notes", "passes"),
}

#: What a frame's result has of its report, beside warnings.
_OF_FRAME = ("aovs", "layers", "passes", "repaired", "seconds", "frames_counted")

#: A frame stands alone if a pixel counts fewer frames than this, in the mean.
ALONE = 1.1

#: The most layers that a warning names.
MOST_NAMES = 6

#: The code of the warning that a result is older than a file that it is made from.
OLDER = "older"

FUSED, SKIPPED, FAILED, MISSING = STATUSES = ("fused", "skipped", "failed", "missing")


@dataclass
class FrameResult:
    """The result of a frame."""

    frame: int
    status: str
    """``fused``; ``skipped``: its EXR existed; ``failed``; ``missing``: its LRHS or HRLS does not exist."""
    message: str = ""
    """Why the frame was not fused."""
    exit_code: int = 0
    """0, 2 for the caller's mistake, or 1 for any other failure."""
    warnings: list[Finding] = field(default_factory=list)
    """What is wrong with it. Each is a sentence with a ``code``, see ``docs/api.md``."""
    aovs: list[dict[str, str]] = field(default_factory=list)
    """What the features of the HRLS were read from: ``feature``, ``status``, ``source`` and ``note``."""
    layers: list[str] = field(default_factory=list)
    """The layers that were written beside the beauty, see :attr:`.FrameReport.layers`."""
    passes: dict[str, str] = field(default_factory=dict)
    """What was done with each set of passes, by name."""
    repaired: dict[str, int] = field(default_factory=dict)
    """Number of values that were NaN or infinite, by layer."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds by stage, as in :class:`oiio_msspl.jobs.report.FrameReport`. Neighbouring frames overlap in time."""
    frames_counted: float | None = None
    """How many frames a pixel is the mean of, in the mean over the frame; None if nothing was averaged."""
    lrhs: str | None = None
    hrls: str | None = None
    output: str = ""

    @property
    def codes(self) -> list[str]:
        """The code of each warning."""
        return codes_of(self.warnings)


@dataclass(repr=False)
class ShotReport:
    """The results of a shot's frames."""

    shot: Shot
    results: dict[int, FrameResult] = field(default_factory=dict)
    """Results by frame number. A frame that the run has not reached has no entry."""
    others: list[dict[str, Any]] = field(default_factory=list)
    """Entries of an earlier report about frames that are not in this run."""
    first: dict[str, Any] | None = None
    """The whole report of the first fused frame: scale, model and the layers that were read."""
    found: dict[str, Any] | None = None
    """What was found before the first frame: ``frame``, ``renderer``, ``scale``, ``model``, ``aovs``, ``notes``,
    ``views`` and ``sets`` (layers by name) of the first pair that can be read."""
    seconds: float = 0.0
    """Wall time."""
    temporal: str = ""
    """A sentence on the neighbours that frames are averaged with, and how motion is known; empty if switched off."""
    neighbours: int = 0
    """Frames before and after a frame that it is averaged with."""
    warnings: list[Finding] = field(default_factory=list)
    """What is wrong with the whole shot; those of a frame are in its result."""

    def __repr__(self) -> str:
        """Return one line; :meth:`as_dict` has everything."""
        counts = Counter(result.status for result in self.results.values())
        return f"<{self.shot.output}: {', '.join(f'{counts[status]} {status}' for status in counts) or 'no frames'}>"

    @property
    def codes(self) -> set[str]:
        """The codes of all warnings, about the shot and about its frames, see ``docs/api.md``."""
        return {code for result in self.results.values() for code in result.codes}.union(codes_of(self.warnings))

    @property
    def exit_code(self) -> int:
        """0 if every frame is fused or was skipped; otherwise 1 if any frame has exit code 1, and 2 if none has."""
        codes = {result.exit_code for result in self.results.values()}
        return 1 if 1 in codes else max(codes, default=0)

    @property
    def frames_counted(self) -> float | None:
        """The mean of this number over the frames; None if nothing was averaged."""
        counts = [result.frames_counted for result in self.results.values() if result.frames_counted is not None]
        return sum(counts) / len(counts) if counts else None

    @property
    def temporal_text(self) -> str:
        """``temporal``, and how many frames really counted."""
        counted = self.frames_counted
        return self.temporal + ("" if counted is None else f"; in the mean, a pixel counts {counted:.1f} frames")

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds spent in each stage, summed over the fused frames. Stages overlap: the sum exceeds the wall time."""
        total: Counter[str] = Counter()
        for result in self.results.values():
            if result.status == FUSED:
                total.update(result.seconds)
        return dict(total)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        results = [self.results[files.number] for files in self.shot.frames if files.number in self.results]
        entries = [*self.others, *({**asdict(result), "warning_codes": result.codes} for result in results)]
        count = len(self.shot.frames) + len(self.others)
        counts = Counter(entry.get("status") for entry in entries)
        finished = len(self.results) == len(self.shot.frames)
        return {
            "lrhs": None if self.shot.has_one_render else str(self.shot.lr.pattern),
            "hrls": str(self.shot.hr.pattern),
            "output": os.path.abspath(str(self.shot.output)),  # a run that resumes may have another working directory
            "finished": finished,
            "exit_code": self.exit_code if finished else None,
            "counts": {"all": count, **{status: counts[status] for status in STATUSES}},
            "seconds": {k: round(v, 3) for k, v in {"wall": self.seconds, **self.stage_seconds}.items()},
            "temporal": self.temporal,
            "warnings": self.warnings,
            "warning_codes": codes_of(self.warnings),
            "frames_counted": None if self.frames_counted is None else round(self.frames_counted, 2),
            "first_fused": self.first,
            "frames": entries,
            "version": full_version(),
        }

    def save(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all: a killed run leaves the report of its last saved frame.

        Raises:
            MssplError: the file system refused.
        """
        with replacing(path, overwrite=True) as temporary:
            temporary.write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")


def result_of(frame: FrameFiles, status: str, message: str = "", exit_code: int = 0, **more: Any) -> FrameResult:
    """Return the result of a frame with its three paths; ``more`` are other fields of :class:`FrameResult`."""
    low = None if frame.lr == frame.hr else frame.lr
    lrhs, hrls = (None if path is None else str(path) for path in (low, frame.hr))
    return FrameResult(frame.number, status, message, exit_code, lrhs=lrhs, hrls=hrls, output=str(frame.output), **more)


def fused_result(frame: FrameFiles, frame_report: dict[str, Any], report: ShotReport) -> FrameResult:
    """Return the result of a fused frame, which becomes ``report.first`` if it is the first one.

    A difference to the first fused frame that may flicker gives a warning. ``frame_report`` is that of
    :meth:`oiio_msspl.jobs.report.FrameReport.as_dict`.
    """
    here = {"frame": frame.number, "neighbours": report.neighbours, **frame_report}
    first = report.first = report.first or here
    warnings, repaired = list(frame_report["warnings"]), frame_report["repaired"]
    if repaired:
        warnings.append(Finding("repaired", f"repaired values that were NaN or infinite in {', '.join(repaired)}"))
    counted = frame_report["frames_counted"]
    if counted is not None and counted < ALONE:
        text = "its neighbours hardly count: their light or their surfaces differ from those of this frame"
        warnings.append(Finding("neighbours_differ", text))
    for changed in (_changed_settings, _changed_layers, _changed_sets):
        texts = [f"{text} in frame {first['frame']}: it may flicker" for text in changed(here, first)]
        warnings += [Finding("flicker", text) for text in texts]
    return result_of(frame, FUSED, warnings=warnings, **{name: frame_report[name] for name in _OF_FRAME})


def _changed_settings(here: dict[str, Any], first: dict[str, Any]) -> list[str]:
    """Compare all but layers and passes: "WHAT is X here and Y" for each difference between two reports."""
    words = {"default": "not found", "absent": "not found"}
    before, now = (
        {row["feature"]: words.get(row["status"], row["status"]) for row in report["aovs"] if row["status"] != "unused"}
        for report in (first, here)
    )
    pairs = {feature: (now[feature], before[feature]) for feature in now if feature in before}
    pairs["the frame"] = here["size"], first["size"]
    pairs["the scale"] = f"x{here['scale']}", f"x{first['scale']}"
    if here["scale"] == first["scale"]:  # each scale has models of its own
        pairs["the model"] = here["model"], first["model"]
    if here["model"] == first["model"]:
        pairs["the digest of its weights"] = as_text(here["weights"]), as_text(first["weights"])
    pairs["the version"] = here["version"], first["version"]
    pairs["--temporal"] = str(here["neighbours"] or "off"), str(first["neighbours"] or "off")
    # The report on a file with only one view has an empty list.
    entries = [report.get("fused_views") or [report] for report in (here, first)]
    now_fused, before_fused = ([name_of(entry["view"] or "") for entry in views] for views in entries)
    if max(len(now_fused), len(before_fused)) > 1:
        pairs |= {view: ("not fused", "fused") for view in before_fused if view not in now_fused}
        pairs |= {view: ("fused", "not fused") for view in now_fused if view not in before_fused}
    return [f"{what} is {state} here and {earlier}" for what, (state, earlier) in pairs.items() if state != earlier]


def _changed_layers(here: dict[str, Any], first: dict[str, Any]) -> list[str]:
    """Compare the layers that are written. Those that are features are told as such."""
    features = {row["source"] for report in (here, first) for row in report["aovs"] if row["status"] == "found"}
    texts = []
    for has, lacks, states in ((first, here, "missing here and present"), (here, first, "present here and missing")):
        names = [name for name in has["layers"] if name not in lacks["layers"] and name not in features]
        if names:
            listed = ", ".join(names[:MOST_NAMES]) + (", ..." if len(names) > MOST_NAMES else "")
            texts.append(f"the layer{'s' * (len(names) > 1)} {listed} {'are' if len(names) > 1 else 'is'} {states}")
    return texts


def _changed_sets(here: dict[str, Any], first: dict[str, Any]) -> list[str]:
    """Compare what was done with each set of passes, by name; with the reason if one is not fused."""
    texts = []
    both = here["passes"], first["passes"]
    for name in dict.fromkeys([*first["passes"], *here["passes"]]):
        (state, reason), (before, _) = (sets.get(name, "missing").partition(": ")[::2] for sets in both)
        if state != before:
            because = f" ({reason})" if reason and state != "fused" else ""
            texts.append(f"{name}: {state} here{because} and {before}")
    return texts


def read_earlier(
    report: ShotReport, path: Path | None, overwrite: bool, skip_existing: bool
) -> dict[int, dict[str, Any]]:
    """Read the report of the run that ``skip_existing`` resumes, and check that a report can be written.

    It gives the shot's report its ``first`` and ``others``. Not even with ``overwrite`` is a render replaced by a
    report.

    Returns:
        What the earlier report says of each frame, without the warnings that it is older than an input, which each run
        finds out anew.
    """
    if path is None:
        return {}
    if path.is_file() and not (overwrite or skip_existing):
        raise InputError(f"{path}: exists; pass --skip-existing to go on with that run, or --overwrite to replace it")
    check_target(path, overwrite=overwrite or skip_existing)
    if not path.exists():
        return {}
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        entries = {}
        for entry in data["frames"]:
            coded = zip(entry["warning_codes"], entry["warnings"], strict=True)
            kept = [Finding(code, text) for code, text in coded if code != OLDER]
            entries[entry["frame"]] = {name: entry[name] for name in _OF_FRAME} | {"warnings": kept}
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
