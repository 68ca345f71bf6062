# SPDX-License-Identifier: Apache-2.0
"""Variations of rooms that other people built, in Mitsuba's XML format: other light, materials and things in them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from research.datagen import textures as tex

from .assets import Assets
from .scenes import VERSION, Rng, Scene


@dataclass(frozen=True)
class Room:
    """A scene file, y up, and the inside of the room in its own units."""

    name: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    metre: float
    credit: str


ROOMS = (
    Room("bathroom2", (-17.0, 0.11, -22.8), (16.9, 33.6, 22.4), 10.0, '"Salle de bain" by nacimus (CC-BY 3.0)'),
    Room("living-room-3", (-6.0, 0.0, -6.65), (0.3, 2.72, 0.0), 1.0, '"The Modern Living Room" by Wig42 (CC-BY 3.0)'),
)


def build(folder: Path, seed: int, assets: Assets) -> tuple[mi.Scene, Scene]:
    """Build the Mitsuba scene of a seed, and its plan: one of the rooms with its light and contents changed.

    The room is turned z up, in metres, its floor centred on the origin as those of
    :mod:`research.datagen.mitsuba.scenes`.
    """
    rng = np.random.default_rng([seed, VERSION, 99])
    room = ROOMS[rng.integers(len(ROOMS))]
    plan = Scene(rng, assets)
    plan.kind = room.name
    plan.sources.add(room.credit)
    low, high = np.array(room.low), np.array(room.high)
    width, height, depth = (high - low) / room.metre
    plan.room = np.array([width, depth, height])
    light = ("own", "dimmed", "moved", "closed", "hdri")[rng.choice(5, p=(0.2, 0.15, 0.2, 0.3, 0.15))]
    for index, shape in enumerate(_shapes(folder / room.name / "scene.xml", room, light, rng)):
        plan.parts[f"room{index}"] = shape

    if light == "hdri":
        plan.environment(float(10 ** rng.uniform(-0.3, 0.7)))
    lamps = [plan.lamp_tiny, plan.lamp_tiny, plan.lamp_shade, plan.lamp_spot, plan.lamp_panel, plan.lamp_hidden]
    for _ in range(int(rng.integers(1, 4)) if light == "closed" else int(rng.random() < 0.3)):
        lamps[rng.integers(len(lamps))]()
    if light in ("hdri", "dimmed"):  # a room whose windows let in little
        plan.lamp_tiny()

    # Points worth looking at, and level places to put things on
    bare = plan.finish()
    origins = np.stack([plan.inside(0.3, 0.8) for _ in range(60)])
    towards = rng.normal(size=(60, 3))
    towards[20:] = (0, 0, -1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    hit = bare.ray_intersect(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(towards.T)))
    points, distance, normals = hit.p.numpy().T, hit.t.numpy(), hit.n.numpy().T
    inside = np.isfinite(distance) & (np.abs(points[:, :2]) < plan.room[:2] / 2 + 0.1).all(1)
    plan.focus += list(points[:20][inside[:20]])
    tops = points[20:][inside[20:] & (normals[20:, 2] > 0.95) & (distance[20:] > 0.3)]
    for at in tops[: rng.integers(2, 12)]:
        plan.put(at, rng.uniform(0.08, 0.6) if at[2] < 0.1 else rng.uniform(0.06, 0.3), clear=0.25)
    return plan.finish(), plan


def _shapes(path: Path, room: Room, light: str, rng: Rng) -> list[mi.Shape]:
    """Read the shapes of a scene file, in metres and z up, with some materials and the emitters changed."""
    root = ET.parse(path).getroot()
    for sensor in root.findall("sensor"):
        root.remove(sensor)
    for name in root.iter("string"):
        if name.get("name") == "filename":
            name.set("value", str(path.parent / name.get("value", "")))
    _repaint(root, rng)

    low, high, scale = np.array(room.low), np.array(room.high), 1 / room.metre
    x, z = (low + high)[[0, 2]] / 2
    place = [[scale, 0, 0, -x * scale], [0, 0, -scale, z * scale], [0, scale, 0, -low[1] * scale], [0, 0, 0, 1]]
    dim = float(10 ** (rng.uniform(-2, -0.5) if light == "dimmed" else rng.uniform(-0.5, 0.5)))
    tint = rng.uniform(0.5, 1.0, 3) if rng.random() < 0.4 else np.ones(3)
    for shape in root.findall("shape"):
        emitter = shape.find("emitter")
        if emitter is not None and light in ("closed", "hdri"):
            root.remove(shape)
            continue
        transform = shape.find("transform")
        if transform is None:
            transform = ET.SubElement(shape, "transform", name="toWorld")
        if emitter is not None:
            for radiance in emitter.findall("rgb"):
                values = np.array([float(v) for v in radiance.get("value", "").split(",")]) * dim * tint
                radiance.set("value", ", ".join(map(str, values)))
            if light == "moved":
                shift = rng.uniform(-0.25, 0.25, 3) * (high - low)
                ET.SubElement(transform, "translate", dict(zip("xyz", map(str, shift), strict=True)))
        ET.SubElement(transform, "matrix", value=" ".join(str(v) for row in place for v in row))
    return mi.load_string(ET.tostring(root, encoding="unicode")).shapes()


def _repaint(root: ET.Element, rng: Rng) -> None:
    """Give some plain diffuse colours another hue, and panes of glass in place of their diffuse stand-in."""
    for bsdf in root.findall("bsdf"):
        if bsdf.get("id") == "Glass" and bsdf.get("type") == "diffuse" and rng.random() < 0.7:
            bsdf.set("type", "thindielectric")
            for child in list(bsdf):
                bsdf.remove(child)
    for colour in root.iter("rgb"):
        if colour.get("name") in ("reflectance", "diffuseReflectance"):
            old = np.array([float(v) for v in colour.get("value", "").replace(",", " ").split()])
            new = tex.color(rng, 0.1, 0.9) if rng.random() < 0.35 else np.minimum(old, 0.85)
            colour.set("value", ", ".join(f"{v:.4f}" for v in new))
