# SPDX-License-Identifier: Apache-2.0
"""Runs the gizmo's buttons and the menu. Only this module and init.py import nuke.

A button runs in Nuke's main thread and starts a thread that watches msspl-fuse. Nodes may be touched in the main thread
only, so the watching thread calls ``nuke.executeInMainThread``.
"""

from __future__ import annotations

import os
import re
import threading
from dataclasses import dataclass, replace
from typing import cast

import nuke
from msspl_bridge.command import Settings, build_command, clean_environment, find_program
from msspl_bridge.errors import Cancelled, FuseError
from msspl_bridge.frame_files import FrameFile, ReadRange, file_numbers, find_number, name_output
from msspl_bridge.passes import ATTRIBUTE, FusedSet, fused_sets
from msspl_bridge.process import run

#: Nodes that change neither pixels nor time. They may stand between the Read and the gizmo.
_PASS_THROUGH = ("Dot", "NoOp", "PostageStamp")
#: Knobs whose values go into the command line as text.
_KNOBS = ("model", "device", "mapping", "layers", "passes", "temporal", "options")
#: A hidden knob on the Read of a result. It holds the name of the node that made the Read.
_MADE_BY = "msspl_made_by"
#: Full names of the nodes that are fusing now.
_running: set[str] = set()


def add_menu() -> None:
    """Add the gizmo and "Copy to group" to Nuke's toolbar."""
    menu = nuke.menu("Nodes").addMenu("MSSPL")
    menu.addCommand("MSSPLFuse", lambda: nuke.createNode("MSSPLFuse"))
    menu.addCommand("Copy to group", copy_to_group)


def fuse_frame(node: nuke.Node) -> None:
    """Fuse the current frame in the background."""
    frame = int(nuke.frame())
    _start(node, frame, frame, as_range=False)


def fuse_range(node: nuke.Node) -> None:
    """Fuse the frames of the range knobs in the background."""
    _start(node, int(node["first"].value()), int(node["last"].value()), as_range=True)


def rebuild(node: nuke.Node) -> None:
    """Make a group for each fused set, below the Read of the fused file, that builds the beauty from the layers."""
    try:
        with node.parent():
            read = _made_read(node.name())
            if read is None:
                raise FuseError("nothing is fused yet; fuse a frame first")
            sets = fused_sets(read.metadata(ATTRIBUTE, int(nuke.frame())), read.channels())
            for column, fused in enumerate(sets):
                group = _rebuild_group(read, fused)
                group.setXYpos(read.xpos() + 120 * column, read.ypos() + 100)
    except FuseError as error:
        nuke.message(f"{node.name()}: {error}")


def copy_to_group() -> None:
    """Replace the selected gizmos by groups. A script with groups loads where the gizmo is not installed."""
    gizmos = [n for n in nuke.selectedNodes() if isinstance(n, nuke.Gizmo) and n.knob("fuse_frame")]
    if not gizmos:
        nuke.message("Select an MSSPLFuse gizmo first. A group needs no copy.")
    for gizmo in gizmos:
        name = gizmo.name()
        with gizmo.parent():
            group = gizmo.makeGroup()
        for i in range(gizmo.inputs()):
            group.setInput(i, gizmo.input(i))
        for user in gizmo.dependent(nuke.INPUTS | nuke.HIDDEN_INPUTS):
            for i in range(user.inputs()):
                if user.input(i) == gizmo:
                    user.setInput(i, group)
        group.setXYpos(gizmo.xpos(), gizmo.ypos())
        nuke.delete(gizmo)
        group.setName(name)


# ---------------------------------------------------------------------------------- start a job, in the main thread


@dataclass(frozen=True)
class _Job:
    """The values that the watching thread needs, read from the nodes in the main thread."""

    node: nuke.Node
    name: str
    """Full name of the node."""
    colour_knobs: dict[str, str]
    """Knobs of the HRLS's Read. The fused file is encoded like the HRLS, so its Read gets the same values."""
    command: list[str]
    environment: dict[str, str]
    out: FrameFile
    numbers: tuple[int, int] | None
    """First and last number in the file names of a range. None for one frame."""
    offset: int
    """Number in a file name minus Nuke's frame."""


def _start(node: nuke.Node, first: int, last: int, as_range: bool) -> None:
    try:
        job = _prepare(node, first, last, as_range)
    except FuseError as error:
        nuke.message(f"{node.name()}: {error}")
        return
    _running.add(job.name)
    threading.Thread(target=_watch, args=(job,), name=f"msspl-fuse for {job.name}", daemon=True).start()


def _prepare(node: nuke.Node, first: int, last: int, as_range: bool) -> _Job:
    name = node.fullName()
    if name in _running:
        raise FuseError("is still fusing; wait, or cancel it in the progress window")
    if nuke.root().proxy():
        raise FuseError("proxy mode is on; turn it off, because MSSPLFuse needs the full-size files")
    if last < first:
        raise FuseError(f"the range {first} to {last} is empty; its first frame must not be after its last")
    reads = lr_read, hr_read = _find_read(node, 0, "LRHS"), _find_read(node, 1, "HRLS")
    lrhs, hrls = _file_at(lr_read, first), _file_at(hr_read, first)
    out = name_output(_path(node, "output"), hrls, first)
    numbers = None
    if as_range:
        ranges = [ReadRange(read.name(), _file_at(read, first), _file_at(read, last)) for read in reads]
        numbers = file_numbers(ranges, out, first, last)
    settings = Settings(**{knob: _text(node, knob) for knob in _KNOBS}, overwrite=bool(node["overwrite"].value()))
    program = find_program(_path(node, "program"), os.environ)
    return _Job(
        node=node,
        name=name,
        colour_knobs={knob: hr_read[knob].toScript() for knob in ("raw", "colorspace")},
        command=build_command(program, lrhs, hrls, out, settings, numbers),
        environment=clean_environment(os.environ, os.path.dirname(nuke.EXE_PATH)),
        out=out,
        numbers=numbers,
        offset=0 if out.number is None else out.number - first,
    )


def _find_read(node: nuke.Node, index: int, label: str) -> nuke.Node:
    """Return the Read that feeds an input, directly or through nodes that change nothing."""
    source = node.input(index)
    while source is not None and source.Class() in _PASS_THROUGH:
        source = source.input(0)
    if source is None:
        raise FuseError(f"nothing is connected to {label}; connect the Read of that render")
    if source.Class() != "Read":
        raise FuseError(
            f"{label} is connected to {source.name()} ({source.Class()}), but MSSPLFuse reads files; connect the Read "
            "itself, or write the image to an EXR and read that"
        )
    return source


def _file_at(read: nuke.Node, frame: int) -> FrameFile:
    """Ask Nuke for the file that a Read reads at a frame. Nuke follows every frame mode and expression."""
    pattern, path = nuke.filename(read), read.metadata("input/filename", frame)
    if not pattern or not path:
        raise FuseError(f"{read.name()} has no file at frame {frame}; go to a frame that is rendered")
    return find_number(pattern, str(path))


def _text(node: nuke.Node, knob: str) -> str:
    return str(node[knob].value() or "").strip()


def _path(node: nuke.Node, knob: str) -> str:
    """Return the value of a file knob. Nuke evaluates its expressions and leaves ``%04d`` for the frame."""
    return str(cast(nuke.File_Knob, node[knob]).getEvaluatedValue() or "").strip()


# -------------------------------------------------------------------------------- watch the job, in a thread of its own


def _watch(job: _Job) -> None:
    task = nuke.ProgressTask(job.name)
    task.setMessage(f"fusing {os.path.basename(job.out.path)}")

    def report(percent: int | None, message: str | None) -> None:
        if percent is not None:
            task.setProgress(percent)
        if message is not None:
            task.setMessage(message)

    warnings: list[str] = []
    done = False
    try:
        warnings = run(job.command, job.environment, report, task.isCancelled)
        done = True
    except Cancelled:
        pass
    except Exception as error:
        text = error if isinstance(error, FuseError) else f"unexpected {type(error).__name__}: {error}"
        nuke.executeInMainThread(nuke.message, args=(f"{job.name}: {text}",))
    finally:
        _running.discard(job.name)
    if done or _has_frames(job):
        nuke.executeInMainThread(_show, args=(job, warnings))


def _has_frames(job: _Job) -> bool:
    """Return whether a range that failed or was cancelled has at least one finished frame."""
    numbers = range(job.numbers[0], job.numbers[1] + 1) if job.numbers else ()
    return any(os.path.exists(replace(job.out, number=n).path) for n in numbers)


# ---------------------------------------------------------------------------------- show the result, in the main thread


def _show(job: _Job, warnings: list[str]) -> None:
    """Load the result into the Read that an earlier job made for this node, or into a new one below the node."""
    for warning in warnings:
        nuke.warning(f"{job.name}: {warning}")
    try:
        node_name, parent = job.node.name(), job.node.parent()
    except ValueError:  # Nuke raises it for a deleted node.
        nuke.message(f"{job.name} was deleted; its result is {job.out.pattern}")
        return
    with parent:
        made = _made_read(node_name)
        read = made or _new_read(job.node, node_name)
    first, last = job.numbers or (1 if job.out.number is None else job.out.number,) * 2
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
    reads = (n for n in nuke.allNodes("Read") if n.knob(_MADE_BY) and n[_MADE_BY].value() == node_name)
    return next(reads, None)


def _new_read(node: nuke.Node, node_name: str) -> nuke.Node:
    read = nuke.nodes.Read()
    link = nuke.String_Knob(_MADE_BY)
    link.setFlag(nuke.INVISIBLE)
    read.addKnob(link)
    link.setValue(node_name)
    read.setXYpos(node.xpos(), node.ypos() + 100)
    return read


# ------------------------------------------------------------------------------- rebuild the beauty, in the main thread

#: What the output of the group shows, by the index of the knob "show".
_REBUILD, _DIFFERENCE = "rebuild", "difference"


def _rebuild_group(read: nuke.Node, fused: FusedSet) -> nuke.Group:
    """Make a group that adds up the layers of a set, and shows the sum or its difference from the beauty.

    Every layer has a Shuffle of its own, behind which the artist may put a Grade.
    """
    group = nuke.nodes.Group()
    group.setName("Rebuild_" + re.sub(r"\W", "_", fused.name))
    group.setInput(0, read)
    show = nuke.Enumeration_Knob("show", "show", [_REBUILD, _DIFFERENCE])
    show.setTooltip("rebuild: the sum of the layers. difference: how far it is from the fused beauty.")
    exposure = nuke.Double_Knob("exposure", "difference exposure")
    exposure.setTooltip(
        "In stops. The difference of a file with half floats is their rounding: it appears at about 10."
    )
    exposure.setRange(0, 20)
    for knob in (show, exposure):
        group.addKnob(knob)
    with group:
        source = nuke.nodes.Input()
        total: nuke.Node | None = None
        for column, term in enumerate(fused.terms):
            light, *colours = (_shuffle(source, layer, 120 * column, 100 + 50 * i) for i, layer in enumerate(term))
            for colour in colours:
                light = _merge("multiply", light, colour, 120 * column, 200)
            total = light if total is None else _merge("plus", total, light, 120 * column, 300)
        assert total is not None
        alpha = _node("Copy", [total, source], 0, 400, from0="rgba.alpha", to0="rgba.alpha")
        difference = _merge("difference", source, total, 120, 400)
        gain = _node("Multiply", [difference], 120, 450, channels="rgb")
        gain["value"].setExpression("pow(2, parent.exposure)")
        switch = _node("Switch", [alpha, gain], 0, 500)
        switch["which"].setExpression("parent.show")
        _node("Output", [switch], 0, 550)
    return group


def _shuffle(source: nuke.Node, layer: str, x: int, y: int) -> nuke.Node:
    """Make a Shuffle that shows a layer as rgb."""
    return _node("Shuffle", [source], x, y, **{"in": layer, "label": layer})


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
