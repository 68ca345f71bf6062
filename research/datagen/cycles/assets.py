# SPDX-License-Identifier: GPL-3.0-or-later
"""Optional files to build scenes from, read by Blender's own importers: HDRIs, OBJ furniture, glTF models.

A folder is expected to hold `hdri/*.hdr` and `models/<name>/...`; whatever is missing is simply not used.
"""

from __future__ import annotations

import re
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

_CHARTS = ("Spheres", "TransmissionTest")  # test charts: recognisable, so rarely


class Assets:
    """The files found under a folder, or none at all."""

    def __init__(self, root: Path | None) -> None:
        root = root.resolve() if root else None
        self.hdris = sorted(root.glob("hdri/*.hdr")) if root else []
        self.furniture = sorted(root.glob("models/*/*.obj")) if root else []
        self.models = sorted(root.glob("models/*/glTF/*.gltf")) if root else []

    def model(self, rng: np.random.Generator) -> Path:
        path = self.models[rng.integers(len(self.models))]
        if any(chart in path.name for chart in _CHARTS) and rng.random() < 0.8:
            path = self.models[rng.integers(len(self.models))]
        return path


def licence_of(model: Path) -> str:
    """Name and licence of a model file for the record: the SPDX identifiers of its own data."""
    texts = [p for folder in (model.parent, model.parent.parent) for p in sorted(folder.glob("LICENSE*"))]
    text = texts[0].read_text(errors="replace").split("metadocumentation")[0] if texts else ""
    licences = sorted(set(re.findall(r'SPDX license identifier: "([^"]+)"', text)))
    if not licences and re.search("CC0|Creative Commons Zero", text):
        licences = ["CC0-1.0"]
    return f"models/{model.stem} ({' AND '.join(licences) or 'licence unknown'})"


def load_model(path: Path) -> list[bpy.types.Object]:
    """Import the meshes of an OBJ or glTF file, z up, centred in x and y, standing on z = 0, at most 1 m large.

    A model's lights and cameras are left out. Parts keep their materials.
    """
    before = set(bpy.data.objects)
    if path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
    bpy.context.view_layer.update()
    new = [o for o in bpy.data.objects if o not in before]
    meshes = [o for o in new if o.type == "MESH" and len(o.data.polygons)]
    world = {o: o.matrix_world.copy() for o in meshes}
    for thing in new:
        if thing not in world:
            bpy.data.objects.remove(thing)
    corners = np.array([world[o] @ Vector(corner) for o in meshes for corner in o.bound_box])
    low, high = corners.min(0), corners.max(0)
    scale = 1 / max((high - low).max(), 1e-6)
    fit = Matrix.Scale(scale, 4) @ Matrix.Translation((-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]))
    for o in meshes:
        o.parent = None
        o.matrix_world = fit @ world[o]
    return meshes
