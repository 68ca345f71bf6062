# SPDX-License-Identifier: Apache-2.0
"""How many wrong pairs the checks notice, and how many right pairs they doubt.

    python -m research.benchmarks.pair_checks FRAMES --scenes chosen [--before WORKTREE] [--table FILE.csv]
    python -m research.benchmarks.pair_checks FRESH --scenes fresh [--before WORKTREE] [--table FILE.csv]

Thresholds were chosen by the scenes in FRAMES. Those in FRESH are only measured. `research.benchmarks.render.frames`
and `research.benchmarks.render.generated_frames` render them. Each folder is a view, with ``hr_<n>spp.exr`` and
``lr_x<s>_<n>spp.exr``. All of its pairs are right, whole and cut to each quarter. Wrong pairs are made from the pairs
of equal samples: the LRHS is framed, shifted, recoloured or made from the HRLS, or the HRLS gets layers of another
scene. Frames of an odd size are measured as right pairs only, and whole. The LRHS's own albedo and normal are not used.

``--before`` also measures the checks of commit 0e4f219, of which WORKTREE is a checkout.
"""

from __future__ import annotations

import argparse
import functools
import os
import pickle
import re
import subprocess
import sys
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
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
from oiio_msspl.image.colour import ACESCG, REC709, conversion
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
    def name(self) -> str:
        return f"{self.folder.parent.name}/{self.folder.name}"

    @property
    def scene(self) -> str:
        """The scene's name: that of the folder without the name of the camera."""
        return re.sub(r"-(left|right)$", "", self.folder.name)

    def layers(self, file: str) -> Layers | None:
        """The features of one render; None if there is no such file."""
        path = self.folder / f"{file}.exr"
        if not path.exists():
            return None
        read = map_render(open_exr(path)).load().layers
        return {name: read[name] for name in (RGB, ALBEDO, NORMAL) if name in read}

    def pairs(self) -> Iterator[Pair]:
        """All pairs of the folder."""
        for high in sorted(self.folder.glob("hr_*spp.exr")):
            hrls = self.layers(high.stem)
            assert hrls is not None
            for low in sorted(self.folder.glob("lr_x*spp.exr")):
                numbers = re.findall(r"\d+", f"{low.stem} {high.stem}")
                lrhs, scale = self.layers(low.stem), int(numbers[0])
                assert lrhs is not None
                spp = int(numbers[2])
                yield Pair(f"{self.name} {low.stem} {high.stem}", scale, spp, int(numbers[1]), lrhs, hrls)


@dataclass(frozen=True)
class Pair:
    """Both renders as arrays."""

    name: str
    scale: int
    hr_spp: int
    lr_spp: int
    lrhs: Layers
    hrls: Layers

    @property
    def exact(self) -> bool:
        """Whether an LRHS pixel is exactly as wide and high as so many HRLS pixels: no odd size was rounded."""
        low, high = self.lrhs[RGB].shape, self.hrls[RGB].shape
        return low[:2] == (high[0] / self.scale, high[1] / self.scale)

    @property
    def equal_samples(self) -> bool:
        """Whether both renders have the same number of samples for an area, and 1 spp in the HRLS."""
        return self.hr_spp == 1 and self.lr_spp == self.scale**2

    def cut(self, y: int, x: int, height: int, width: int) -> Pair:
        """A rectangle, in LRHS pixels."""
        s = self.scale
        low = {name: v[y : y + height, x : x + width] for name, v in self.lrhs.items()}
        high = {name: v[s * y : s * (y + height), s * x : s * (x + width)] for name, v in self.hrls.items()}
        return Pair(self.name, s, self.hr_spp, self.lr_spp, low, high)

    def quarters(self) -> Iterator[Pair]:
        """The four quarters of the frame."""
        height, width = (n // 2 for n in self.lrhs[RGB].shape[:2])
        for y, x in ((0, 0), (0, width), (height, 0), (height, width)):
            yield self.cut(y, x, height, width)

    def arrays(self) -> tuple[Array, Layers]:
        """The LRHS's beauty and the HRLS's features, contiguous."""
        return np.ascontiguousarray(self.lrhs[RGB]), {k: np.ascontiguousarray(v) for k, v in self.hrls.items()}

    def warnings(self) -> list[str]:
        """What the checks say, or why they refuse the pair."""
        lrhs, hrls = self.arrays()
        try:
            return check_renders(Render.from_arrays("lr", rgb=lrhs), Render.from_arrays("hr", **hrls))
        except InputError as error:
            return [str(error)]


class EarlierChecks:
    """The checks of another checkout, in a process of its own."""

    def __init__(self, tree: Path) -> None:
        command = [sys.executable, str(Path(__file__).with_name("earlier_pair_checks.py"))]
        environment = os.environ | {"PYTHONPATH": str(tree)}
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)

    def warnings(self, pair: Pair) -> list[str]:
        """What they say."""
        assert self.process.stdin is not None and self.process.stdout is not None
        pickle.dump(pair.arrays(), self.process.stdin)
        self.process.stdin.flush()
        found: list[str] = pickle.load(self.process.stdout)
        return found


def wrong_pairs(pair: Pair, other: View, following: Layers | None) -> Iterator[tuple[str, Pair]]:
    """Kinds of wrong pairs, each with an example made from a right one.

    Args:
        other: a view of another scene.
        following: the HRLS of the next frame of a moving camera; None if there is none.
    """
    rng = np.random.default_rng(zlib.crc32(pair.name.encode()))
    lrhs, scale = pair.lrhs[RGB], pair.scale
    foreign = other.layers("hr_1spp")
    assert foreign is not None

    def low(rgb: Array) -> Pair:
        return Pair(pair.name, scale, pair.hr_spp, pair.lr_spp, {RGB: rgb}, pair.hrls)

    def high(**layers: Array) -> Pair:
        return Pair(pair.name, scale, pair.hr_spp, pair.lr_spp, pair.lrhs, pair.hrls | layers)

    matrix = conversion(REC709, ACESCG).astype(np.float32).T
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
    yield "LRHS scaled down: box", low(box_downsample(pair.hrls[RGB], scale))
    for filter_name in ("lanczos3", "cubic"):
        yield f"LRHS scaled down: {filter_name}", low(_resized(pair.hrls[RGB], scale, filter_name))
    yield "LRHS scaled down: nearest", low(pair.hrls[RGB][scale // 2 :: scale, scale // 2 :: scale])
    yield "LRHS in ACEScg", low(lrhs @ matrix)
    yield "HRLS in ACEScg", high(rgb=pair.hrls[RGB] @ matrix)
    yield "exposure one stop up", low(lrhs * np.float32(2))


def _zoomed(image: Array, share: float) -> Array:
    """The middle of an image, enlarged to its size."""
    for axis in (0, 1):
        middle = (image.shape[axis] - 1) / 2
        image = interpolate(image, (np.arange(image.shape[axis]) - middle) * share + middle, axis)
    return image


def _fitted(image: Array, shape: tuple[int, ...]) -> Array:
    """An image scaled to a height and width, by its nearest pixels."""
    rows, columns = (np.arange(n) * old // n for n, old in zip(shape[:2], image.shape[:2], strict=True))
    return image[rows][:, columns]


def _shifted(image: Array, x: int, y: int) -> Array:
    """An image moved to the right and down; the edge pixel is repeated."""
    rows, columns = (np.clip(np.arange(n) - by, 0, n - 1) for n, by in zip(image.shape[:2], (y, x), strict=True))
    return image[rows][:, columns]


def _resized(image: Array, scale: int, filter_name: str) -> Array:
    """An image scaled down by OpenImageIO, as `oiiotool --resize` does it."""
    height, width, channels = image.shape
    area = oiio.ROI(0, width // scale, 0, height // scale, 0, 1, 0, channels)
    small = oiio.ImageBufAlgo.resize(oiio.ImageBuf(np.ascontiguousarray(image)), filter_name, 0, area)
    return np.maximum(np.asarray(small.get_pixels(oiio.FLOAT)), 0)


def _moved_object(layers: Layers, scale: int, rng: np.random.Generator) -> Layers:
    """Layers in which a rectangle of an eighth of each side shows what another such rectangle showed."""
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


def find_views(folder: Path) -> list[View]:
    """The views in a folder."""
    return [View(file.parent) for file in sorted(folder.glob("*/hr_1spp.exr"))]


@dataclass(frozen=True)
class Outcome:
    """What the checks said of a pair."""

    kind: str
    now: list[str]
    before: list[str] | None


def measure(view: View, other: View, before: Path | None) -> list[Outcome]:
    """Check all pairs of a view. ``other`` is of another scene; ``before`` is the checkout of the earlier checks."""
    earlier = _earlier(before) if before else None
    outcomes = []

    def check(kind: str, pair: Pair) -> None:
        now, then = (
            None if checks is None else [warning for warning in checks(pair) if warning != BOTH_BLACK]
            for checks in (Pair.warnings, earlier.warnings if earlier else None)
        )
        assert now is not None
        outcomes.append(Outcome(kind, [f"{pair.name}: {warning}" for warning in now], then))

    for pair in view.pairs():
        if not pair.hrls[RGB].any():
            continue  # the camera is inside a wall
        check(RIGHT, pair)
        if not pair.exact:
            continue
        for quarter in pair.quarters():
            check(RIGHT_QUARTER, quarter)
        if pair.equal_samples:
            for kind, wrong in wrong_pairs(pair, other, view.layers("next_1spp")):
                check(kind, wrong)
    return outcomes


@functools.cache
def _earlier(tree: Path) -> EarlierChecks:
    return EarlierChecks(tree)


def rows_of(name: str, views: list[View], before: Path | None, processes: int) -> list[results.Row]:
    """Measure views of several scenes: a row for each kind of pair, and one for all right pairs."""
    others = [next(v for v in views[i:] + views if v.scene != view.scene) for i, view in enumerate(views)]
    with ProcessPoolExecutor(processes) as pool:
        found = pool.map(measure, views, others, [before] * len(views))
        outcomes = [outcome for outcomes in found for outcome in outcomes]
    rows = []
    for kind in dict.fromkeys(outcome.kind for outcome in outcomes):
        chosen = [outcome for outcome in outcomes if outcome.kind == kind]
        row: results.Row = {"scenes": name, "pairs": kind, "count": len(chosen)}
        if before:
            row["before"] = sum(bool(outcome.before) for outcome in chosen)
        rows.append(row | {"after": sum(bool(outcome.now) for outcome in chosen)})
    for outcome in outcomes:
        if outcome.kind in (RIGHT, RIGHT_QUARTER) and outcome.now:
            print(f"{outcome.kind}: {'; '.join(outcome.now)}", flush=True)
    scenes = list(dict.fromkeys(view.scene for view in views))
    print(f"\n{name}: {len(views)} views of {len(scenes)} scenes: {', '.join(scenes)}\n")
    return rows


def layout(rows: list[results.Row]) -> str:
    """A table: of each kind of pair, how many there are, and the percentage that got a warning."""
    found = results.index(rows, "scenes", "pairs")
    columns = [column for column in ("before", "after") if column in rows[0]]
    sets = list(dict.fromkeys(row["scenes"] for row in rows))
    head = ["pairs", *(f"{name}: {column}" for name in sets for column in ("number", *columns))]
    body = []
    for kind in dict.fromkeys(row["pairs"] for row in rows):
        cells = [kind]
        for name in sets:
            row = found.get((name, kind))
            cells += [str(row["count"])] if row else [""]
            cells += [f"{100 * row[column] / row['count']:.1f} %" if row else "" for column in columns]
        body.append(cells)
    return results.markdown(head, body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=Path, metavar="FRAMES")
    parser.add_argument("--scenes", choices=SETS, default=SETS[0], help="which scenes these are (%(default)s)")
    parser.add_argument("--before", type=Path, metavar="WORKTREE", help="a checkout of commit 0e4f219")
    parser.add_argument("--processes", type=int, default=2)
    results.add_option(parser)
    args = parser.parse_args()
    rows = rows_of(args.scenes, find_views(args.frames), args.before, args.processes)
    print(layout(rows))
    if args.table:
        results.merge(args.table, rows, ("scenes", "pairs"))


if __name__ == "__main__":
    main()
