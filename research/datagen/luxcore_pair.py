# SPDX-License-Identifier: Apache-2.0
"""Render a low-resolution-high-spp / high-resolution-low-spp pair of a Cornell box with LuxCore.

Writes hr.exr, lr.exr and (with --ref-spp) ref.exr, RGB alone: the case of a renderer that gives no
albedo, no normal and no depth.  --aovs adds ALBEDO, AVG_SHADING_NORMAL and DEPTH, a file each, as
LuxCore writes them.  --benchmark writes all renders that research.benchmarks.accuracy reads.  See
research/datagen/README.md for the commands.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import pyluxcore

Point = tuple[float, float, float]
AOVS = ("ALBEDO", "AVG_SHADING_NORMAL", "DEPTH")
# LuxCore's filters, and half of their width in pixels: one pixel, and LuxCore's default.
FILTERS = {"box": ("BOX", 0.5), "blackman-harris": ("BLACKMANHARRIS", 1.5)}
# Samples for every HRLS pixel of the renders for research.benchmarks.accuracy, and their scales.
BENCHMARK_SPP, BENCHMARK_SCALES = (1, 2, 4, 8), (2, 4, 8)


def properties(values: dict[str, Any]) -> pyluxcore.Properties:
    props = pyluxcore.Properties()
    for name, value in values.items():
        props.Set(pyluxcore.Property(name, list(value) if isinstance(value, (list, tuple)) else [value]))
    return props


def add_mesh(
    scene: pyluxcore.Scene,
    props: pyluxcore.Properties,
    name: str,
    points: list[Point],
    triangles: list[tuple[int, ...]],
    material: str,
) -> None:
    scene.DefineMesh(f"mesh_{name}", [tuple(map(float, p)) for p in points], triangles, None, None, None, None)
    props.Set(properties({f"scene.objects.{name}.shape": f"mesh_{name}", f"scene.objects.{name}.material": material}))


def quad(scene: pyluxcore.Scene, props: pyluxcore.Properties, name: str, corners: list[Point], material: str) -> None:
    add_mesh(scene, props, name, corners, [(0, 1, 2), (0, 2, 3)], material)


def block(
    scene: pyluxcore.Scene,
    props: pyluxcore.Properties,
    name: str,
    center: tuple[float, float],
    size: Point,
    angle: float,
    material: str,
) -> None:
    """Add an upright box turned about the vertical axis."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    points: list[Point] = []
    for z in (0.0, size[2]):
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            px, py = x * size[0] / 2, y * size[1] / 2
            points.append((center[0] + c * px - s * py, center[1] + s * px + c * py, z))
    triangles: list[tuple[int, ...]] = []
    for a, b, d, e in ((3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)):
        triangles += [(a, b, d), (a, d, e)]
    add_mesh(scene, props, name, points, triangles, material)


def ball(
    scene: pyluxcore.Scene,
    props: pyluxcore.Properties,
    name: str,
    center: Point,
    radius: float,
    material: str,
    n: int = 48,
) -> None:
    points: list[Point] = []
    triangles: list[tuple[int, ...]] = []
    for i in range(n + 1):
        t = math.pi * i / n
        for j in range(2 * n):
            p = math.pi * j / n
            x, y, z = math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)
            points.append((center[0] + radius * x, center[1] + radius * y, center[2] + radius * z))
    for i in range(n):
        for j in range(2 * n):
            a, b = i * 2 * n + j, i * 2 * n + (j + 1) % (2 * n)
            triangles += [(a, a + 2 * n, b), (b, a + 2 * n, b + 2 * n)]
    add_mesh(scene, props, name, points, triangles, material)


def set_camera(scene: pyluxcore.Scene, side: int, raw: bool) -> None:
    """Look at the box.

    LuxCore 2.11 draws a frame one of its pixels too low, so that renders of two sizes do not lie upon one another.
    Unless `raw`, the screen window is moved by that pixel.
    """
    shift = 0.0 if raw else -2.0 / side
    camera = {
        "type": "perspective",
        "lookat.orig": (0.0, -4.9, 1.0),
        "lookat.target": (0.0, 0.0, 1.0),
        "fieldofview": 28.5,
        "autoupdate.enable": False,
        "screenwindow": (-1.0, 1.0, -1.0 + shift, 1.0 + shift),
    }
    scene.Parse(properties({f"scene.camera.{name}": value for name, value in camera.items()}))


def build_scene() -> pyluxcore.Scene:
    """Build a box of side 2 with its floor at z = 0, open towards -y."""
    scene = pyluxcore.Scene()
    tiles = {
        "type": "checkerboard3d", "texture1": (0.70, 0.68, 0.62), "texture2": (0.16, 0.17, 0.20),
        "mapping.type": "globalmapping3d",
        "mapping.transformation": (5.0, 0, 0, 0, 0, 5.0, 0, 0, 0, 0, 1, 0, 0.011, 0.017, 0.5, 1),
    }  # fmt: skip
    materials: dict[str, dict[str, Any]] = {
        "white": {"type": "matte", "kd": (0.75, 0.74, 0.70)},
        "red": {"type": "matte", "kd": (0.62, 0.06, 0.05)},
        "green": {"type": "matte", "kd": (0.12, 0.48, 0.09)},
        "floor": {"type": "matte", "kd": "tiles"},
        "metal": {"type": "metal2", "uroughness": 0.08, "vroughness": 0.08, "preset": "gold"},
        "glossy": {
            "type": "glossy2", "kd": (0.05, 0.12, 0.42), "ks": (0.06, 0.06, 0.06),
            "uroughness": 0.06, "vroughness": 0.06,
        },
        "lamp": {"type": "matte", "kd": (0.0, 0.0, 0.0), "emission": (26.0, 20.0, 13.0)},
    }  # fmt: skip
    values = {f"scene.textures.tiles.{key}": value for key, value in tiles.items()}
    for name, entries in materials.items():
        values |= {f"scene.materials.{name}.{key}": value for key, value in entries.items()}
    scene.Parse(properties(values))
    props = pyluxcore.Properties()
    quad(scene, props, "floor", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], "floor")
    quad(scene, props, "ceiling", [(-1, -1, 2), (-1, 1, 2), (1, 1, 2), (1, -1, 2)], "white")
    quad(scene, props, "back", [(-1, 1, 0), (1, 1, 0), (1, 1, 2), (-1, 1, 2)], "white")
    quad(scene, props, "left", [(-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2)], "red")
    quad(scene, props, "right", [(1, -1, 0), (1, -1, 2), (1, 1, 2), (1, 1, 0)], "green")
    corners: list[Point] = [(-0.28, -0.24, 1.99), (-0.28, 0.24, 1.99), (0.28, 0.24, 1.99), (0.28, -0.24, 1.99)]
    quad(scene, props, "lamp", corners, "lamp")
    block(scene, props, "tall", (-0.38, 0.34), (0.56, 0.56, 1.2), 18, "white")
    block(scene, props, "short", (0.40, -0.30), (0.56, 0.56, 0.5), -17, "glossy")
    ball(scene, props, "ball", (0.40, -0.30, 0.76), 0.26, "metal")
    for k in range(9):  # thin rods
        x = -0.86 + 0.07 * k
        block(scene, props, f"rod{k}", (x, -0.62), (0.012, 0.012, 0.18 + 0.05 * (k % 3)), 0, "white")
    scene.Parse(props)
    set_camera(scene, 256, True)
    return scene


def render(scene: pyluxcore.Scene, args: argparse.Namespace, name: str, side: int, spp: int, seed: int) -> None:
    kind, width = FILTERS[args.filter]
    path = args.out.resolve() / f"{name}.exr"
    values = {
        "renderengine.type": "PATHCPU",
        "renderengine.seed": seed,
        "native.threads.count": args.threads,
        "sampler.type": "SOBOL",
        "sampler.sobol.adaptive.strength": 0.0,
        "path.pathdepth.total": 7,
        "path.pathdepth.diffuse": 5,
        "path.pathdepth.glossy": 5,
        "film.width": side,
        "film.height": side,
        "film.filter.type": kind,
        "film.filter.width": width,
        "film.noiseestimation.warmup": 1 << 20,
        "batch.haltspp": (spp, 0),
        "film.imagepipelines.0.0.type": "NOP",
        "film.outputs.0.type": "RGB_IMAGEPIPELINE",
        "film.outputs.0.index": 0,
        "film.outputs.0.filename": str(path),
    }
    for k, aov in enumerate(AOVS if args.aovs else (), 1):
        values[f"film.outputs.{k}.type"] = aov
        values[f"film.outputs.{k}.filename"] = str(path.with_name(f"{name}.{aov}.exr"))
    session = pyluxcore.RenderSession(pyluxcore.RenderConfig(properties(values), scene))
    start = time.time()
    session.Start()
    while not session.HasDone():
        time.sleep(0.05)
        session.UpdateStats()
    session.UpdateStats()
    done = session.GetStats().Get("stats.renderengine.pass").GetInt()
    session.GetFilm().Save()
    session.Stop()
    print(f"{name}.exr: {side}x{side}, {done} of {spp} spp, {time.time() - start:.1f} s", flush=True)


def main(argv: list[str]) -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    p.add_argument("--size", type=int, default=256, help="side of the HRLS render")
    p.add_argument("--scale", type=int, default=4)
    p.add_argument("--hr-spp", type=int, default=2)
    p.add_argument("--lr-spp", type=int, default=32)
    p.add_argument("--ref-spp", type=int, default=0)
    p.add_argument("--only", default="hr,lr,ref")
    p.add_argument("--suffix", default="")
    p.add_argument("--raw", action="store_true", help="leave the frame where LuxCore puts it")
    p.add_argument("--aovs", action="store_true")
    p.add_argument("--filter", choices=FILTERS, default="box")
    p.add_argument("--benchmark", action="store_true", help="write all renders that research.benchmarks.accuracy reads")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--threads", type=int, default=1)
    args = p.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    pyluxcore.Init(lambda message: None)
    scene = build_scene()
    jobs = [("hr", 1, args.hr_spp), ("lr", args.scale, args.lr_spp)]
    if args.benchmark:
        jobs = [(f"hr_{n}spp", 1, n) for n in BENCHMARK_SPP]
        jobs += [(f"lr_x{s}_{s * s * n}spp", s, s * s * n) for s in BENCHMARK_SCALES for n in BENCHMARK_SPP[:3]]
    for offset, (name, scale, spp) in enumerate([*jobs, ("ref", 1, args.ref_spp)], start=1):
        if name.partition("_")[0] in args.only.split(",") and spp > 0:
            set_camera(scene, args.size // scale, args.raw)
            render(scene, args, name + args.suffix, args.size // scale, spp, 1000 * args.seed + offset)


if __name__ == "__main__":
    main(sys.argv[1:])
