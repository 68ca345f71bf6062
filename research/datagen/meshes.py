# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: RUF005 -- adding a list to an array is a sum, not a concatenation
"""Procedural triangle meshes: z is up; lengths and texture coordinates are metres unless said."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

Rng = np.random.Generator


@dataclass
class Mesh:
    """Vertices (N, 3), triangles (M, 3), texture coordinates (N, 2), normals (N, 3) or None for flat."""

    v: np.ndarray
    f: np.ndarray
    uv: np.ndarray
    n: np.ndarray | None = None

    @property
    def low(self) -> np.ndarray:
        return self.v.min(0)

    @property
    def high(self) -> np.ndarray:
        return self.v.max(0)

    def scaled(self, s: float | tuple[float, float, float]) -> Mesh:
        sizes = np.broadcast_to(np.asarray(s, float), 3)
        return Mesh(self.v * sizes, self.f, self.uv, None if self.n is None else unit(self.n / sizes))

    def moved(self, *t: float) -> Mesh:
        return Mesh(self.v + np.asarray(t, float), self.f, self.uv, self.n)

    def rotated(self, m: np.ndarray) -> Mesh:
        return Mesh(self.v @ m.T, self.f, self.uv, None if self.n is None else self.n @ m.T)

    def turned(self, angle: float) -> Mesh:
        """Turn around z by `angle` radians."""
        return self.rotated(rotation((0, 0, 1), angle))

    def tiled(self, k: float) -> Mesh:
        """Texture coordinates multiplied by k."""
        return Mesh(self.v, self.f, self.uv * k, self.n)

    def tinted(self, u: float) -> Mesh:
        """All texture coordinates at the one place u: a single colour of a palette texture."""
        return Mesh(self.v, self.f, np.tile((u, 0.5), (len(self.v), 1)), self.n)

    def fitted(self, size: float) -> Mesh:
        """Centred in x and y, standing on z = 0, its largest extent `size`."""
        low, high = self.low, self.high
        centre = np.array([*(low + high)[:2] / 2, low[2]])
        return self.moved(*-centre).scaled(size / max((high - low).max(), 1e-6))


def unit(a: np.ndarray) -> np.ndarray:
    return a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12)


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' rotation matrix, 3 x 3."""
    x, y, z = unit(np.asarray(axis, float))
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def random_rotation(rng: Rng) -> np.ndarray:
    return rotation(tuple(rng.normal(size=3)), rng.uniform(0, 2 * np.pi))


def merge(parts: list[Mesh]) -> Mesh:
    """One mesh of many; it has vertex normals only if all parts have."""
    offsets = np.cumsum([0] + [len(p.v) for p in parts[:-1]])
    smooth = all(p.n is not None for p in parts)
    return Mesh(
        np.concatenate([p.v for p in parts]),
        np.concatenate([p.f + o for p, o in zip(parts, offsets, strict=True)]),
        np.concatenate([p.uv for p in parts]),
        np.concatenate([p.n for p in parts]) if smooth else None,
    )


def quads(corners: np.ndarray, uv: np.ndarray | None = None) -> Mesh:
    """Separate quads from (K, 4, 3) corners in order; `uv` (K, 4, 2), else the unit square on each."""
    k = len(corners)
    if uv is None:
        uv = np.broadcast_to(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), (k, 4, 2))
    base = 4 * np.arange(k)[:, None]
    f = np.concatenate([base + [0, 1, 2], base + [0, 2, 3]])
    return Mesh(corners.reshape(-1, 3), f, np.ascontiguousarray(uv.reshape(-1, 2)))


def rectangle(w: float, h: float) -> Mesh:
    """In the xy plane, centred, facing +z; texture coordinates in metres."""
    c = np.array([[[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]]]) / 2
    return quads(c, c[..., :2] + (w / 2, h / 2))


_BOX_FACES = np.array(
    [[0, 2, 6, 4], [1, 5, 7, 3], [0, 4, 5, 1], [2, 3, 7, 6], [0, 1, 3, 2], [4, 6, 7, 5]]
)  # corner index = x + 2 y + 4 z; the faces at -x, +x, -y, +y, -z, +z
_BOX_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], float)


def box(low: tuple | np.ndarray, high: tuple | np.ndarray) -> Mesh:
    """Axis-parallel; texture coordinates are positions, so that neighbours line up."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = (low + _BOX_CORNERS * (high - low))[_BOX_FACES]
    axes = [(1, 2), (1, 2), (0, 2), (0, 2), (0, 1), (0, 1)]
    return quads(corners, np.stack([c[:, list(a)] for c, a in zip(corners, axes, strict=True)]))


def block(w: float, d: float, h: float) -> Mesh:
    """Return a box standing on z = 0, centred in x and y."""
    return box((-w / 2, -d / 2, 0), (w / 2, d / 2, h))


def surface(points: np.ndarray, uv: np.ndarray) -> Mesh:
    """Return a smooth grid surface from (A, B, 3) points; normals from the grid's own differences."""
    a, b = points.shape[:2]
    normal = unit(np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0)))
    i = (np.arange(a - 1)[:, None] * b + np.arange(b - 1)).ravel()
    f = np.concatenate([np.stack([i, i + 1, i + b], 1), np.stack([i + 1, i + b + 1, i + b], 1)])
    return _wound(Mesh(points.reshape(-1, 3), f, uv.reshape(-1, 2)), normal.reshape(-1, 3))


def _wound(mesh: Mesh, normals: np.ndarray) -> Mesh:
    """Set normals, and wind each triangle the way they point: glass needs to know inside from outside."""
    v, f, mesh.n = mesh.v, mesh.f, normals
    facing = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    flip = (facing * normals[f].sum(1)).sum(1) < 0
    f[flip] = f[flip][:, [0, 2, 1]]
    return mesh


def lathe(profile: np.ndarray, sides: int = 48) -> Mesh:
    """Turn (K, 2) points (radius, z), listed from the bottom up, around z; outward normals."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    r, z = profile[:, :1], profile[:, 1:]
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z + 0 * angle], axis=-1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(angle[None] * max(r.max(), 1e-3), length[:, None]), axis=-1)
    mesh = surface(points, uv)
    # At the seam and at the poles grid differences fail: take the profile's own normal instead.
    t = np.gradient(profile, axis=0)
    n = unit(np.stack([t[:, 1:] * np.cos(angle), t[:, 1:] * np.sin(angle), -t[:, :1] + 0 * angle], axis=-1))
    return _wound(mesh, n.reshape(-1, 3))


def sphere(radius: float, sides: int = 40) -> Mesh:
    t = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    return lathe(radius * np.stack([np.cos(t), np.sin(t)], 1), sides)


def cylinder(radius: float, height: float, sides: int = 32) -> Mesh:
    """Return a cylinder that stands on z = 0: closed, and flat-shaded so that the rims stay sharp."""
    m = lathe(np.array([[1e-4, 0], [radius, 0], [radius, height], [1e-4, height]]), sides)
    return Mesh(m.v, m.f, m.uv)


def torus(major: float, minor: float, sides: int = 48) -> Mesh:
    t = np.linspace(0, 2 * np.pi, 25)
    return lathe(np.stack([major + minor * np.cos(t), minor * np.sin(t)], 1), sides)


def vase(rng: Rng, height: float) -> Mesh:
    """Return an open vessel with a wall of real thickness, so that it may be of glass."""
    t = np.linspace(0, 1, 24)
    width = height * rng.uniform(0.15, 0.4)
    r = width * (0.6 + 0.35 * np.sin(t * rng.uniform(2, 7) + rng.uniform(0, 6)) + 0.2 * t)
    wall = max(0.004, 0.06 * width)
    outside = np.stack([r, t * height], 1)
    inside = np.stack([np.maximum(r - wall, 0.002), np.maximum(t * height, wall * 2)], 1)[::-1]
    ends = np.array([[1e-4, 0]]), np.array([[1e-4, wall * 2]])
    return lathe(np.concatenate([ends[0], outside, inside, ends[1]]), 48)


def blob(rng: Rng, radius: float, amount: float) -> Mesh:
    """Return a sphere displaced by a few random waves: stone, cushion, clay."""
    a, b = np.meshgrid(np.linspace(0.02, np.pi - 0.02, 48), np.linspace(0, 2 * np.pi, 65), indexing="ij")
    d = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], -1)
    r = np.ones_like(a)
    for _ in range(8):
        k = rng.normal(size=3) * rng.uniform(1, 6)
        r += amount / np.linalg.norm(k) * np.sin(d @ k + rng.uniform(0, 6))
    mesh = surface(d * (radius * r)[..., None], np.stack([b * radius, a * radius], -1))
    if mesh.n is not None and (mesh.n * mesh.v).sum() < 0:
        mesh.n, mesh.f = -mesh.n, mesh.f[:, ::-1].copy()
    return mesh


def tube(path: np.ndarray, radius: float | np.ndarray, sides: int = 8) -> Mesh:
    """Return a tube along (K, 3) points."""
    t = unit(np.gradient(path, axis=0))
    side = unit(np.cross(t, (0.31, 0.87, 0.39)))
    across = np.cross(t, side)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    ring = np.cos(angle) * side[:, None] + np.sin(angle) * across[:, None]
    radius = np.broadcast_to(radius, len(path))
    points = path[:, None] + radius[:, None, None] * ring
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(length[:, None], angle[:, 0][None] * radius.max()), -1)
    mesh = surface(points, uv)
    mesh.n = ring.reshape(-1, 3)
    return mesh


def knot(rng: Rng, size: float) -> Mesh:
    """Return a (p, q) torus knot."""
    p, q = rng.choice([(2, 3), (3, 2), (3, 4), (2, 5), (5, 2)])
    t = np.linspace(0, 2 * np.pi, 200)
    r = 1 + 0.4 * np.cos(q * t)
    path = np.stack([r * np.cos(p * t), r * np.sin(p * t), 0.4 * np.sin(q * t)], 1)
    return tube(path * size / 2.6, size * rng.uniform(0.03, 0.09), 12)


def blades(rng: Rng, roots: np.ndarray, length: float, width: float, bend: float) -> Mesh:
    """Grass: a bent two-segment blade on each of (K, 3) roots; u is random per blade, v runs along it."""
    k = len(roots)
    heading = rng.uniform(0, 2 * np.pi, k)
    lean = np.stack([np.cos(heading), np.sin(heading), np.zeros(k)], 1)
    across = np.stack([-lean[:, 1], lean[:, 0], np.zeros(k)], 1) * width / 2
    size = length * rng.uniform(0.4, 1.2, (k, 1))
    middle = roots + size * (0.5 * np.array([0, 0, 1.0]) + 0.15 * bend * lean)
    tip = roots + size * (np.array([0, 0, 0.95]) + bend * rng.uniform(0.2, 1, (k, 1)) * lean)
    v = np.stack([roots - across, roots + across, middle + 0.7 * across, middle - 0.7 * across, tip], 1)
    base = 5 * np.arange(k)[:, None]
    f = np.concatenate([base + [0, 1, 2], base + [0, 2, 3], base + [3, 2, 4]])
    u = np.repeat(rng.uniform(0, 1, k), 5)
    return Mesh(v.reshape(-1, 3), f, np.stack([u, np.tile([0, 0, 0.5, 0.5, 1], k)], 1))


def leaves(rng: Rng, centres: np.ndarray, size: float) -> Mesh:
    """Return a pointed, folded leaf of random orientation on each of (K, 3) centres; u is random per leaf."""
    k = len(centres)
    along = unit(rng.normal(size=(k, 3)) - (0, 0, 0.5)) * size * rng.uniform(0.5, 1.2, (k, 1))
    across = unit(np.cross(along, rng.normal(size=(k, 3)))) * size * 0.3
    fold = np.cross(along, across) * (0.6 / size)
    v = np.stack(
        [centres, centres + along * 0.45 + across + fold, centres + along, centres + along * 0.45 - across + fold], 1
    )
    base = 4 * np.arange(k)[:, None]
    f = np.concatenate([base + [0, 1, 2], base + [0, 2, 3]])
    u = np.repeat(rng.uniform(0, 1, k), 4)
    return Mesh(v.reshape(-1, 3), f, np.stack([u, np.tile([0, 0.5, 1, 0.5], k)], 1))


def strands(rng: Rng, roots: np.ndarray, out: np.ndarray, length: float, width: float) -> Mesh:
    """Hair: a curled flat ribbon of six segments on each of (K, 3) roots along (K, 3) unit directions."""
    k, steps = len(roots), 7
    t = np.linspace(0, 1, steps)[None, :, None]
    curl = rng.normal(size=(k, 1, 3)) * 0.35
    size = length * rng.uniform(0.6, 1.1, (k, 1, 1))
    path = roots[:, None] + size * (t * out[:, None] + t**2 * (curl - (0, 0, 0.5)))
    across = unit(np.cross(out, rng.normal(size=(k, 3))))[:, None] * width / 2 * (1.1 - t)
    v = np.stack([path - across, path + across], 2)  # (k, steps, 2, 3)
    i = (np.arange(k)[:, None] * steps + np.arange(steps - 1)).reshape(-1, 1) * 2
    f = np.concatenate([i + [0, 1, 3], i + [0, 3, 2]])
    u = np.repeat(rng.uniform(0, 1, k), steps * 2)
    return Mesh(v.reshape(-1, 3), f, np.stack([u, np.repeat(np.tile(t.ravel(), k), 2)], 1))


def branching(rng: Rng, height: float, radius: float, levels: int) -> tuple[Mesh, np.ndarray]:
    """Return a bare tree and the (K, 3) points where its leaves grow."""
    tubes, tips = [], []

    def grow(start: np.ndarray, direction: np.ndarray, length: float, r: float, level: int) -> None:
        t = np.linspace(0, 1, 6)[:, None]
        bend = rng.normal(size=3) * 0.25
        path = start + length * (t * direction + t**2 * bend)
        tubes.append(tube(path, np.linspace(r, r * 0.6, 6), 6))
        if level == 0:
            tips.extend(path[2:])
            return
        for _ in range(rng.integers(2, 5)):
            at = path[rng.integers(3, 6)]
            d = unit(direction + rng.normal(size=3) * 0.65 + (0, 0, 0.15))
            grow(at, d, length * rng.uniform(0.5, 0.8), r * 0.55, level - 1)

    grow(np.zeros(3), np.array([0, 0, 1.0]), height * 0.4, radius, levels)
    return merge(tubes), np.array(tips)


def wall(length: float, height: float, thick: float, holes: list[tuple[float, float, float, float]]) -> Mesh:
    """Return a wall along x from 0 to `length`, y in [0, thick], with (x0, z0, x1, z1) holes cut out."""
    xs = sorted({0.0, length, *(h[0] for h in holes), *(h[2] for h in holes)})
    zs = sorted({0.0, height, *(h[1] for h in holes), *(h[3] for h in holes)})
    parts = []
    for x0, x1 in pairwise(xs):
        for z0, z1 in pairwise(zs):
            x, z = (x0 + x1) / 2, (z0 + z1) / 2
            if not any(h[0] < x < h[2] and h[1] < z < h[3] for h in holes):
                parts.append(box((x0, 0, z0), (x1, thick, z1)))
    return merge(parts)


def bars(length: float, height: float, count: int, thick: float, across: bool) -> Mesh:
    """Return a grid of square bars in the xz plane: railing, fence, window bars, blinds (`across`: they lie)."""
    parts = []
    for i in range(count):
        p = (i + 0.5) / count
        if across:
            z = p * height
            parts.append(box((0, -thick / 2, z - thick / 2), (length, thick / 2, z + thick / 2)))
        else:
            x = p * length
            parts.append(box((x - thick / 2, -thick / 2, 0), (x + thick / 2, thick / 2, height)))
    parts.append(box((0, -thick, height - thick), (length, thick, height + thick)))
    return merge(parts)


def table(w: float, d: float, h: float, leg: float) -> Mesh:
    parts = [box((-w / 2, -d / 2, h - 0.04), (w / 2, d / 2, h))]
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (w / 2 - leg), sy * (d / 2 - leg)
            parts.append(box((x - leg / 2, y - leg / 2, 0), (x + leg / 2, y + leg / 2, h - 0.04)))
    return merge(parts)


def shelf(w: float, d: float, h: float, boards: int) -> Mesh:
    """Return an open shelf; boards are evenly spaced."""
    parts = [box((-w / 2, -d / 2, 0), (-w / 2 + 0.03, d / 2, h)), box((w / 2 - 0.03, -d / 2, 0), (w / 2, d / 2, h))]
    for i in range(boards + 1):
        z = i * (h - 0.03) / boards
        parts.append(box((-w / 2, -d / 2, z), (w / 2, d / 2, z + 0.03)))
    return merge(parts)


def books(rng: Rng, w: float, d: float, h: float) -> Mesh:
    """Return a row of books along x, each of one colour of a palette texture."""
    parts, x = [], 0.0
    while x < w:
        t, tall = rng.uniform(0.012, 0.05), h * rng.uniform(0.6, 0.95)
        if rng.random() < 0.9 and x + t < w:
            back = rng.uniform(0, 0.3) * d
            parts.append(box((x, back - d / 2, 0), (x + t * 0.96, d / 2, tall)).tinted(rng.random()))
        x += t
    return merge(parts or [box((0, 0, 0), (0.03, 0.1, 0.2)).tinted(0.5)]).moved(-w / 2, 0, 0)


def stairs(w: float, step: float, rise: float, count: int) -> Mesh:
    return merge([box((-w / 2, i * step, 0), (w / 2, (i + 1) * step, (i + 1) * rise)) for i in range(count)])


def rubble(rng: Rng, count: int, spread: float, size: float) -> Mesh:
    """Return a heap of boxes, each of one colour of a palette texture."""
    parts = []
    for _ in range(count):
        e = size * rng.uniform(0.2, 1, 3)
        x, y = rng.normal(size=2) * spread
        b = box(-e / 2, e / 2).rotated(random_rotation(rng) if rng.random() < 0.5 else np.eye(3))
        parts.append(b.moved(x, y, e[2] / 2 * rng.uniform(0.5, 3)).tinted(rng.random()))
    return merge(parts)
