# SPDX-License-Identifier: Apache-2.0
"""What the gizmo's buttons and the menu do in Nuke. The only module here that knows Nuke; no Qt.

Buttons run in Nuke's main thread, msspl-fuse is watched by a thread of ours, and that thread touches nodes only
through ``nuke.executeInMainThread``.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, replace
from typing import cast

import nuke
from msspl_bridge import (
    Cancelled,
    Clip,
    Problem,
    Settings,
    build_command,
    clean_environment,
    find_clip,
    find_program,
    name_output,
    run,
)

#: Nodes that change neither pixels nor time: a Read is looked for above them.
_PASSIVE = ("Dot", "NoOp", "PostageStamp")
#: A knob on the Read of a result: the name of the node that made it.
_MADE_BY = "msspl_made_by"
_running: set[str] = set()


def add_menu() -> None:
    menu = nuke.menu("Nodes").addMenu("MSSPL")
    menu.addCommand("MSSPLFuse", lambda: nuke.createNode("MSSPLFuse"))
    menu.addCommand("Copy to group", copy_to_group)


def fuse_frame(node: nuke.Node) -> None:
    """Fuse the current frame, in the background."""
    frame = int(nuke.frame())
    _start(node, frame, frame, as_range=False)


def fuse_range(node: nuke.Node) -> None:
    """Fuse the frames of the range knobs, in the background."""
    _start(node, int(node["first"].value()), int(node["last"].value()), as_range=True)


def copy_to_group() -> None:
    """Replace the selected gizmos by groups, which load where the gizmo is not installed."""
    gizmos = [n for n in nuke.selectedNodes() if isinstance(n, nuke.Gizmo) and n.knob("fuse_frame")]
    if not gizmos:
        nuke.message("Select an MSSPLFuse gizmo; groups are copied already.")
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


# ---------------------------------------------------------------------------------------------- before: main thread


@dataclass(frozen=True)
class _Job:
    node: nuke.Node
    name: str
    encoding: dict[str, str]
    """Knobs of the HRLS's Read, as in a script. The fused pixels are encoded alike, so they are read alike."""
    command: list[str]
    environment: dict[str, str]
    out: Clip
    span: tuple[int, int] | None
    """First and last number in the names of the files of a range; None for one frame."""
    shift: int
    """Number in a file's name minus Nuke's frame."""


def _start(node: nuke.Node, first: int, last: int, as_range: bool) -> None:
    try:
        job = _prepare(node, first, last, as_range)
    except Problem as problem:
        nuke.message(f"{node.name()}: {problem}")
        return
    _running.add(job.name)
    threading.Thread(target=_work, args=(job,), name=f"msspl-fuse for {job.name}", daemon=True).start()


def _prepare(node: nuke.Node, first: int, last: int, as_range: bool) -> _Job:
    name = node.fullName()
    if name in _running:
        raise Problem("is still fusing; wait, or cancel it in the progress window")
    if nuke.root().proxy():
        raise Problem("proxy mode is on; turn it off, because the full-size files are fused")
    if last < first:
        raise Problem(f"the range {first} to {last} is empty; give its first frame first")
    lr_read, hr_read = _find_read(node, 0, "LRHS"), _find_read(node, 1, "HRLS")
    lr, hr = _find_clip(lr_read, first), _find_clip(hr_read, first)
    out = name_output(_path(node, "output"), hr, first)
    span = None
    if as_range:
        for read, begin in ((lr_read, lr), (hr_read, hr)):
            end = _find_clip(read, last)
            if begin.number is None or end.number is None or end.number - begin.number != last - first:
                raise Problem(
                    f"{read.name()} does not have one numbered file a frame from {first} to {last}; "
                    "change the range or the Read"
                )
        if lr.number != hr.number:
            raise Problem(
                f"at frame {first}, {lr_read.name()} reads number {lr.number} and {hr_read.name()} {hr.number}; "
                "for a range both need the same numbers in their names"
            )
        if out.number is None:
            raise Problem(f"output {out.path}: a range needs a number in it, such as name.####.exr")
        span = (out.number, out.number + last - first)
    settings = Settings(
        model=_text(node, "model"),
        device=_text(node, "device"),
        mapping=_text(node, "mapping"),
        layers=_text(node, "layers"),
        options=_text(node, "options"),
        overwrite=bool(node["overwrite"].value()),
    )
    program = find_program(_path(node, "program"), os.environ)
    return _Job(
        node=node,
        name=name,
        encoding={knob: hr_read[knob].toScript() for knob in ("raw", "colorspace")},
        command=build_command(program, lr, hr, out, settings, span),
        environment=clean_environment(os.environ, os.path.dirname(nuke.EXE_PATH)),
        out=out,
        span=span,
        shift=0 if out.number is None else out.number - first,
    )


def _find_read(node: nuke.Node, index: int, label: str) -> nuke.Node:
    """The Read of an input, through nodes that change nothing."""
    found = node.input(index)
    while found is not None and found.Class() in _PASSIVE:
        found = found.input(0)
    if found is None:
        raise Problem(f"nothing is connected to {label}; connect the Read of that render")
    if found.Class() != "Read":
        raise Problem(
            f"{label} comes from {found.name()} ({found.Class()}), but files are fused; connect the Read itself, or "
            "write this out as EXR and read that"
        )
    return found


def _find_clip(read: nuke.Node, frame: int) -> Clip:
    """The file that a Read reads at a frame. Nuke says it, so every frame mode and expression is followed."""
    pattern, path = nuke.filename(read), read.metadata("input/filename", frame)
    if not pattern or not path:
        raise Problem(f"{read.name()} has no file at frame {frame}; go to a frame that is rendered")
    return find_clip(pattern, str(path))


def _text(node: nuke.Node, knob: str) -> str:
    return str(node[knob].value() or "").strip()


def _path(node: nuke.Node, knob: str) -> str:
    """A file knob with its expressions evaluated, and the number of the frame left as ``%04d``."""
    return str(cast(nuke.File_Knob, node[knob]).getEvaluatedValue() or "").strip()


# ---------------------------------------------------------------------------------------------- during: our thread


def _work(job: _Job) -> None:
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
        text = error if isinstance(error, Problem) else f"unexpected {type(error).__name__}: {error}"
        nuke.executeInMainThread(nuke.message, args=(f"{job.name}: {text}",))
    finally:
        _running.discard(job.name)
    if done or _some_frames(job):
        nuke.executeInMainThread(_show, args=(job, warnings))


def _some_frames(job: _Job) -> bool:
    """Of a range that failed or was cancelled, frames may be there."""
    numbers = range(job.span[0], job.span[1] + 1) if job.span else ()
    return any(os.path.exists(replace(job.out, number=n).path) for n in numbers)


# ---------------------------------------------------------------------------------------------- after: main thread


def _show(job: _Job, warnings: list[str]) -> None:
    """Put the result into a Read below the node: the one made before, or a new one."""
    for warning in warnings:
        nuke.warning(f"{job.name}: {warning}")
    try:
        node_name, parent = job.node.name(), job.node.parent()
    except ValueError:  # Nuke's way to say that a node was deleted
        nuke.message(f"{job.name} is gone; its result is {job.out.pattern}")
        return
    with parent:
        made = [n for n in nuke.allNodes("Read") if n.knob(_MADE_BY) and n[_MADE_BY].value() == node_name]
        read = made[0] if made else _new_read(job.node, node_name)
    first, last = job.span or (1 if job.out.number is None else job.out.number,) * 2
    if read["file"].value() == job.out.pattern:  # frame by frame, the range grows
        first, last = min(first, int(read["first"].value())), max(last, int(read["last"].value()))
    read["file"].setValue(job.out.pattern)
    for knob, value in (("first", first), ("last", last), ("origfirst", first), ("origlast", last)):
        read[knob].setValue(value)
    read["frame_mode"].setValue("expression")
    read["frame"].setValue(f"frame{job.shift:+d}" if job.shift else "")
    for knob, text in job.encoding.items():
        read[knob].fromScript(text)
    if made:
        cast(nuke.Script_Knob, read["reload"]).execute()


def _new_read(node: nuke.Node, node_name: str) -> nuke.Node:
    read = nuke.nodes.Read()
    link = nuke.String_Knob(_MADE_BY)
    link.setFlag(nuke.INVISIBLE)
    read.addKnob(link)
    link.setValue(node_name)
    read.setXYpos(node.xpos(), node.ypos() + 100)
    return read
