# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's meshes and hair from arrays."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np

from research.datagen.meshes import Mesh


def blender_mesh(mesh: Mesh) -> bpy.types.Mesh:
    data = bpy.data.meshes.new("mesh")
    count = len(mesh.f)
    data.vertices.add(len(mesh.v))
    data.vertices.foreach_set("co", np.ascontiguousarray(mesh.v, np.float32).ravel())
    data.loops.add(3 * count)
    data.loops.foreach_set("vertex_index", np.ascontiguousarray(mesh.f, np.int32).ravel())
    data.polygons.add(count)
    data.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    data.polygons.foreach_set("use_smooth", np.full(count, mesh.n is not None))
    uv = data.uv_layers.new(name="UV")
    uv.uv.foreach_set("vector", np.ascontiguousarray(mesh.uv[mesh.f.ravel()], np.float32).ravel())
    data.update(calc_edges=True)
    if mesh.n is not None:
        data.normals_split_custom_set_from_vertices(np.asarray(mesh.n, np.float32))
    return data


def from_bmesh(built: bmesh.types.BMesh, smooth: bool) -> bpy.types.Mesh:
    data = bpy.data.meshes.new("shape")
    uv = built.loops.layers.uv.new("UV")
    for face in built.faces:
        for loop in face.loops:
            loop[uv].uv = (loop.vert.co.x + 0.5 * loop.vert.co.z, loop.vert.co.y + 0.5 * loop.vert.co.z)
    built.to_mesh(data)
    built.free()
    if smooth:
        data.shade_smooth()
    return data


def strands(path: np.ndarray, radius: float) -> bpy.types.HairCurves:
    """Hair along (K, N, 3) points, thinning towards the tip."""
    count, steps, _ = path.shape
    data = bpy.data.hair_curves.new("hair")
    data.add_curves([steps] * count)
    data.position_data.foreach_set("vector", np.ascontiguousarray(path, np.float32).ravel())
    attribute = data.attributes.get("radius") or data.attributes.new("radius", "FLOAT", "POINT")
    attribute.data.foreach_set("value", np.tile(np.linspace(radius, 0.2 * radius, steps, dtype=np.float32), count))
    return data
