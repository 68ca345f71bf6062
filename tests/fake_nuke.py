# SPDX-License-Identifier: Apache-2.0
"""As much of Nuke as the gizmo needs: its scripts, through a real Tcl interpreter, and the module ``nuke``.

The fake module is stricter than Nuke where Nuke would crash or hang: nodes and knobs may be touched from the main
thread alone, ``executeInMainThread`` from any other alone. Its names and parameters are those of types-nuke, which
tests/test_nuke.py checks.
"""

from __future__ import annotations

import importlib.util
import queue
import shutil
import subprocess
import threading
import time
import types
from dataclasses import dataclass, field
from pathlib import Path

# ---------------------------------------------------------------------------------------------- .gizmo and .nk files

#: Node commands take knobs as a list, take their inputs from a stack of nodes and put themselves on it.
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
proc stack {index} { lindex $::stack $index }
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
    if {$class in {Gizmo Group}} {
        set ::groups [linsert $::groups 0 [list $number $::stack]]
        set ::stack {}
    } else { push $number }
}
proc end_group {} {
    lassign [lindex $::groups 0] number ::stack
    set ::groups [lrange $::groups 1 end]
    push $number
}
foreach class {Gizmo Group Input Output NoOp Dot Read Write Switch} { proc $class {body} "node $class \$body" }
"""


@dataclass
class UserKnob:
    """One ``addUserKnob``."""

    kind: int
    name: str
    options: dict[str, str]
    """``l`` label, ``t`` tooltip, ``T`` text or script, ``M`` menu; ``+STARTLINE`` and the like as keys."""
    items: list[str] = field(default_factory=list)


@dataclass
class ScriptNode:
    """One node of a script."""

    kind: str
    parent: int
    knobs: dict[str, str] = field(default_factory=dict)
    user_knobs: list[UserKnob] = field(default_factory=list)
    inputs: list[int] = field(default_factory=list)
    """Numbers of the nodes that are connected, 0 for none."""


def tcl_interpreters():
    """Names of the real Tcl interpreters that this machine has: Python's own, or the program."""
    here = [("tkinter", importlib.util.find_spec("_tkinter")), ("tclsh", shutil.which("tclsh"))]
    return [name for name, found in here if found]


def evaluate(script: str, interpreter: str, code: str = "set lines") -> list[list[str]]:
    """Run a script with the node commands registered; what was emitted, as lists of words."""
    if interpreter == "tkinter":
        import tkinter

        tcl = tkinter.Tcl()
        for text in (_PRELUDE, script):
            tcl.eval(text)
        lines = tcl.eval(code)
    else:
        # The script travels as data, so that what is read is exactly the file.
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
    """The nodes of a .gizmo or .nk file by number, in file order."""
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


# ---------------------------------------------------------------------------------------------- the module


def _main_thread_alone() -> None:
    assert threading.current_thread() is threading.main_thread(), "Nuke may crash: nodes belong to its main thread"


class Knob:
    def __init__(self, name, label="", value=None):
        self._name, self._value, self._flags = name, value, 0

    def name(self):
        return self._name

    def value(self):
        _main_thread_alone()
        return self._value

    def setValue(self, val):
        _main_thread_alone()
        self._value = val

    def toScript(self):
        return str(self.value())

    def fromScript(self, script):
        self.setValue(script)

    def setFlag(self, flag):
        self._flags |= flag


class String_Knob(Knob):
    pass


class File_Knob(String_Knob):
    def getEvaluatedValue(self):
        return self.value() or None


class Script_Knob(String_Knob):
    presses = 0

    def execute(self):
        self.presses += 1


KNOB_TYPES = {
    1: String_Knob,
    2: File_Knob,
    3: Knob,
    4: Knob,
    6: Knob,
    20: Knob,
    22: Script_Knob,
    26: Knob,
    43: String_Knob,
}
_EMPTY = {1: "", 2: "", 3: 0, 6: False, 43: ""}


class Node:
    nuke: FakeNuke

    def __init__(self, kind, name, knobs=(), inputs=0):
        self._kind, self._parent = kind, None
        self._knobs = {knob.name(): knob for knob in (String_Knob("name", value=name), *knobs)}
        self._inputs, self._place, self._deleted = [None] * inputs, (0, 0), False

    def Class(self):
        return self._kind

    def name(self):
        _main_thread_alone()
        if self._deleted:
            raise ValueError("A PythonObject is not attached to a node")
        return self._knobs["name"].value()

    def setName(self, name):
        assert name not in {n.name() for n in self.nuke.nodes_of(self._parent) if n is not self}
        self._knobs["name"].setValue(name)

    def fullName(self):
        above = self.parent()
        return self.name() if isinstance(above, Root) else f"{above.fullName()}.{self.name()}"

    def parent(self):
        self.name()
        return self._parent

    def knob(self, p):
        return self._knobs.get(p)

    def __getitem__(self, name):
        return self._knobs[name]

    def addKnob(self, knob):
        self._knobs[knob.name()] = knob

    def inputs(self):
        return len(self._inputs)

    def input(self, index):
        return self._inputs[index] if index < len(self._inputs) else None

    def setInput(self, i, node):
        self._inputs += [None] * (i + 1 - len(self._inputs))
        self._inputs[i] = node
        return True

    def dependent(self, mask):
        return [n for n in self.nuke.everything if self in n._inputs]

    def metadata(self, key, time):
        """A Read at a frame: the file it finds, in the frame modes as Foundry's guide describes them."""
        assert (self._kind, key) == ("Read", "input/filename")
        mode, text = self["frame_mode"].value(), str(self["frame"].value())
        number = (
            eval(text or "frame", {"frame": time}) if mode == "expression" else time - int(text) + self["first"].value()
        )
        number = min(max(number, self["first"].value()), self["last"].value())  # before and after: hold
        path = self["file"].value()
        path = path % number if "%" in path else path
        return path if Path(path).exists() else None

    def xpos(self):
        return self._place[0]

    def ypos(self):
        return self._place[1]

    def setXYpos(self, x, y):
        self._place = (x, y)


class Group(Node):
    def __enter__(self):
        self.nuke.contexts.append(self)
        return self

    def __exit__(self, type, value, traceback):
        self.nuke.contexts.pop()


class Gizmo(Group):
    def makeGroup(self):
        knobs = [type(k)(k.name(), value=k.value()) for k in self._knobs.values() if k.name() != "name"]
        return self.nuke.add(Group("Group", "Group1", knobs, 0))


class Root(Group):
    def proxy(self):
        return self["proxy"].value()


class ProgressTask:
    made: list[ProgressTask] = []  # noqa: RUF012
    cancel_at: str | None = None
    """The test's finger on the cancel button: the message at which it presses."""

    def __init__(self, name):
        self.name, self.progress, self.messages = name, [], []
        self.made.append(self)

    def setProgress(self, i):
        assert isinstance(i, int) and 0 <= i <= 100
        self.progress.append(i)

    def setMessage(self, s):
        self.messages.append(s)

    def isCancelled(self):
        return self.cancel_at is not None and any(self.cancel_at in m for m in self.messages)


class Menu:
    def __init__(self):
        self.entries = {}

    def addMenu(self, name):
        return self.entries.setdefault(name, Menu())

    def addCommand(self, name, command):
        self.entries[name] = command


class FakeNuke(types.ModuleType):
    """The module ``nuke`` of one session, and what a test does with it."""

    INPUTS, HIDDEN_INPUTS, INVISIBLE = 1, 2, 1024
    EXE_PATH = "/opt/Nuke15.1v1/Nuke15.1"
    Gizmo, Node, File_Knob, Script_Knob, String_Knob = Gizmo, Node, File_Knob, Script_Knob, String_Knob

    def __init__(self, gizmo: dict[int, ScriptNode]):
        super().__init__("nuke")
        self._gizmo, self._calls, self._menus = gizmo, queue.Queue(), {}
        self.everything, self.selected, self.messages, self.warnings = [], [], [], []
        Node.nuke = self
        self.ProgressTask = type("ProgressTask", (ProgressTask,), {"made": []})
        knobs = [Knob(*pair) for pair in (("first_frame", "", 1), ("last_frame", "", 100), ("proxy", "", False))]
        self._root = Root("Root", "root", knobs)
        self.contexts = [self._root]
        self.frame_number, self._node = 1, None
        self.nodes = types.SimpleNamespace(Read=self._read)

    # What types-nuke has, too.

    def root(self):
        return self._root

    def frame(self):
        return self.frame_number

    def thisNode(self):
        return self._node

    def message(self, prompt):
        _main_thread_alone()
        self.messages.append(prompt)

    def warning(self, message):
        _main_thread_alone()
        self.warnings.append(message)

    def tprint(self, *args):
        self.messages.append(" ".join(args))

    def executeInMainThread(self, call, args=(), kwargs=None):
        assert threading.current_thread() is not threading.main_thread(), "Nuke hangs"
        self._calls.put((call, args if isinstance(args, tuple) else (args,), kwargs or {}))

    def filename(self, node):
        return node["file"].value() or None

    def allNodes(self, filter):
        return [n for n in self.nodes_of(self.contexts[-1]) if n.Class() == filter]

    def selectedNodes(self):
        return list(self.selected)

    def menu(self, name):
        return self._menus.setdefault(name, Menu())

    def delete(self, n):
        self.everything.remove(n)
        n._deleted = True

    def createNode(self, typ):
        """The gizmo, as its file defines it."""
        assert typ == "MSSPLFuse"
        definition = self._gizmo[1]
        knobs = []
        for knob in definition.user_knobs:
            value = definition.knobs.get(knob.name, knob.items[0] if knob.items else _EMPTY.get(knob.kind))
            if isinstance(value, str) and value.startswith("{root."):
                value = self._root[value[6:-1]].value()
            if knob.kind == 22:
                value = knob.options["T"]
            knobs.append(KNOB_TYPES[knob.kind](knob.name, value=value))
        inputs = sum(node.kind == "Input" for node in self._gizmo.values())
        return self.add(Gizmo("MSSPLFuse", "MSSPLFuse1", knobs, inputs))

    def _read(self, file="", first=1, last=1):
        values = {"file": file, "first": first, "last": last, "origfirst": first, "origlast": last, "frame": ""}
        values |= {"frame_mode": "expression", "raw": False, "colorspace": "default"}
        knobs = [File_Knob(k, value=v) if k == "file" else Knob(k, value=v) for k, v in values.items()]
        return self.add(Node("Read", "Read1", [*knobs, Script_Knob("reload")]))

    # What only the tests use.

    def nodes_of(self, group):
        return [n for n in self.everything if n._parent is group]

    def add(self, node):
        """Put a node into the current group, under a name that is free there."""
        node._parent = self.contexts[-1]
        taken = {n.name() for n in self.nodes_of(node._parent)}
        base, number = node.name().rstrip("0123456789"), 1
        while f"{base}{number}" in taken:
            number += 1
        node["name"].setValue(f"{base}{number}")
        self.everything.append(node)
        return node

    def press(self, node, knob):
        """Press a button, as Nuke does: its script, in the main thread."""
        self._node = node
        exec(compile(node[knob].value(), knob, "exec"), {"nuke": self})

    def wait(self, seconds=120):
        """Nuke's event loop, until nothing runs in the background."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            busy = any(t.name.startswith("msspl-fuse for") for t in threading.enumerate())
            try:
                call, args, kwargs = self._calls.get(timeout=0.02)
            except queue.Empty:
                if not busy:
                    return
            else:
                call(*args, **kwargs)
        raise TimeoutError("msspl-fuse is still running")
