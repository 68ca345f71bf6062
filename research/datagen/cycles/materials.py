# SPDX-License-Identifier: GPL-3.0-or-later
"""Random materials as Cycles shader nodes: Principled BSDFs over textures, glass, leaves, hair, lamps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import bpy
import numpy as np

from research.datagen import textures as tex

Rng = np.random.Generator
Material: TypeAlias = bpy.types.Material
Socket: TypeAlias = bpy.types.NodeSocket
_SOCKET, _NODE = bpy.types.NodeSocket, bpy.types.Node  # mypy takes no alias in isinstance


def rgba(color: np.ndarray | tuple[float, float, float]) -> tuple[float, float, float, float]:
    return (float(color[0]), float(color[1]), float(color[2]), 1.0)


def chance(rng: Rng, share: float) -> bool:
    return bool(rng.random() < share)


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """Draw a number between two positive ones, each scale as likely."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


class Graph:
    """The nodes of one material or world, built by name."""

    def __init__(self, owner: bpy.types.Material | bpy.types.World) -> None:
        owner.use_nodes = True
        self.owner, self.tree = owner, owner.node_tree
        self.tree.nodes.clear()
        self.output = self.add("ShaderNodeOutputWorld" if isinstance(owner, bpy.types.World)
                               else "ShaderNodeOutputMaterial")  # fmt: skip

    def add(self, kind: str, inputs: Mapping[Any, Any] | None = None, **attributes: Any) -> bpy.types.Node:
        """Add a node; `inputs` are sockets or nodes to link, colours (3,) or numbers, `attributes` the node's own."""
        node = self.tree.nodes.new(kind)
        for name, value in attributes.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            socket = node.inputs[key]
            if isinstance(value, (_SOCKET, _NODE)):
                self.tree.links.new(value if isinstance(value, _SOCKET) else value.outputs[0], socket)
            elif np.ndim(value) == 1:
                socket.default_value = rgba(value) if socket.type == "RGBA" else [float(v) for v in value]
            else:
                socket.default_value = float(value)
        return node

    def surface(self, shader: bpy.types.Node, socket: str = "Surface") -> Material:
        """Finish with a shader; return the material."""
        self.tree.links.new(shader.outputs[0], self.output.inputs[socket])
        return self.owner

    def mix(self, factor: Socket | float, a: Any, b: Any, blend: str = "MIX") -> Socket:
        """Mix two colours, (3,) or sockets."""
        inputs = {0: factor, 6: a, 7: b}  # sockets of colours follow those of other types
        return self.add("ShaderNodeMix", inputs, data_type="RGBA", blend_type=blend).outputs[2]

    def span(self, value: Socket, low: float, high: float) -> Socket:
        """0..1 to low..high."""
        return self.add("ShaderNodeMapRange", {0: value, 3: low, 4: high}).outputs[0]

    def threshold(self, value: Socket, edge: float, width: float) -> Socket:
        """Return a step of 0 to 1 about `edge`, `width` wide."""
        return self.add("ShaderNodeMapRange", {0: value, 1: edge - width / 2, 2: edge + width / 2}).outputs[0]

    def coordinates(self, scale: np.ndarray | float = 1.0, name: str = "Object") -> Socket:
        """Positions in metres, or the texture coordinates of a mesh (`UV`), times `scale`."""
        coords = self.add("ShaderNodeTexCoord").outputs[name]
        # An offset keeps faces of boxes away from where 3-D patterns change.
        inputs = {"Vector": coords, "Scale": np.broadcast_to(scale, 3), "Location": (0.013, 0.0171, 0.0213)}
        return self.add("ShaderNodeMapping", inputs).outputs[0]


def new(name: str) -> Graph:
    """Return the empty graph of a new material."""
    return Graph(bpy.data.materials.new(name))


def image_node(graph: Graph, image: np.ndarray, vector: Socket, nearest: bool = False) -> Socket:
    """Return a bitmap of linear values (H, W, 3)."""
    h, w, _ = image.shape
    data = bpy.data.images.new("bitmap", w, h, float_buffer=True)
    data.colorspace_settings.name = "Linear Rec.709"
    pixels = np.ones((h, w, 4), np.float32)
    pixels[..., :3] = image[::-1]
    data.pixels.foreach_set(pixels.ravel())
    data.update()
    node = graph.add("ShaderNodeTexImage", {"Vector": vector}, interpolation="Closest" if nearest else "Linear")
    node.image = data
    return node.outputs["Color"]


# Patterns: functions of a graph that return a colour socket


def _pigments(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    return tex.color(rng), tex.color(rng)


def noise(graph: Graph, rng: Rng, frequency: float) -> Socket:
    a, b = _pigments(rng)
    stretch = frequency * np.array([1, 1, 1 if chance(rng, 0.6) else rng.uniform(0.05, 0.3)])
    node = graph.add("ShaderNodeTexNoise", {
        "Vector": graph.coordinates(stretch), "Scale": 1, "Detail": rng.uniform(2, 10),
        "Roughness": rng.uniform(0.4, 0.75), "Distortion": rng.exponential(0.6),
    })  # fmt: skip
    return graph.mix(graph.threshold(node.outputs[0], 0.5, rng.uniform(0.05, 0.6)), a, b)


def cells(graph: Graph, rng: Rng, frequency: float) -> Socket:
    a, b = _pigments(rng)
    edges = chance(rng, 0.5)
    node = graph.add("ShaderNodeTexVoronoi", {"Vector": graph.coordinates(frequency), "Scale": 1},
                     feature="DISTANCE_TO_EDGE" if edges else "F1")  # fmt: skip
    if edges:
        return graph.mix(graph.threshold(node.outputs["Distance"], rng.uniform(0.02, 0.15), 0.02), a, b)
    return graph.mix(rng.uniform(0.2, 0.9), a, node.outputs["Color"], "MULTIPLY" if chance(rng, 0.5) else "MIX")


def waves(graph: Graph, rng: Rng, frequency: float) -> Socket:
    a, b = _pigments(rng)
    node = graph.add("ShaderNodeTexWave", {
        "Vector": graph.coordinates(frequency), "Scale": 1, "Distortion": rng.exponential(4), "Detail": 4,
        "Detail Scale": rng.uniform(0.5, 3),
    }, wave_type="RINGS" if chance(rng, 0.3) else "BANDS", bands_direction=str(rng.choice(list("XYZ"))),
        wave_profile=str(rng.choice(["SIN", "SAW", "TRI"])))  # fmt: skip
    return graph.mix(node.outputs["Color"], a, b)


def masonry(graph: Graph, rng: Rng, frequency: float) -> Socket:
    a, b = _pigments(rng)
    node = graph.add("ShaderNodeTexBrick", {
        "Vector": graph.coordinates(frequency, "UV"), "Color1": a, "Color2": a * rng.uniform(0.3, 1.2), "Mortar": b,
        "Scale": 1, "Mortar Size": rng.uniform(0.004, 0.03), "Brick Width": rng.uniform(0.3, 1.5),
        "Row Height": rng.uniform(0.1, 0.4),
    })  # fmt: skip
    grain = graph.add("ShaderNodeTexNoise", {"Vector": graph.coordinates(frequency * 9), "Scale": 1, "Detail": 6})
    return graph.mix(rng.uniform(0, 0.7), node.outputs["Color"], grain.outputs[0], "OVERLAY")


def checks(graph: Graph, rng: Rng, frequency: float) -> Socket:
    a, b = _pigments(rng)
    return graph.add("ShaderNodeTexChecker", {"Vector": graph.coordinates(frequency, "UV"), "Scale": 1, "Color1": a,
                                              "Color2": b}).outputs["Color"]  # fmt: skip


def planks(graph: Graph, rng: Rng, frequency: float) -> Socket:
    base = np.array([0.36, 0.18, 0.08]) * rng.uniform(0.15, 1.8) * rng.uniform(0.8, 1.2, 3)
    inputs = {"Vector": graph.coordinates(frequency, "UV"), "Scale": 1, "Mortar Size": 0.005, "Brick Width": 1.4}
    inputs |= {"Color1": base, "Color2": base * rng.uniform(0.4, 0.9), "Mortar": base * 0.1}
    boards = graph.add("ShaderNodeTexBrick", inputs | {"Row Height": rng.uniform(0.08, 0.25)})
    grain = graph.add("ShaderNodeTexNoise", {"Vector": graph.coordinates(frequency * np.array([2, 40, 30]), "UV"),
                                             "Scale": 1, "Detail": 8, "Roughness": 0.65})  # fmt: skip
    return graph.mix(rng.uniform(0.3, 0.8), boards.outputs["Color"], grain.outputs[0], "OVERLAY")


def plaid(graph: Graph, rng: Rng, frequency: float) -> Socket:
    """Crossed stripes: cloth."""
    color: object = tex.color(rng)
    for axis in "XYXY"[: rng.integers(2, 5)]:
        wave = graph.add("ShaderNodeTexWave", {"Vector": graph.coordinates(frequency * rng.uniform(0.4, 2), "UV"),
                                               "Scale": 1, "Distortion": 0}, bands_direction=axis)  # fmt: skip
        factor = graph.threshold(wave.outputs["Fac"], rng.uniform(0.4, 0.9), 0.1)
        color = graph.mix(graph.span(factor, 0, rng.uniform(0.3, 0.9)), color, tex.color(rng))
    return color


def magic(graph: Graph, rng: Rng, frequency: float) -> Socket:
    inputs = {"Vector": graph.coordinates(frequency), "Scale": 1, "Distortion": rng.uniform(0.5, 3)}
    node = graph.add("ShaderNodeTexMagic", inputs, turbulence_depth=int(rng.integers(1, 6)))
    return graph.mix(rng.uniform(0.4, 1), tex.color(rng), node.outputs["Color"], "MULTIPLY")


def bitmap(graph: Graph, rng: Rng, frequency: float) -> Socket:
    """One of the images that the Mitsuba scenes have too."""
    return image_node(graph, tex.pattern(rng, 0.0), graph.coordinates(0.35 * frequency, "UV"), chance(rng, 0.1))


PATTERNS: list[Callable[[Graph, Rng, float], Socket]] = [
    noise, noise, cells, waves, masonry, masonry, checks, planks, planks, plaid, magic, bitmap, bitmap, bitmap,
]  # fmt: skip


def color(graph: Graph, rng: Rng, plainness: float, frequency: float) -> Socket | np.ndarray:
    """Draw a plain colour with probability `plainness`, else a pattern with about `frequency` features a metre."""
    if chance(rng, plainness):
        return tex.color(rng)
    return PATTERNS[rng.integers(len(PATTERNS))](graph, rng, frequency * 10 ** rng.uniform(-0.4, 0.4))


def bump(graph: Graph, rng: Rng, frequency: float) -> Socket:
    """Return a normal disturbed by noise or cells, at several times the frequency of the colour."""
    vector = graph.coordinates(frequency * 10 ** rng.uniform(0.3, 1.3))
    if chance(rng, 0.7):
        height = graph.add("ShaderNodeTexNoise", {"Vector": vector, "Scale": 1, "Detail": rng.uniform(1, 8)}).outputs[0]
    else:
        height = graph.add("ShaderNodeTexVoronoi", {"Vector": vector, "Scale": 1}).outputs["Distance"]
    inputs = {"Height": height, "Strength": rng.uniform(0.1, 0.9), "Distance": 0.05 / frequency}
    return graph.add("ShaderNodeBump", inputs).outputs[0]


# Materials


def principled(graph: Graph, rng: Rng, inputs: dict[str, Any], frequency: float = 4.0, bumpy: float = 0.25) -> Material:
    """Return a Principled BSDF with some `inputs`, sometimes with a bumpy surface or a patchy roughness."""
    if chance(rng, bumpy):
        inputs["Normal"] = bump(graph, rng, frequency)
    roughness = inputs.get("Roughness", 0.5)
    if not isinstance(roughness, _SOCKET) and chance(rng, 0.25):
        patches = graph.add("ShaderNodeTexNoise", {"Vector": graph.coordinates(frequency), "Scale": 1, "Detail": 5})
        inputs["Roughness"] = graph.span(graph.threshold(patches.outputs[0], 0.5, 0.4), roughness * 0.4,
                                         min(roughness * 1.5 + 0.05, 1))  # fmt: skip
    return graph.surface(graph.add("ShaderNodeBsdfPrincipled", inputs))


def paint(rng: Rng, plainness: float = 0.35, frequency: float = 2.0, light: bool = False) -> Material:
    """Walls, floors and most things: from matt to polished."""
    graph = new("paint")
    base = color(graph, rng, plainness, frequency)
    if light:  # what fills the shadows of a real interior
        base = graph.mix(rng.uniform(0.5, 0.85), base, rng.uniform(0.6, 0.85) * np.array([1, 0.97, 0.92]))
    shine = rng.random()
    roughness = rng.uniform(*((0.6, 1) if shine < 0.5 else (0.15, 0.6) if shine < 0.85 else (0.02, 0.15)))
    inputs = {"Base Color": base, "Roughness": roughness, "Diffuse Roughness": float(chance(rng, 0.3))}
    return principled(graph, rng, inputs, frequency)


def cloth(rng: Rng, frequency: float = 8.0) -> Material:
    graph = new("cloth")
    inputs = {"Base Color": color(graph, rng, 0.3, frequency), "Roughness": 0.9, "Sheen Weight": rng.uniform(0, 1),
              "Sheen Roughness": rng.uniform(0.2, 0.7), "Sheen Tint": tex.color(rng)}  # fmt: skip
    return principled(graph, rng, inputs, frequency, bumpy=0.6)


def metal(rng: Rng, frequency: float = 4.0) -> Material:
    graph = new("metal")
    tints = [(0.95, 0.64, 0.30), (0.95, 0.79, 0.52), (0.91, 0.92, 0.92), (0.55, 0.56, 0.55), (0.97, 0.96, 0.91)]
    tint = np.array(tints[rng.integers(len(tints))]) if chance(rng, 0.8) else tex.color(rng, 0.2, 0.95)
    base = tint if chance(rng, 0.7) else graph.mix(0.6, tint, color(graph, rng, 0, frequency), "MULTIPLY")
    roughness = 0.0 if chance(rng, 0.15) else 10 ** rng.uniform(-1.6, -0.2)
    inputs = {"Base Color": base, "Metallic": 1, "Roughness": roughness}
    inputs["Anisotropic"] = rng.uniform(0, 0.9) * chance(rng, 0.3)
    return principled(graph, rng, inputs, frequency)


def coated(rng: Rng, frequency: float = 4.0) -> Material:
    """Car paint, lacquer, glazed ceramics."""
    graph = new("coated")
    inputs = {"Base Color": color(graph, rng, 0.6, frequency), "Roughness": rng.uniform(0.2, 0.8)}
    inputs["Metallic"] = rng.uniform(0, 1) * chance(rng, 0.4)
    inputs |= {"Coat Weight": 1, "Coat Roughness": 10 ** rng.uniform(-2, -0.7)}
    inputs["Coat Tint"] = np.ones(3) if chance(rng, 0.6) else tex.color(rng, 0.3, 1)
    return principled(graph, rng, inputs, frequency, bumpy=0.15)


def waxen(rng: Rng, size: float) -> Material:
    """Subsurface scattering: wax, skin, soap, marble; `size` of the object in metres."""
    graph = new("waxen")
    inputs = {"Base Color": np.clip(tex.color(rng, 0.3, 0.95), 0, 1), "Roughness": rng.uniform(0.15, 0.6)}
    inputs |= {"Subsurface Weight": 1, "Subsurface Radius": rng.uniform(0.2, 1, 3)}
    inputs["Subsurface Scale"] = size * rng.uniform(0.03, 0.3)
    return principled(graph, rng, inputs, 4 / size)


def glass(rng: Rng) -> Material:
    """For closed meshes."""
    graph = new("glass")
    tint = tex.color(rng, 0.5, 1.0) if chance(rng, 0.3) else np.full(3, 0.97)
    roughness = 0.0 if chance(rng, 0.65) else 10 ** rng.uniform(-1.5, -0.3)
    inputs = {"Base Color": tint, "Roughness": roughness, "IOR": rng.uniform(1.3, 1.7), "Transmission Weight": 1}
    if chance(rng, 0.1):
        inputs |= {"Thin Film Thickness": rng.uniform(200, 700), "Thin Film IOR": 1.33}
    return principled(graph, rng, inputs, 6.0, bumpy=0.15)


def pane(rng: Rng) -> Material:
    """Return a pane that lets shadow rays through, as users build it: Cycles would find no light behind glass."""
    graph = new("pane")
    path = graph.add("ShaderNodeLightPath")
    clear = graph.add("ShaderNodeBsdfTransparent", {"Color": (0.92, 0.95, 0.93)})
    fresnel = graph.add("ShaderNodeFresnel", {"IOR": 1.45})
    gloss = graph.add("ShaderNodeBsdfAnisotropic", {"Color": np.ones(3), "Roughness": rng.uniform(0, 0.05)})
    seen = graph.add("ShaderNodeMixShader", {0: fresnel, 1: clear, 2: gloss})
    return graph.surface(graph.add("ShaderNodeMixShader", {0: path.outputs["Is Shadow Ray"], 1: seen, 2: clear}))


def leaf(rng: Rng) -> Material:
    """Thin and translucent; the colour varies with u from leaf to leaf and from object to object."""
    graph = new("leaf")
    base = image_node(graph, tex.foliage(rng), graph.add("ShaderNodeTexCoord").outputs["UV"])
    front = graph.add("ShaderNodeBsdfPrincipled", {"Base Color": base, "Roughness": rng.uniform(0.25, 0.6),
                                                   "Specular IOR Level": 0.5 * chance(rng, 0.5)})  # fmt: skip
    back = graph.add("ShaderNodeBsdfTranslucent", {"Color": base})
    return graph.surface(graph.add("ShaderNodeMixShader", {0: rng.uniform(0.1, 0.5), 1: front, 2: back}))


def shade(rng: Rng) -> Material:
    """Lampshades and curtains: light passes, diffused."""
    graph = new("shade")
    base = color(graph, rng, 0.6, 10.0)
    base = graph.mix(0.6, base, np.array([0.9, 0.85, 0.75]))
    front = graph.add("ShaderNodeBsdfDiffuse", {"Color": base})
    back = graph.add("ShaderNodeBsdfTranslucent", {"Color": base})
    return graph.surface(graph.add("ShaderNodeMixShader", {0: rng.uniform(0.15, 0.6), 1: front, 2: back}))


def palette(rng: Rng) -> Material:
    """Return a bitmap of unrelated colours, for meshes whose parts each take one."""
    graph = new("palette")
    base = image_node(graph, tex.palette(rng), graph.add("ShaderNodeTexCoord").outputs["UV"], nearest=True)
    return principled(graph, rng, {"Base Color": base, "Roughness": rng.uniform(0.2, 0.9)}, 10.0)


def hair(rng: Rng) -> Material:
    graph = new("hair")
    if chance(rng, 0.5):
        inputs = {"Roughness": rng.uniform(0.15, 0.5), "Color": tex.color(rng, 0.05, 0.9)}
        return graph.surface(graph.add("ShaderNodeBsdfHairPrincipled", inputs, parametrization="COLOR"))
    return graph.surface(graph.add("ShaderNodeBsdfDiffuse", {"Color": tex.color(rng)}))


def picture(image: np.ndarray, rng: Rng) -> Material:
    """Return an image over the whole unit square of the texture coordinates."""
    graph = new("picture")
    base = image_node(graph, image, graph.add("ShaderNodeTexCoord").outputs["UV"])
    return principled(graph, rng, {"Base Color": base, "Roughness": rng.uniform(0.05, 0.9)}, bumpy=0.1)


def lamp(radiance: np.ndarray) -> Material:
    graph = new("lamp")
    strength = float(np.max(radiance))
    inputs = {"Color": radiance / max(strength, 1e-9), "Strength": strength}
    return graph.surface(graph.add("ShaderNodeEmission", inputs))


def screen(rng: Rng, strength: float) -> Material:
    """Return a display, neon sign or lit poster: an emitter with an image."""
    graph = new("screen")
    base = image_node(graph, tex.pattern(rng, 0.0), graph.add("ShaderNodeTexCoord").outputs["UV"])
    return graph.surface(graph.add("ShaderNodeEmission", {"Color": base, "Strength": strength}))


def fog(rng: Rng, density: float) -> Material:
    graph = new("fog")
    inputs = {"Color": 1 - 0.2 * rng.random(3), "Density": density, "Anisotropy": rng.uniform(0, 0.8)}
    return graph.surface(graph.add("ShaderNodeVolumeScatter", inputs), "Volume")


def thing(rng: Rng, size: float, shiny: float = 0.25, clear: float = 0.1) -> Material:
    """Anything, for an object of about `size` metres."""
    kind, frequency = rng.random(), float(np.clip(4 / size, 2, 60))
    if kind < clear:
        return glass(rng)
    if kind < clear + shiny:
        return metal(rng, frequency)
    kind = rng.random()
    if kind < 0.55:
        return paint(rng, 0.35, frequency)
    if kind < 0.7:
        return coated(rng, frequency)
    if kind < 0.82:
        return cloth(rng, frequency)
    return waxen(rng, size) if kind < 0.92 else palette(rng)
