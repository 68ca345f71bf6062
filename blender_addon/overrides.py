# SPDX-License-Identifier: GPL-3.0-or-later
"""Overrides settings of a scene for a while. The user's values come back afterwards, and saved files contain them."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import bpy
from bpy.types import Scene

from .errors import Failure

#: The overrides that are active now: (name and session_uid of the scene, values, the user's values).
_active: list[tuple[tuple[str, int], dict[str, Any], dict[str, Any]]] = []


@contextmanager
def override(scene: Scene, values: dict[str, Any]) -> Iterator[None]:
    """Set ``{data path: value}`` on a scene. The user's values come back however the block ends."""
    identity, users = (scene.name, scene.session_uid), {path: read(scene, path) for path in values}
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
def restore_for_save(*arguments: object) -> None:
    """Set the user's values before Blender saves a file, so that the file contains them."""
    for identity, _, users in reversed(_active):
        with suppress(Failure):
            _write(find_scene(*identity), users)


@bpy.app.handlers.persistent
def override_after_save(*arguments: object) -> None:
    """Set the overriding values again after Blender has saved a file."""
    for identity, values, _ in _active:
        with suppress(Failure):
            _write(find_scene(*identity), values)


def find_scene(name: str, uid: int) -> Scene:
    """Return the scene with a ``session_uid``. Undo replaces scene objects, so a reference to one becomes invalid."""
    scene = next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)
    if scene is None:
        raise Failure(f"scene '{name}' was removed while it was rendered; undo the removal and render again")
    return scene


def read(scene: Scene, path: str) -> Any:
    """Return the value at a data path."""
    return getattr(*_owner(scene, path))


def _write(scene: Scene, values: dict[str, Any]) -> None:
    for path, value in values.items():
        setattr(*_owner(scene, path), value)


def _owner(scene: Scene, path: str) -> tuple[Any, str]:
    head, _, name = path.rpartition(".")
    return scene.path_resolve(head), name
