# SPDX-License-Identifier: Apache-2.0
"""Count how many wrong pairs the checks notice, and how many right pairs they doubt.

    python -m research.benchmarks.pair_checks FRAMES --scenes chosen [--table FILE.csv]
    python -m research.benchmarks.pair_checks FRESH --scenes fresh [--table FILE.csv]

Thresholds were chosen by the scenes in FRAMES. Those in FRESH are only measured. `research.benchmarks.render.frames`
and `research.benchmarks.render.generated_frames` render them. Each folder is a view, with ``hr_<n>spp.exr`` and
``lr_x<s>_<n>spp.exr``. All of its pairs are right, whole and cut to each quarter. Wrong pairs are made from the pairs
of equal samples: the LRHS is framed, shifted, recoloured or made from the HRLS, or the HRLS gets layers of another
scene. Frames of an odd size are measured as right pairs only, and whole. The LRHS's own albedo is not used.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Render
from oiio_msspl.fusion.checks.pair import BOTH_BLACK, check_renders
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import ACESCG, P3, REC709, conversion, srgb
from oiio_msspl.image.filters import box_downsample, interpolate
from research.benchmarks import results

#: Sets of scenes: those by which thresholds were chosen, and others.
SETS = ("chosen", "fresh")
RIGHT, RIGHT_QUARTER = "right, whole frame", "right, a quarter of the frame"
Layers = dict[str, Array]


@dataclass(frozen=True)
class View:
    """A folder of renders of one camera."""

    folder: Path

    @property
    def scene(self) -> str:
        """The scene's name: that of the folder without the name of the camera."""
        return re.sub(r"-(left|right)$", "", self.folder.name)

    def layers(self, file: str) -> Layers:
        """Return the features of one render."""
        read = map_render(open_exr(self.folder / f"{file}.exr")).load().layers
        return {name: read[name] for name in (RGB, ALBEDO, NORMAL) if name in read}

    def pairs(self) -> Iterator[Pair]:
        """Yield all pairs of the folder."""
        for high in sorted(self.folder.glob("hr_*spp.exr")):
            hrls = self.layers(high.stem)
            for low in sorted(self.folder.glob("lr_x*spp.exr")):
                name = f"{self.folder.parent.name}/{self.folder.name} {low.stem} {high.stem}"
                scale, lr_spp, hr_spp = (int(n) for n in re.findall(r"\d+", f"{low.stem} {high.stem}"))
                yield Pair(name, scale, hr_spp, lr_spp, self.layers(low.stem), hrls)


@dataclass(frozen=True)
class Pair:
    """Both renders as arrays."""

    name: str
    scale: int
    hr_spp: int
    lr_spp: int
    lrhs: Layers
    hrls: Layers

    def quarters(self) -> Iterator[Pair]:
        """Yield the four quarters of the frame."""
        height, width, s = (*(n // 2 for n in self.lrhs[RGB].shape[:2]), self.scale)
        for y, x in ((0, 0), (0, width), (height, 0), (height, width)):
            low = {name: v[y : y + height, x : x + width] for name, v in self.lrhs.items()}
            high = {name: v[s * y : s * (y + height), s * x : s * (x + width)] for name, v in self.hrls.items()}
            yield replace(self, lrhs=low, hrls=high)

    def warnings(self) -> list[str]:
        """Return what the checks say, or why they refuse the pair."""
        lrhs, hrls = ({k: np.ascontiguousarray(v) for k, v in side.items()} for side in (self.lrhs, self.hrls))
        lrhs.pop(ALBEDO, None)
        try:
            return [*check_renders(Render.from_arrays("lr", **lrhs), Render.from_arrays("hr", **hrls)).warnings]
        except InputError as error:
            return [str(error)]


def wrong_pairs(pair: Pair, stranger: View, following: Layers | None) -> Iterator[tuple[str, Pair]]:
    """Yield kinds of wrong pairs, each with an example made from a right one.

    Args:
        stranger: a view of another scene.
        following: the HRLS of the next frame of a moving camera; None if there is none.
    """
    rng = np.random.default_rng(zlib.crc32(pair.name.encode()))
    lrhs, scale = pair.lrhs[RGB], pair.scale
    foreign = stranger.layers("hr_1spp")

    def low(rgb: Array) -> Pair:
        return replace(pair, lrhs={RGB: rgb})

    def high(**layers: Array) -> Pair:
        return replace(pair, hrls=pair.hrls | layers)

    matrix, p3 = (conversion(REC709, space).astype(np.float32).T for space in (ACESCG, P3))
    x, y = ((1, 0), (-1, 0), (0, 1), (0, -1))[rng.integers(4)]
    yield "crop 3 % tighter", low(_zoomed(lrhs, 0.97))
    yield "red and blue swapped", low(lrhs[..., ::-1])
    for name, kind in ((NORMAL, "normals"), (ALBEDO, "albedo")):
        if name in pair.hrls and name in foreign:
            yield f"{kind} of another scene", high(**{name: _fitted(foreign[name], pair.hrls[name].shape)})
    yield "an object of 1/64 of the frame moved", high(**_moved_object(pair.hrls, scale, rng))
    yield "shift by 1 LRHS pixel", low(_shifted(lrhs, x, y))
    yield "shift by 4 LRHS pixels", low(_shifted(lrhs, 4 * x, 4 * y))
    if following is not None:
        shape = pair.hrls[RGB].shape
        yield "next frame of a moving camera", high(**{k: v[: shape[0], : shape[1]] for k, v in following.items()})
    yield "LRHS mirrored", low(lrhs[:, ::-1])
    yield "LRHS of another scene", low(_fitted(stranger.layers(f"lr_x{scale}_{scale**2}spp")[RGB], lrhs.shape))
    yield "LRHS scaled down: box", low(box_downsample(pair.hrls[RGB], scale))
    for filter_name in ("lanczos3", "cubic", "gaussian"):
        yield f"LRHS scaled down: {filter_name}", low(_resized(pair.hrls[RGB], scale, filter_name))
    yield "LRHS scaled down: nearest", low(pair.hrls[RGB][scale // 2 :: scale, scale // 2 :: scale])
    yield "LRHS in ACEScg", low(lrhs @ matrix)
    yield "HRLS in ACEScg", high(rgb=pair.hrls[RGB] @ matrix)
    yield "LRHS in Display P3", low(lrhs @ p3)
    yield "LRHS encoded for sRGB", low(srgb(lrhs))
    yield "LRHS in another white balance", low(lrhs * np.array([1.25, 1, 0.8], np.float32))
    yield "exposure one stop up", low(lrhs * np.float32(2))
    for name, kind in ((NORMAL, "normals"), (ALBEDO, "albedo")):
        if name in pair.hrls:
            yield f"{kind} shifted by 8 pixels", high(**{name: _shifted(pair.hrls[name], 8 * x, 8 * y)})
    if NORMAL in pair.hrls:
        yield "normals negated", high(normal=-pair.hrls[NORMAL])


def _zoomed(image: Array, share: float) -> Array:
    """Return the middle of an image, enlarged to its size."""
    for axis in (0, 1):
        middle = (image.shape[axis] - 1) / 2
        image = interpolate(image, (np.arange(image.shape[axis]) - middle) * share + middle, axis)
    return image


def _fitted(image: Array, shape: tuple[int, ...]) -> Array:
    """Return an image scaled to a height and width, by its nearest pixels."""
    rows, columns = (np.arange(n) * old // n for n, old in zip(shape[:2], image.shape[:2], strict=True))
    return image[rows][:, columns]


def _shifted(image: Array, x: int, y: int) -> Array:
    """Return an image moved to the right and down; the edge pixel is repeated."""
    rows, columns = (np.clip(np.arange(n) - by, 0, n - 1) for n, by in zip(image.shape[:2], (y, x), strict=True))
    return image[rows][:, columns]


def _resized(image: Array, scale: int, filter_name: str) -> Array:
    """Return an image scaled down by OpenImageIO, as `oiiotool --resize` does it."""
    height, width, channels = image.shape
    area = oiio.ROI(0, width // scale, 0, height // scale, 0, 1, 0, channels)
    small = oiio.ImageBufAlgo.resize(oiio.ImageBuf(np.ascontiguousarray(image)), filter_name, 0, area)
    return np.maximum(np.asarray(small.get_pixels(oiio.FLOAT)), 0)


def _moved_object(layers: Layers, scale: int, rng: np.random.Generator) -> Layers:
    """Return layers in which a rectangle of an eighth of each side shows what another such rectangle showed."""
    height, width = layers[RGB].shape[:2]
    h, w = (n // 8 // scale * scale for n in (height, width))
    while True:
        y, v = rng.integers(0, (height - h) // scale + 1, 2) * scale
        x, u = rng.integers(0, (width - w) // scale + 1, 2) * scale
        if abs(y - v) >= h or abs(x - u) >= w:
            break
    moved = {name: values.copy() for name, values in layers.items()}
    for name, values in layers.items():
        moved[name][y : y + h, x : x + w] = values[v : v + h, u : u + w]
    return moved


def measure(view: View, stranger: View) -> list[tuple[str, list[str]]]:
    """Check all pairs of a view: the kind of each pair, and its warnings. ``stranger`` is of another scene."""
    outcomes = []

    def check(kind: str, pair: Pair) -> None:
        outcomes.append((kind, [f"{pair.name}: {text}" for text in pair.warnings() if text != BOTH_BLACK]))

    for pair in view.pairs():
        if not pair.hrls[RGB].any():
            continue  # the camera is inside a wall
        check(RIGHT, pair)
        low, high = pair.lrhs[RGB].shape, pair.hrls[RGB].shape
        if low[:2] != (high[0] / pair.scale, high[1] / pair.scale):
            continue  # an odd size was rounded
        for quarter in pair.quarters():
            check(RIGHT_QUARTER, quarter)
        if pair.hr_spp == 1 and pair.lr_spp == pair.scale**2:
            following = view.layers("next_1spp") if (view.folder / "next_1spp.exr").exists() else None
            for kind, wrong in wrong_pairs(pair, stranger, following):
                check(kind, wrong)
    return outcomes


def rows_of(name: str, views: list[View], processes: int) -> list[results.Row]:
    """Measure views of several scenes: a row for each kind of pair."""
    strangers = [next(v for v in views[i:] + views if v.scene != view.scene) for i, view in enumerate(views)]
    with ProcessPoolExecutor(processes) as pool:
        outcomes = [outcome for outcomes in pool.map(measure, views, strangers) for outcome in outcomes]
    by_kind: dict[str, list[bool]] = {}
    for kind, warnings in outcomes:
        by_kind.setdefault(kind, []).append(bool(warnings))
        if kind in (RIGHT, RIGHT_QUARTER) and warnings:
            print(f"{kind}: {'; '.join(warnings)}", flush=True)
    return [{"scenes": name, "pairs": kind, "count": len(w), "after": sum(w)} for kind, w in by_kind.items()]


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("frames", type=Path, metavar="FRAMES")
    parser.add_argument("--scenes", choices=SETS, default=SETS[0], help="which scenes these are (%(default)s)")
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    views = [View(file.parent) for file in sorted(args.frames.glob("*/hr_1spp.exr"))]
    results.show(rows_of(args.scenes, views, args.processes), args.table, ("scenes", "pairs"))


if __name__ == "__main__":
    main()
