# SPDX-License-Identifier: Apache-2.0
"""Optional files to build scenes from: HDRIs, OBJ furniture, glTF models.

A folder is expected to hold `hdri/*.hdr` and `models/<name>/...`; whatever is missing is simply not used.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np

from research.datagen.meshes import Mesh, merge

_TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
_DTYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@cache
def read_image(path: str, limit: int = 512) -> np.ndarray:
    """Read an 8-bit image as linear float32 (H, W, 3), no larger than `limit`."""
    from PIL import Image

    with Image.open(path) as file:
        image = file.convert("RGB")
        image.thumbnail((limit, limit))
        encoded = np.asarray(image, np.float32) / 255  # sRGB
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.clip(linear, 0.003, 0.95)


@cache
def read_obj(path: str) -> Mesh:
    """Read an OBJ file and turn it z up."""
    params = mi.traverse(mi.load_dict({"type": "obj", "filename": path}))
    v = np.array(params["vertex_positions"]).reshape(-1, 3)
    f = np.array(params["faces"]).reshape(-1, 3).astype(int)
    uv = np.array(params["vertex_texcoords"]).reshape(-1, 2)
    n = np.array(params["vertex_normals"]).reshape(-1, 3)
    mesh = Mesh(v, f, uv if len(uv) == len(v) else np.zeros((len(v), 2)), n if len(n) == len(v) else None)
    return mesh.rotated(_TO_Z_UP)


@cache
def read_gltf(path: str) -> list[tuple[Mesh, np.ndarray]]:
    """Read the parts of a glTF file by material, z up, each with its linear base-colour image or colour (H, W, 3).

    Only what these scenes need: node transforms, positions, normals, one set of texture coordinates.
    """
    folder = Path(path).parent
    doc = json.loads(Path(path).read_text())
    buffers = [np.fromfile(folder / b["uri"], np.uint8) for b in doc["buffers"]]

    def read(index: int) -> np.ndarray:
        a = doc["accessors"][index]
        view = doc["bufferViews"][a["bufferView"]]
        dtype, width = np.dtype(_DTYPES[a["componentType"]]), _WIDTHS[a["type"]]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        stride = view.get("byteStride", dtype.itemsize * width)
        raw = np.lib.stride_tricks.as_strided(
            buffers[view["buffer"]][start:], (a["count"], dtype.itemsize * width), (stride, 1)
        )
        return np.ascontiguousarray(raw).view(dtype).reshape(a["count"], width)

    def base_color(index: int | None) -> np.ndarray:
        pbr = {} if index is None else doc["materials"][index].get("pbrMetallicRoughness", {})
        factor = np.asarray(pbr.get("baseColorFactor", [0.8, 0.8, 0.8, 1])[:3], np.float32)
        if "baseColorTexture" in pbr:
            uri = doc["images"][doc["textures"][pbr["baseColorTexture"]["index"]]["source"]].get("uri")
            if uri and (folder / uri).exists():
                return read_image(str(folder / uri))
        return np.clip(np.broadcast_to(factor, (2, 2, 3)), 0.003, 0.95)

    by_material: dict[int | None, list[Mesh]] = {}

    def visit(node: dict, matrix: np.ndarray) -> None:
        local = np.eye(4)
        if "matrix" in node:
            local = np.array(node["matrix"]).reshape(4, 4).T
        else:
            x, y, z, w = node.get("rotation", (0, 0, 0, 1))
            turn = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]  # fmt: skip
            local[:3, :3] = np.array(turn) * node.get("scale", (1, 1, 1))
            local[:3, 3] = node.get("translation", (0, 0, 0))
        matrix = matrix @ local
        for p in doc["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
            v = read(p["attributes"]["POSITION"]) @ matrix[:3, :3].T + matrix[:3, 3]
            f = read(p["indices"]).reshape(-1, 3).astype(int) if "indices" in p else np.arange(len(v)).reshape(-1, 3)
            uv = read(p["attributes"]["TEXCOORD_0"]) if "TEXCOORD_0" in p["attributes"] else np.zeros((len(v), 2))
            n = read(p["attributes"]["NORMAL"]) @ np.linalg.inv(matrix[:3, :3]) if "NORMAL" in p["attributes"] else None
            if n is not None:
                n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
            uv = np.asarray(uv, float) * (1, -1) + (0, 1)
            by_material.setdefault(p.get("material"), []).append(Mesh(v, f, uv, n).rotated(_TO_Z_UP))
        for child in node.get("children", []):
            visit(doc["nodes"][child], matrix)

    for root in doc["scenes"][doc.get("scene", 0)]["nodes"]:
        visit(doc["nodes"][root], np.eye(4))
    return [(merge(parts), base_color(material)) for material, parts in by_material.items()]


class Assets:
    """The files found under a folder, or none at all."""

    def __init__(self, root: Path | None) -> None:
        root = Path(root) if root else None
        self.hdris = sorted(root.glob("hdri/*.hdr")) if root else []
        self.furniture = sorted(root.glob("models/*/*.obj")) if root else []
        self.models = sorted(root.glob("models/*/glTF/*.gltf")) if root else []

    def hdri(self, rng: np.random.Generator) -> tuple[np.ndarray, str]:
        """Pick a random HDRI, float32 (H, W, 3), and its file name."""
        path = self.hdris[rng.integers(len(self.hdris))]
        return _hdri(str(path)), path.name

    def picture(self, rng: np.random.Generator) -> np.ndarray:
        """Cut a crop out of an HDRI, exposed like a photograph: what hangs in the frames."""
        image, _ = self.hdri(rng)
        h, w, _ = image.shape
        n = int(rng.integers(128, 384))
        y, x = rng.integers(h // 5, h - n), rng.integers(0, w - n)
        crop = image[y : y + n, x : x + n]
        return np.clip(crop * 0.25 / max(float(np.median(crop)), 1e-4), 0.003, 0.9).astype(np.float32)


@cache
def _hdri(path: str) -> np.ndarray:
    return np.array(mi.Bitmap(path).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32))
