# SPDX-License-Identifier: Apache-2.0
"""Reads a .gizmo file with a real Tcl interpreter."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from dataclasses import dataclass, field

#: Nuke's script commands. A node command gets its knobs as a list, pops its inputs from a stack and pushes its node.
_PRELUDE = r"""
set lines {}; set stack {}; set groups {}; set count 0
proc emit {args} {
    foreach word $args { append ::lines x [binary encode hex [encoding convertto utf-8 $word]] " " }
    append ::lines \n
}
proc push {node} { set ::stack [linsert $::stack 0 $node] }
proc pop {} {
    if {![llength $::stack]} { return 0 }
    set node [lindex $::stack 0]
    set ::stack [lrange $::stack 1 end]
    return $node
}
proc version {args} { emit version $args }
proc node {class body} {
    set number [incr ::count]
    emit node $number $class [lindex $::groups 0 0]
    if {[llength $body] % 2} { error "$class: a knob without a value" }
    set inputs 1
    foreach {knob value} $body {
        if {$knob eq "addUserKnob"} { emit user $number {*}$value } else { emit knob $number $knob $value }
        if {$knob eq "inputs"} { set inputs [expr $value] }
    }
    for {set i 0} {$i < $inputs} {incr i} { emit input $number [pop] }
    if {$class eq "Gizmo"} {
        set ::groups [linsert $::groups 0 [list $number $::stack]]
        set ::stack {}
    } else { push $number }
}
proc end_group {} {
    lassign [lindex $::groups 0] number ::stack
    set ::groups [lrange $::groups 1 end]
    push $number
}
foreach class {Gizmo Input Output} { proc $class {body} "node $class \$body" }
"""


@dataclass
class UserKnob:
    """One ``addUserKnob``."""

    kind: int
    name: str
    options: dict[str, str]
    """Option -> value: ``l`` label, ``t`` tooltip, ``T`` text or script, ``M`` menu. ``+STARTLINE`` has none."""
    items: list[str] = field(default_factory=list)


@dataclass
class ScriptNode:
    """One node of the file."""

    kind: str
    parent: int
    knobs: dict[str, str] = field(default_factory=dict)
    user_knobs: list[UserKnob] = field(default_factory=list)
    inputs: list[int] = field(default_factory=list)
    """Numbers of the connected nodes. 0 means that nothing is connected."""


def tcl_interpreters():
    """Return the Tcl interpreters of this machine: the one inside Python, the program tclsh, both or none."""
    here = [("tkinter", importlib.util.find_spec("_tkinter")), ("tclsh", shutil.which("tclsh"))]
    return [name for name, found in here if found]


def evaluate(script: str, interpreter: str, code: str = "set lines") -> list[list[str]]:
    """Run a script with Nuke's commands defined and return what they emitted, one list of words a line."""
    if interpreter == "tkinter":
        import tkinter

        tcl = tkinter.Tcl()
        for text in (_PRELUDE, script):
            tcl.eval(text)
        lines = tcl.eval(code)
    else:
        # The script is sent in hexadecimal, so that the shell of tclsh changes nothing in it.
        encoded = script.encode().hex()
        program = (
            f"{_PRELUDE}\neval [encoding convertfrom utf-8 [binary decode hex {encoded}]]\nputs -nonewline [{code}]"
        )
        done = subprocess.run(["tclsh"], input=program, capture_output=True, text=True)
        if done.returncode or done.stderr:
            raise ValueError(done.stderr)
        lines = done.stdout
    return [[bytes.fromhex(word[1:]).decode() for word in line.split()] for line in lines.splitlines()]


def read_script(script: str, interpreter: str) -> dict[int, ScriptNode]:
    """Return {number: node} of a .gizmo file, in file order."""
    nodes: dict[int, ScriptNode] = {}
    for what, *words in evaluate(script, interpreter):
        if what == "node":
            nodes[int(words[0])] = ScriptNode(words[1], int(words[2] or 0))
        elif what == "knob":
            nodes[int(words[0])].knobs[words[1]] = words[2]
        elif what == "input":
            nodes[int(words[0])].inputs.append(int(words[1]))
        elif what == "user":
            nodes[int(words[0])].user_knobs.append(_user_knob(words[1:], interpreter))
    return nodes


def _user_knob(words: list[str], interpreter: str) -> UserKnob:
    kind, name, *rest = words
    knob, options = UserKnob(int(kind), name, {}), iter(rest)
    for option in options:
        knob.options[option] = "" if option[0] in "+-" else next(options)
    if "M" in knob.options:
        knob.items = evaluate(f"emit {{*}}{{{knob.options['M']}}}", interpreter)[0]
    return knob
