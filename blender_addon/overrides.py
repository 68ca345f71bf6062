# SPDX-License-Identifier: GPL-3.0-or-later
"""Overriding settings of a scene for a while. The user's values come back afterwards, and saved files contain them."""

from contextlib import contextmanager, suppress

import bpy

from .errors import Failure

#: The overrides that are active now: (name and session_uid of the scene, values, the user's values).
_active = []


@contextmanager
def override(scene, values):
    """Set ``{data path: value}`` on a scene. The user's values come back however the block ends."""
    identity = scene.name, scene.session_uid
    users = {path: read(scene, path) for path in values}
    active = identity, values, users
    _active.append(active)
    try:
        _write(scene, values)
        yield
    finally:
        _active.remove(active)
        with suppress(Failure):
            # The order stays: Blender accepts a file format only after its media type is set.
            _write(find_scene(*identity), users)


@bpy.app.handlers.persistent
def restore_for_save(*_):
    """Before Blender saves a file: set the user's values, so that the file contains them."""
    for identity, _, users in reversed(_active):
        with suppress(Failure):
            _write(find_scene(*identity), users)


@bpy.app.handlers.persistent
def override_after_save(*_):
    """After Blender has saved a file: set the overriding values again."""
    for identity, values, _ in _active:
        with suppress(Failure):
            _write(find_scene(*identity), values)


def find_scene(name, uid):
    """The scene with a ``session_uid``. Undo replaces scene objects, so a reference to one does not stay valid.

    Raises:
        Failure: the scene was removed.
    """
    found = next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)
    if found is None:
        raise Failure(f"scene '{name}' was removed while it was rendered; undo the removal and render again")
    return found


def read(scene, path):
    """The value at a data path."""
    return getattr(*_owner(scene, path))


def _write(scene, values):
    for path, value in values.items():
        setattr(*_owner(scene, path), value)


def _owner(scene, path):
    head, _, name = path.rpartition(".")
    return scene.path_resolve(head), name
