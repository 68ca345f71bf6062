# SPDX-License-Identifier: Apache-2.0
"""Build a room for `research.benchmarks.render.sequences` in which an object, the light or the camera changes.

Lengths are metres, z is up. The random parts have fixed seeds, so a frame always shows the same room.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from research.datagen import meshes, textures
from research.datagen.meshes import Mesh

#: Inner size of the room; the floor's centre is the origin.
ROOM = (6.0, 5.0, 3.0)
#: Where the camera stands and looks.
CAMERA, TARGET = np.array([0.3, -2.2, 1.5]), np.array([0.1, 2.4, 0.9])
#: Where the block in the middle stands: the object that slides or turns.
BLOCK = np.array([0.1, 0.6, 0.0])
#: The camera's axis, and how far away along it the middle of the block is.
FORWARD = (TARGET - CAMERA) / np.linalg.norm(TARGET - CAMERA)
FOCUS = float((BLOCK + np.array([0, 0, 0.3]) - CAMERA) @ FORWARD)
#: Horizontal angle of view, degrees.
ANGLE = 62.0
#: The frame at which the second lamp of "lamp_on" is on.
LAMP_ON = 5


@dataclass(frozen=True)
class Animation:
    """What changes from frame to frame."""

    slide: float = 0.0
    """Metres that an object moves, along x."""
    turn: float = 0.0
    """Radians that it turns, around z."""
    shadow: float = 0.0
    """Metres that a blocker above the picture moves, along x."""
    lamp_on: bool = False
    """A second lamp goes on."""
    mirror: bool = False
    """A mirror and a glass ball stand in the room."""
    foliage: bool = False
    """Grass and leaves stand in the room."""
    flakes: float = 0.0
    """Metres that flakes of 1 to 4 pixels fall."""
    aperture: float = 0.0
    """Radius of the camera's lens, metres; 0 is a pinhole. It is focused on the block in the middle."""
    truck: float = 0.0
    """Metres that the camera moves, to its right."""
    dolly: float = 0.0
    """Metres that it moves, forward."""


ANIMATIONS = {
    "dolly": Animation(dolly=0.05),
    "slide": Animation(slide=0.03),
    "turn": Animation(turn=0.06),
    "shadow": Animation(shadow=0.10),
    "lamp_on": Animation(lamp_on=True),
    "mirror": Animation(mirror=True, truck=0.03),
    "foliage": Animation(foliage=True, truck=0.02),
    "particles": Animation(flakes=0.03),
    "defocus": Animation(aperture=0.03, truck=0.03),
}


@dataclass
class Room:
    """A loaded frame."""

    scene: Any
    moved: list[Any] = field(default_factory=list)
    """The shapes that move."""


def camera_matrix(animation: Animation, at: float) -> np.ndarray:
    """Return the matrix from camera (x to the left) to world, (4, 4). ``at``: frames from the middle."""
    left = np.cross([0, 0, 1], FORWARD)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([left, np.cross(FORWARD, left), FORWARD], axis=1)
    matrix[:3, 3] = CAMERA + at * (animation.dolly * FORWARD - animation.truck * left)
    return matrix


def object_matrix(animation: Animation, at: float) -> np.ndarray:
    """Return where the moving object is, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = meshes.rotation((0, 0, 1), at * animation.turn)
    matrix[:3, 3] = BLOCK + at * np.array([animation.slide, 0, -animation.flakes])
    return matrix


def build_room(animation: Animation, frame: int, at: float) -> Room:
    """Return the room at a frame. ``at``: frames from the middle of the sequence."""
    from research.datagen.mitsuba import materials
    from research.datagen.mitsuba.scenes import Scene

    rng = np.random.default_rng(20)
    scene = Scene(rng, assets=None)  # type: ignore[arg-type] # only environments need assets
    width, depth, height = ROOM

    def flat(mesh: Mesh, texture: np.ndarray) -> None:
        scene.add(mesh, materials.diffuse(texture))

    x, y = width / 2, depth / 2
    flat(meshes.rectangle(width, depth).tiled(0.4), textures.wood(rng))
    flat(meshes.rectangle(width, depth).moved(0, 0, height), np.full((2, 2, 3), 0.8, np.float32))
    wall = meshes.rotation((1, 0, 0), np.pi / 2)
    flat(meshes.rectangle(width, height).tiled(0.3).rotated(wall).moved(0, y, height / 2), textures.bricks(rng))
    flat(meshes.rectangle(width, height).rotated(wall).moved(0, -y, height / 2), np.full((2, 2, 3), 0.6, np.float32))
    side = meshes.rectangle(depth, height).rotated(wall).turned(np.pi / 2).moved(0, 0, height / 2)
    flat(side.moved(-x, 0, 0), np.full((2, 2, 3), (0.7, 0.25, 0.2), np.float32))
    flat(side.moved(x, 0, 0), np.full((2, 2, 3), (0.25, 0.45, 0.7), np.float32))
    scene.add(meshes.sphere(0.35).moved(-1.1, 1.2, 0.35), materials.glossy(textures.marble(rng), 0.15))
    flat(meshes.block(0.5, 0.5, 0.9).turned(0.5).moved(1.3, 1.6, 0), textures.checker(rng))
    flat(meshes.vase(rng, 0.7).moved(-0.5, 1.9, 0), textures.dots(rng))
    # The lamp is small, so that shadows have edges.
    lamp = meshes.rectangle(0.5, 0.5).rotated(meshes.rotation((1, 0, 0), np.pi)).moved(0.6, 0.4, height - 0.02)
    scene.light(lamp, np.full(3, 100.0))
    if animation.lamp_on:
        second = meshes.rectangle(0.4, 0.4).rotated(meshes.rotation((1, 0, 0), np.pi)).moved(-1.6, 1.2, height - 0.02)
        scene.light(second, np.array([130.0, 85.0, 45.0]) if frame >= LAMP_ON else np.full(3, 1e-6))
    moved: list[str] = []

    def marked(mesh: Mesh, bsdf: Any) -> None:
        moved.append(f"mesh{len(scene.parts)}")
        scene.add(mesh, bsdf)

    block = meshes.block(0.45, 0.45, 0.6)
    place = object_matrix(animation, at)
    stands = object_matrix(Animation(), 0) if animation.flakes else place
    add_block = marked if animation.slide or animation.turn else scene.add
    add_block(block.rotated(stands[:3, :3]).moved(*stands[:3, 3]), materials.diffuse(textures.glyphs(rng)))
    if animation.flakes:
        centres = rng.uniform((-2.0, -0.6, 0.3), (2.2, 2.2, 2.8), (700, 3)) + place[:3, 3] - BLOCK
        radii = rng.uniform(0.006, 0.02, len(centres))
        flakes = [meshes.sphere(r, 8).moved(*centre) for r, centre in zip(radii, centres, strict=True)]
        marked(meshes.merge(flakes), materials.diffuse(np.full((2, 2, 3), 0.85, np.float32)))
    if animation.shadow:
        flat(meshes.block(0.5, 0.5, 0.05).moved(0.5 + at * animation.shadow, 0.5, 2.5), np.full((2, 2, 3), 0.5))
    if animation.mirror:
        glass = meshes.rectangle(1.6, 1.4).rotated(wall).moved(0.3, y - 0.02, 1.3)
        scene.add(glass, materials.mirror(np.full((2, 2, 3), 0.9, np.float32)))
        scene.add(meshes.sphere(0.3).moved(0.85, 0.7, 0.3), materials.glass())
    if animation.foliage:
        roots = np.stack([rng.uniform(-2, 2, 2500), rng.uniform(0.2, 2.2, 2500), np.zeros(2500)], axis=1)
        scene.add(meshes.blades(rng, roots, 0.35, 0.015, 0.5), materials.diffuse(textures.foliage(rng)))
        centres = rng.uniform((-2.5, 0.8, 1.2), (2.5, 2.3, 2.4), (1500, 3))
        scene.add(meshes.leaves(rng, centres, 0.12), materials.diffuse(textures.foliage(rng)))
    loaded = scene.finish()
    shapes = {shape.id(): shape for shape in loaded.shapes()}
    return Room(loaded, [shapes[name] for name in moved])
