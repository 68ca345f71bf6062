# SPDX-License-Identifier: Apache-2.0
"""Measure what is kept of detail that no AOV shows, from few samples to those of final frames.

    python -m research.benchmarks.detail --table research/benchmarks/results/detail.csv

Scenes have an exact reference (:mod:`research.benchmarks.stability.analytic`). Their light has structure, and albedo
and normal do not. `--quality best` takes the model for the noise of the pair. "One render" has the samples of both.
PSNR is that of the pictures in sRGB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.metrics import psnr
from oiio_msspl.jobs.settings import family_for_noise
from oiio_msspl.model.catalogue import QUALITIES, load_model
from oiio_msspl.model.contract import ONE_SIZE
from research.benchmarks import results
from research.benchmarks.peers import oidn_prefiltered
from research.benchmarks.results import Row
from research.benchmarks.stability.analytic import SUB, Scene, reference, render, surface

SIDE, SCALE = 256, 2
#: Samples per pixel of the LRHS and of the HRLS.
SAMPLES = ((4, 1), (64, 16), (256, 64))
#: Columns that tell rows apart.
KEYS = ("case", "spp", "method")
NETWORK_ALONE = ", network alone"
ONE, WITH_VARIANCE = "one render", ", with its variance"

Y, X = np.mgrid[: SIDE * SUB, : SIDE * SUB].astype(np.float32) / SUB
SHAPE = X.shape
#: Lines of several widths.
LINES = (np.floor(X / (1 + np.floor(Y / 32))) % 2 == 1) & (X > 40) & (X < 216)


def _grey(values: Array) -> Array:
    return values[..., None].astype(np.float32)


def display() -> Scene:
    """Return a screen that shows lines of several widths, before a dim wall."""
    return Scene(surface(SHAPE, ambient=0.05, emission=_grey(0.9 * LINES) * np.array((0.3, 0.9, 1.0), np.float32)))


def leather() -> Scene:
    """Return bumps that only the shading shows."""
    bumps = 1 + 0.3 * np.sin(X * 1.3 + 2 * np.sin(Y / 17)) * np.sin(Y * 1.1)
    return Scene(surface(SHAPE, albedo=(0.5, 0.35, 0.25), direct=_grey(0.6 * bumps), visible=1.0, ambient=0.1))


def shadows() -> Scene:
    """Return thin shadows, such as those of a grille."""
    lines = [((X * np.cos(a) + Y * np.sin(a)) % period) < 0.7 for a, period in ((0.2, 13), (1.3, 11), (2.1, 17))]
    shade = 1 - 0.9 * np.logical_or.reduce(lines)
    return Scene(surface(SHAPE, albedo=(0.7, 0.7, 0.7), direct=0.6, visible=_grey(shade), ambient=0.1))


def flakes() -> Scene:
    """Return car paint with glints."""
    rng = np.random.default_rng(8)
    glints = np.where(rng.random(SHAPE) < 0.02, rng.exponential(4, SHAPE), 0.05)
    spot = np.exp(-((X - 128) ** 2 + (Y - 110) ** 2) / 2 / 55**2)
    emission = _grey(glints * spot) * np.array((0.9, 0.15, 0.1), np.float32)
    return Scene(surface(SHAPE, albedo=(0.5, 0.05, 0.04), ambient=0.2, emission=emission))


def _points(count: int, size: int, brightest: float, seed: int) -> Array:
    """Return points of light, (h, w, 3)."""
    rng = np.random.default_rng(seed)
    light = np.zeros((*SHAPE, 3), np.float32)
    for y, x in rng.integers(0, SIDE * SUB - size, (count, 2)):
        light[y : y + size, x : x + size] = brightest * rng.uniform(0.1, 1) * rng.uniform(0.7, 1, 3)
    return light


def stars() -> Scene:
    """Return a night sky."""
    sky = np.array((0.001, 0.0014, 0.0025), np.float32)
    return Scene(surface(SHAPE, normal=(0, 0, 0), emission=_points(700, 2, 60, 4) + sky))


def lamps() -> Scene:
    """Return 60 lamps of about one pixel before a dim wall."""
    wall = np.where((X // 32 + Y // 32) % 2 == 1, 0.6, 0.4)
    return Scene(surface(SHAPE, albedo=_grey(wall), ambient=0.15, emission=_points(60, 4, 60, 5)))


def blue_lamp() -> Scene:
    """Return a wall lit by a blue lamp alone, which luminance hardly sees."""
    wall = _grey(np.where((X // 32 + Y // 32) % 2 == 1, 0.6, 0.3)) * np.array((0, 0, 1), np.float32)
    return Scene(surface(SHAPE, albedo=wall, direct=0.5, visible=0.6, ambient=0.1))


def painted_wall() -> Scene:
    """Return lines that the albedo shows: a control."""
    return Scene(surface(SHAPE, albedo=_grey(0.1 + 0.7 * LINES), direct=0.6, visible=0.5, ambient=0.1))


def rare_light() -> Scene:
    """Return a room that one sample in 50 finds lit: a control."""
    wall = np.where((X // 16 + Y // 16) % 2 == 1, 0.7, 0.3)
    return Scene(surface(SHAPE, albedo=_grey(wall), direct=15.0, visible=0.02))


CASES: dict[str, Callable[[], Scene]] = {
    "lit display": display,
    "leather": leather,
    "thin shadows": shadows,
    "car-paint flakes": flakes,
    "stars": stars,
    "small lamps": lamps,
    "blue lamp": blue_lamp,
    "painted wall (control)": painted_wall,
    "rare light (control)": rare_light,
}


def measure(case: str, samples: tuple[int, int]) -> Iterator[Row]:
    """Yield the row of every method."""
    scene, (low_spp, high_spp) = CASES[case](), samples
    truth, rng = reference(scene), np.random.default_rng(1)
    low, high = render(scene, low_spp, rng, scale=SCALE), render(scene, high_spp, rng)
    one = render(scene, low_spp // SCALE**2 + high_spp, rng)
    key: Row = {"case": case, "spp": f"{low_spp}-{high_spp}"}
    for method, image in (
        ("HRLS", high.layers["rgb"]),
        ("OIDN prefiltered on the HRLS", oidn_prefiltered(high)),
        (ONE, one.layers["rgb"]),
    ):
        yield key | {"method": method, "psnr": psnr(image, truth)}
    for scale, pair, methods in (
        (SCALE, (low, high), {f"best{NETWORK_ALONE}": False, "best": True}),
        (ONE_SIZE, (one, one), {f"best, {ONE}": False, f"best, {ONE}{WITH_VARIANCE}": True}),
    ):
        session = load_model(scale, family_for_noise(QUALITIES["best"], *pair, align(*pair))[0])
        for method, trust in methods.items():
            image = fuse(*pair, session, trust=trust).rgb
            yield key | {"method": method, "model": session.name, "psnr": psnr(image, truth)}


def main() -> None:
    args = results.parser(__doc__).parse_args()
    rows = [row for case in CASES for samples in SAMPLES for row in measure(case, samples)]
    results.show(rows, args.table)


if __name__ == "__main__":
    main()
