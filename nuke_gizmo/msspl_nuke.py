# SPDX-License-Identifier: Apache-2.0
"""Runs the gizmo's buttons. Only this module, init.py and menu.py import nuke.

A button runs in Nuke's main thread and starts a thread that watches msspl-fuse. Nodes may be touched in the main thread
only, so the watching thread calls ``nuke.executeInMainThread``.
"""

from __future__ import annotations

import os
import re
import tempfile
import textwrap
import threading
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import nuke
from msspl_bridge import FuseError
from msspl_bridge.command import Settings, build_command, clean_environment, find_program, split_words
from msspl_bridge.frame_files import FrameFile, ReadRange, file_numbers, find_number, name_output, parse_range
from msspl_bridge.passes import ATTRIBUTE, fused_sets
from msspl_bridge.process import Outcome, run

#: Nodes that change neither pixels nor time. They may stand between the Read and the gizmo.
_PASS_THROUGH = ("Dot", "NoOp", "PostageStamp")
#: What Nuke calls the file that a Read reads, in its metadata.
_FILE = "input/filename"
#: A hidden knob on the Read of a result. It holds the name of the node that made the Read.
_MADE_BY = "msspl_made_by"
#: Full names of the nodes that are fusing now.
_running: set[str] = set()


def fuse_frame(node: nuke.Node) -> None:
    """Fuse the current frame in the background."""
    _start(node, int(nuke.frame()))


def fuse_range(node: nuke.Node) -> None:
    """Fuse the frames of the range in the background."""
    _start(node)


def submit_range(node: nuke.Node) -> None:
    """Write the range as a job for a farm, and submit it, in the background."""
    _start(node, on_farm=True)


def rebuild(node: nuke.Node) -> None:
    """Make a group for each fused set, below the Read of the fused file, that builds the beauty from the layers."""
    try:
        with nuke.Undo("Rebuild from passes"), node.parent():
            read = _made_read(node.name())
            if read is None:
                raise FuseError("nothing is fused yet; fuse a frame first")
            sets = fused_sets(read.metadata(ATTRIBUTE, int(nuke.frame())), read.channels())
            for column, (name, terms) in enumerate(sets.items()):
                group = _rebuild_group(read, name, terms)
                group.setXYpos(read.xpos() + 120 * column, read.ypos() + 100)
    except FuseError as error:
        nuke.message(f"{node.name()}: {error}")


# ---------------------------------------------------------------------------------- start a job, in the main thread


@dataclass(frozen=True)
class _Job:
    """The values that the watching thread needs, read from the nodes in the main thread."""

    node: nuke.Node
    name: str
    """Full name of the node."""
    colour_knobs: dict[str, str]
    """Knobs of the HRLS's Read. The fused file is encoded like the HRLS, so its Read gets the same values."""
    commands: list[list[str]]
    """They run one after another: one for each view."""
    environment: dict[str, str]
    out: FrameFile
    offset: int
    """Number in a file name minus Nuke's frame."""
    on_farm: bool


def _start(node: nuke.Node, frame: int | None = None, on_farm: bool = False) -> None:
    """Start a job for a frame, or for the range."""
    try:
        job = _prepare(node, frame, on_farm)
    except FuseError as error:
        nuke.message(f"{node.name()}: {error}")
        return
    _running.add(job.name)
    threading.Thread(target=_watch, args=(job,), name=f"msspl-fuse for {job.name}", daemon=True).start()


def _prepare(node: nuke.Node, frame: int | None, on_farm: bool) -> _Job:
    name = node.fullName()
    if name in _running:
        raise FuseError("is still fusing; wait, or cancel it in the progress window")
    if nuke.root().proxy():
        raise FuseError("proxy mode is on; turn it off, because MSSPLFuse needs the full-size files")
    hr_read, lr_read = _find_read(node, 0, "HRLS"), _find_read(node, 1, "LRHS")
    if hr_read is None:
        raise FuseError("nothing is connected to HRLS; connect the Read of the render")
    reads = [hr_read] if lr_read is None else [lr_read, hr_read]
    frames = _range_of(node, reads) if frame is None else range(frame, frame + 1)
    views = _views(hr_read, frames, _path(node, "output"))
    out = name_output(_path(node, "output"), _find_file(hr_read, frames, views[0]), frames[0])
    if views[0] and "%v" not in out.pattern.lower():
        raise FuseError(f"output {out.path}: has no %V or %v, so the views would replace each other")
    program = find_program(_path(node, "program"), os.environ)
    submit = split_words("submit with", _text(node, "submit"))
    knobs: dict[str, Any] = {knob.name: _text(node, knob.name) for knob in fields(Settings)}
    settings = Settings(**knobs | {"overwrite": bool(node["overwrite"].value())})
    commands = []
    for view in views:
        ends = [ReadRange(r.name(), _find_file(r, frames, view), _find_file(r, frames[::-1], view)) for r in reads]
        numbers = file_numbers(ends, out, frames[0], frames[-1]) if frame is None else None
        bundle = os.path.join(tempfile.mkdtemp(prefix="msspl-"), "job") if on_farm else ""
        files = [file.in_view(view) for file in (*(end.first for end in ends), out)]
        commands.append(build_command(program, files, settings, numbers, bundle))
        if bundle and submit:
            commands.append([*submit, bundle])
    return _Job(
        node=node,
        name=name,
        colour_knobs={knob: hr_read[knob].toScript() for knob in ("raw", "colorspace")},
        commands=commands,
        environment=clean_environment(os.environ, os.path.dirname(nuke.EXE_PATH)),
        out=out,
        offset=0 if out.number is None else out.number - frames[0],
        on_farm=on_farm,
    )


def _find_read(node: nuke.Node, index: int, label: str) -> nuke.Node | None:
    """Return the Read that feeds an input, directly or through nodes that change nothing; None if there is none."""
    source = node.input(index)
    while source is not None and source.Class() in _PASS_THROUGH:
        source = source.input(0)
    if source is not None and source.Class() != "Read":
        raise FuseError(
            f"{label} is connected to {source.name()} ({source.Class()}), but MSSPLFuse reads files; connect the Read "
            "itself, or write the image to an EXR and read that"
        )
    return source


def _range_of(node: nuke.Node, reads: list[nuke.Node]) -> range:
    """Return the frames of the knob; if it is empty, those that all Reads have."""
    if text := _text(node, "frames"):
        return parse_range(text)
    frames = range(max(read.firstFrame() for read in reads), min(read.lastFrame() for read in reads) + 1)
    if not frames:
        raise FuseError("the Reads have no frame in common; connect renders of the same frames")
    return frames


def _views(read: nuke.Node, frames: range, output: str) -> list[str]:
    """Return the views that have files; only "" if the names of files have no view."""
    if "%v" not in f"{nuke.filename(read)}{output}".lower():
        return [""]
    return [view for view in nuke.views() if any(read.metadata(_FILE, frame, view) for frame in frames)] or [""]


def _find_file(read: nuke.Node, frames: range, view: str = "") -> FrameFile:
    """Ask Nuke, which follows frame modes and expressions, for the file of the first of these frames.

    If it is missing, the next one that exists tells its number.
    """
    pattern = nuke.filename(read)
    for frame in frames:
        path = read.metadata(_FILE, frame, view) if view else read.metadata(_FILE, frame)
        if pattern and path:
            file = find_number(pattern, str(path))
            return file if file.number is None else replace(file, number=file.number + frames[0] - frame)
    raise FuseError(f"{read.name()} has no file at frame {frames[0]}; go to a frame that is rendered")


def _text(node: nuke.Node, knob: str) -> str:
    return str(node[knob].value() or "").strip()


def _path(node: nuke.Node, knob: str) -> str:
    """Return the value of a file knob. Nuke evaluates its expressions and leaves ``%04d`` for the frame."""
    return str(cast(nuke.File_Knob, node[knob]).getEvaluatedValue() or "").strip()


# -------------------------------------------------------------------------------- watch the job, in a thread of its own


def _watch(job: _Job) -> None:
    title = f"{job.name}: {os.path.basename(job.out.path)}"
    try:
        # Nuke closes the window when nothing refers to the task any more, so it is in no variable here.
        outcome = run(job.commands, job.environment, nuke.ProgressTask(title))
    except Exception as error:  # kept as text, because it refers to the task
        outcome = Outcome(error=str(error) if isinstance(error, FuseError) else f"unexpected {error!r}")
    finally:
        _running.discard(job.name)
    nuke.executeInMainThread(_finish, args=(job, outcome))


# ---------------------------------------------------------------------------------- show the result, in the main thread


def _finish(job: _Job, outcome: Outcome) -> None:
    """Load the frames that are there, and show in the node what was said."""
    try:
        node_name = job.node.name()
    except ValueError:  # Nuke raises it for a deleted node.
        nuke.message(f"{job.name} was deleted; {outcome.error or f'its result is {job.out.pattern}'}")
        return
    frames = ", ".join(f"{number} {status}" for status, number in outcome.counts.items())
    said = [frames or ("done" if outcome.finished else "not done"), *dict.fromkeys(outcome.notes)]
    lines = [textwrap.fill(text, 90) for text in said] + [outcome.last] * job.on_farm
    with nuke.Undo(job.name):
        job.node["found"].setValue("\n".join(lines))
        if outcome.written or (outcome.finished and not job.on_farm):
            _load(job, node_name, outcome.written)
    if outcome.error:
        nuke.message(f"{job.name}: {outcome.error}")


def _load(job: _Job, node_name: str, written: list[int]) -> None:
    """Load frames into the Read that an earlier job made for this node, or into a new one below the node."""
    with job.node.parent():
        made = _made_read(node_name)
        read = made or nuke.nodes.Read()
    if not made:
        link = nuke.String_Knob(_MADE_BY)
        link.setFlag(nuke.INVISIBLE)
        read.addKnob(link)
        link.setValue(node_name)
        read.setXYpos(job.node.xpos(), job.node.ypos() + 100)
    numbers = written or [1 if job.out.number is None else job.out.number]
    first, last = min(numbers), max(numbers)
    if read["file"].value() == job.out.pattern:  # Frames that were fused one by one extend the Read's range.
        first, last = min(first, int(read["first"].value())), max(last, int(read["last"].value()))
    read["file"].setValue(job.out.pattern)
    for knob, value in (("first", first), ("last", last), ("origfirst", first), ("origlast", last)):
        read[knob].setValue(value)
    read["frame_mode"].setValue("expression")
    read["frame"].setValue(f"frame{job.offset:+d}" if job.offset else "")
    for knob, text in job.colour_knobs.items():
        read[knob].fromScript(text)
    if made:
        cast(nuke.Script_Knob, read["reload"]).execute()


def _made_read(node_name: str) -> nuke.Node | None:
    """Return the Read that an earlier job made for a node of the current group."""
    reads = nuke.allNodes("Read")
    return next((n for n in reads if n.knob(_MADE_BY) and n[_MADE_BY].value() == node_name), None)


# ------------------------------------------------------------------------------- rebuild the beauty, in the main thread


def _rebuild_group(read: nuke.Node, name: str, terms: list[list[str]]) -> nuke.Group:
    """Make a group that adds up the layers of a set, and shows the sum or its difference from the beauty.

    Every layer has a Shuffle of its own, behind which the artist may put a Grade.
    """
    group = nuke.nodes.Group()
    group.setName("Rebuild_" + re.sub(r"\W", "_", name))
    group.setInput(0, read)
    show = nuke.Enumeration_Knob("show", "show", ["rebuild", "difference"])
    show.setTooltip("rebuild: the sum of the layers. difference: how far it is from the fused beauty.")
    group.addKnob(show)
    with group:
        source = nuke.nodes.Input()
        total: nuke.Node | None = None
        for column, term in enumerate(terms):
            light, *colours = (
                _node("Shuffle", [source], 120 * column, 100 + 50 * i, **{"in": layer, "label": layer})
                for i, layer in enumerate(term)
            )
            for colour in colours:
                light = _merge("multiply", light, colour, 120 * column, 200)
            total = light if total is None else _merge("plus", total, light, 120 * column, 300)
        assert total is not None
        alpha = _node("Copy", [total, source], 0, 400, from0="rgba.alpha", to0="rgba.alpha")
        difference = _merge("difference", source, total, 120, 400)
        switch = _node("Switch", [alpha, difference], 0, 500)
        switch["which"].setExpression("parent.show")  # the index of its value
        _node("Output", [switch], 0, 550)
    return group


def _merge(operation: str, b: nuke.Node, a: nuke.Node, x: int, y: int) -> nuke.Node:
    return _node("Merge2", [b, a], x, y, operation=operation, output="rgb")


def _node(kind: str, inputs: list[nuke.Node], x: int, y: int, **knobs: str) -> nuke.Node:
    """Make a node in the current group."""
    node = getattr(nuke.nodes, kind)()
    for index, source in enumerate(inputs):
        node.setInput(index, source)
    for name, value in knobs.items():
        node[name].setValue(value)
    node.setXYpos(x, y)
    return cast(nuke.Node, node)
