# SPDX-License-Identifier: Apache-2.0
"""A stand-in for the module ``nuke``, with the part of its API that the gizmo uses.

It fails where Nuke would crash or hang: when a thread other than the main one touches a node or a knob, and when the
main thread calls ``executeInMainThread``. test_python.py compares its names and parameters with types-nuke.
"""

from __future__ import annotations

import functools
import itertools
import queue
import threading
import time
import types
import weakref
from pathlib import Path

from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import open_exr
from tests.nuke_gizmo.gizmo_file import ScriptNode


def _require_main_thread() -> None:
    assert threading.current_thread() is threading.main_thread(), "Nuke may crash: this thread is not its main thread"


class Knob:
    def __init__(self, name, label="", value=None):
        self._name, self._value, self._flags = name, value, 0

    def name(self):
        return self._name

    def value(self):
        _require_main_thread()
        return self._value

    def setValue(self, val):
        _require_main_thread()
        Node.nuke.count_change()
        self._value = val

    def toScript(self):
        return str(self.value())

    def fromScript(self, script):
        self.setValue(script)

    def setFlag(self, flag):
        self._flags |= flag

    def setTooltip(self, tooltip):
        assert tooltip

    def setExpression(self, expression):
        self.setValue(f"{{{expression}}}")


class String_Knob(Knob):
    pass


class Enumeration_Knob(Knob):
    def __init__(self, name, label, items):
        super().__init__(name, label, items[0])
        self._items = items

    def values(self):
        return self._items

    def setValue(self, val):
        assert val in self._items
        super().setValue(val)


class File_Knob(String_Knob):
    def getEvaluatedValue(self):
        return self.value() or None


class Text_Knob(Knob):
    def setValue(self, val):
        assert isinstance(val, str)
        super().setValue(val)


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
    26: Text_Knob,
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
        _require_main_thread()
        if self._deleted:
            raise ValueError("A PythonObject is not attached to a node")
        return self._knobs["name"].value()

    def setName(self, name):
        """Nuke takes another name if this one is taken."""
        taken = {n.name() for n in self.nuke.nodes_of(self._parent) if n is not self}
        names = itertools.chain([name], (f"{name}{i}" for i in itertools.count(1)))
        self._knobs["name"].setValue(next(name for name in names if name not in taken))

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

    def channels(self):
        """Of the EXR that a Read reads at the current frame: Nuke knows no dots and spaces in the names of layers."""
        file = open_exr(Path(self.metadata("input/filename", self.nuke.frame_number)))
        names = {"R": "red", "G": "green", "B": "blue", "A": "alpha"}
        return [
            f"{layer.name.replace('.', '_').replace(' ', '_') or 'rgba'}.{names.get(component, component)}"
            for layer in layers_of(file)
            for component in layer.channels
        ]

    def firstFrame(self):
        return self["first"].value()

    def lastFrame(self):
        return self["last"].value()

    def metadata(self, key, time, view="main"):
        """Return the file of a Read at a frame, or an attribute of the file. Frame modes follow Foundry's guide."""
        assert self._kind == "Read"
        if key.startswith("exr/"):
            return open_exr(Path(self.metadata("input/filename", time))).metadata.get(key.removeprefix("exr/"))
        assert key == "input/filename"
        mode, text = self["frame_mode"].value(), str(self["frame"].value())
        number = (
            eval(text or "frame", {"frame": time}) if mode == "expression" else time - int(text) + self["first"].value()
        )
        number = min(
            max(number, self["first"].value()), self["last"].value()
        )  # The modes "before" and "after" are "hold".
        path = self["file"].value().replace("%V", view).replace("%v", view[0])
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
    """Nuke shows the window as long as the object lives. ``made`` keeps what it showed, and a weak reference to it."""

    made: list[types.SimpleNamespace] = []  # noqa: RUF012
    cancel_at: str | None = None
    """The test cancels when this text appears in a message."""

    def __init__(self, name):
        self._shown = types.SimpleNamespace(name=name, progress=[], messages=[], window=weakref.ref(self))
        self.made.append(self._shown)

    def setProgress(self, i):
        assert isinstance(i, int) and 0 <= i <= 100
        self._shown.progress.append(i)

    def setMessage(self, s):
        self._shown.messages.append(s)

    def isCancelled(self):
        return self.cancel_at is not None and any(self.cancel_at in m for m in self._shown.messages)


class Undo:
    """The group of changes that one Undo takes back."""

    nuke: FakeNuke

    def __init__(self, name):
        self.name = name

    def __enter__(self):
        assert self.nuke.undo_group is None
        self.nuke.undo_group = self.name

    def __exit__(self, *exception):
        self.nuke.undo_steps.append(self.nuke.undo_group)
        self.nuke.undo_group = None


class Menu:
    def __init__(self):
        self.entries = {}

    def addMenu(self, name):
        return self.entries.setdefault(name, Menu())

    def addCommand(self, name, command):
        self.entries[name] = command


#: Knobs of the nodes of a rebuild, with Nuke's defaults.
_PLAIN_NODES = {
    "Input": {},
    "Output": {},
    "Shuffle": {"in": "rgba", "label": ""},
    "Merge2": {"operation": "over", "output": "rgba"},
    "Copy": {"from0": "", "to0": ""},
    "Switch": {"which": 0},
}


class FakeNuke(types.ModuleType):
    """The module ``nuke`` of one session, and what a test needs to drive it."""

    INVISIBLE = 1024
    EXE_PATH = "/opt/Nuke15.1v1/Nuke15.1"
    Node, File_Knob, Script_Knob, String_Knob = Node, File_Knob, Script_Knob, String_Knob
    Enumeration_Knob, Group = Enumeration_Knob, Group

    def __init__(self, gizmo: dict[int, ScriptNode]):
        super().__init__("nuke")
        self._gizmo, self._calls, self._menus = gizmo, queue.Queue(), {}
        self.everything, self.messages = [], []
        Node.nuke = self
        self.Undo = type("Undo", (Undo,), {"nuke": self})
        self.undo_group, self.undo_steps, self.view_names = None, [], ["main"]
        self.ProgressTask = type("ProgressTask", (ProgressTask,), {"made": []})
        knobs = [Knob(*pair) for pair in (("first_frame", "", 1), ("last_frame", "", 100), ("proxy", "", False))]
        self._root = Root("Root", "root", knobs)
        self.contexts = [self._root]
        self.frame_number, self._node = 1, None
        plain = {kind: functools.partial(self._plain_node, kind) for kind in _PLAIN_NODES}
        self.nodes = types.SimpleNamespace(Read=self._read, Group=self._group, **plain)

    # The API of Nuke.

    def root(self):
        return self._root

    def views(self):
        return list(self.view_names)

    def frame(self):
        return self.frame_number

    def thisNode(self):
        return self._node

    def message(self, prompt):
        _require_main_thread()
        self.messages.append(prompt)

    def tprint(self, *args):
        self.messages.append(" ".join(args))

    def executeInMainThread(self, call, args=(), kwargs=None):
        assert threading.current_thread() is not threading.main_thread(), "Nuke hangs"
        self._calls.put((call, args if isinstance(args, tuple) else (args,), kwargs or {}))

    def filename(self, node):
        return node["file"].value() or None

    def allNodes(self, filter):
        return [n for n in self.nodes_of(self.contexts[-1]) if n.Class() == filter]

    def menu(self, name):
        return self._menus.setdefault(name, Menu())

    def delete(self, n):
        self.everything.remove(n)
        n._deleted = True

    def createNode(self, typ):
        """Make a gizmo with the knobs of its file."""
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

    def _group(self):
        return self.add(Group("Group", "Group1"))

    def _plain_node(self, kind):
        return self.add(Node(kind, f"{kind}1", [Knob(k, value=v) for k, v in _PLAIN_NODES[kind].items()]))

    # For the tests only.

    def count_change(self):
        """Note a change outside of a group of its own: each is a step for Undo."""
        if self.undo_group is None:
            self.undo_steps.append("")

    def nodes_of(self, group):
        return [n for n in self.everything if n._parent is group]

    def add(self, node):
        """Put a node into the current group and give it a free name."""
        node._parent = self.contexts[-1]
        taken = {n.name() for n in self.nodes_of(node._parent)}
        base, number = node.name().rstrip("0123456789"), 1
        while f"{base}{number}" in taken:
            number += 1
        node["name"].setValue(f"{base}{number}")
        self.everything.append(node)
        return node

    def press(self, node, knob):
        """Press a button: run its script in the main thread."""
        self._node = node
        exec(compile(node[knob].value(), knob, "exec"), {"nuke": self})

    def wait(self, seconds=120):
        """Run Nuke's event loop until no job runs in the background."""
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
