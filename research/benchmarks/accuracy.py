# SPDX-License-Identifier: Apache-2.0
"""Measure how accurate every method is, at equal average samples.

    python -m research.benchmarks.accuracy RENDERS --flip --table research/benchmarks/results/accuracy.csv
    python -m research.benchmarks.accuracy VIEWS --flip --table research/benchmarks/results/accuracy_cycles.csv
    python -m research.benchmarks.accuracy RENDERS --methods '*prefiltered*' --table
    research/benchmarks/results/accuracy.csv

:mod:`research.benchmarks.scenes` says what the folders hold. A frame has 2, 4 or 8 spp on average: spp_LRHS / s^2 +
spp_HRLS.

Methods that get an LRHS and an HRLS, each with half of the samples as in the paper:

- the models of this project, by name. "joint-x2, 3:1" has three quarters of the samples in the HRLS.
- "OIDN prefiltered on both x2, together": prefiltered OIDN on the HRLS, with the local means of
  :func:`research.benchmarks.peers.oidn_on_average`.

Methods that get one render: "HRLS", "OIDN on the HRLS" (half of the samples), and "OIDN, same samples" (all samples at
full resolution). "OIDN fast" has the quality "fast". "OIDN prefiltered" is
:func:`research.benchmarks.oidn.denoise_prefiltered`. "OIDN prefiltered and split" is that on every second pixel. All
others are OIDN's plain call with the quality "high".
"""

from __future__ import annotations

import fnmatch
import functools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.compare import scores
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import srgb
from oiio_msspl.model.catalogue import load_model, shipped_models
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.session import Session
from research.benchmarks import results, scenes
from research.benchmarks.peers import match_local_means, oidn, oidn_on_average, oidn_prefiltered, oidn_split
from research.benchmarks.results import MEAN, Row
from research.benchmarks.scenes import NOISY_REFERENCE, beauty

#: Average spp. The HRLS and the LRHS have half of it each, as in the paper's tables.
AVERAGES = (2, 4, 8)
#: Other divisions of the samples, HRLS : LRHS. They are measured where they give whole numbers.
UNEVEN = ((3, 1), (7, 1))
#: Column -> its title and its format.
MEASURES = {
    "psnr": ("PSNR (sRGB, dB)", "{:.2f}"),
    "relmse": ("RelMSE (0.5, 0.01)", "{:.4f}"),
    "flip": ("FLIP", "{:.4f}"),
}
#: A function that computes a picture (h, w, 3).
Picture = Callable[[], Array]
#: Columns that tell the rows apart.
KEYS = ("scene", "spp", "method")


def methods(scene: scenes.Scene, sessions: Sequence[Session], spp: int) -> Iterator[tuple[str, Picture]]:
    """Yield every method's name, and a function that computes its picture (h, w, 3) for this scene and average spp."""
    hr, full = scene.hrls(spp // 2), scene.hrls(spp)
    prefiltered = functools.cache(partial(oidn_prefiltered, hr))
    yield "HRLS", partial(beauty, hr)
    yield "OIDN on the HRLS", partial(oidn, hr)
    yield "OIDN fast on the HRLS", partial(oidn, hr, "fast")
    yield "OIDN prefiltered on the HRLS", prefiltered
    yield "OIDN, same samples", partial(oidn, full)
    yield "OIDN prefiltered, same samples", partial(oidn_prefiltered, full)
    yield "OIDN prefiltered and split, same samples", partial(oidn_split, full)
    for scale in SCALES:
        lr = scene.lrhs(scale, spp // 2)
        yield f"OIDN prefiltered on both x{scale}, together", partial(_joined, prefiltered, lr, hr)
        for session in sessions:
            if session.contract.scale == scale:
                yield session.name, partial(_fused, session, lr, hr)
    yield from _uneven_methods(scene, sessions, spp)


def _uneven_methods(scene: scenes.Scene, sessions: Sequence[Session], spp: int) -> Iterator[tuple[str, Picture]]:
    """Yield the methods with most samples in the HRLS, where the shares are whole numbers and the HRLS exists."""
    for more, less in UNEVEN:
        unit, rest = divmod(spp, more + less)
        if rest or not scene.has(unit * more):
            continue
        hr, division = scene.hrls(unit * more), f"{more}:{less}"
        yield f"OIDN prefiltered on the HRLS, {division}", partial(oidn_prefiltered, hr)
        for session in sessions:
            lr = scene.lrhs(session.contract.scale, unit * less)
            yield f"{session.name}, {division}", partial(_fused, session, lr, hr)


def _fused(session: Session, lr: ReadableRender, hr: ReadableRender) -> Array:
    return fuse(lr, hr, session).rgb


def _joined(picture: Picture, lr: ReadableRender, hr: ReadableRender) -> Array:
    return match_local_means(picture(), oidn_on_average(lr, hr))


def load_models(names: Sequence[str], pattern: str) -> list[Session]:
    """Load the models for which :func:`methods` has a name that matches the pattern."""
    endings = ("", *(f", {more}:{less}" for more, less in UNEVEN))
    sessions = [load_model(0, name) for name in names]
    return [s for s in sessions if any(fnmatch.fnmatchcase(s.name + ending, pattern) for ending in endings)]


def measure(scene: scenes.Scene, sessions: Sequence[Session], *, flip: bool = False, pattern: str = "*") -> list[Row]:
    """Return a row for each average spp and each method whose name matches the pattern."""
    rows = []
    for spp in AVERAGES:
        for method, picture in methods(scene, sessions, spp):
            if fnmatch.fnmatchcase(method, pattern):
                image = picture()
                row: Row = {"scene": scene.name, "spp": spp, "method": method, **results.model_of(method)}
                row |= scores(image, scene.reference)
                rows.append(row | ({"flip": mean_flip(image, scene.reference)} if flip else {}))
    return rows


def mean_flip(image: Array, reference: Array) -> float:
    """Return the mean FLIP of two linear pictures, shown in sRGB and seen at 67 pixels per degree."""
    import flip_evaluator

    return float(flip_evaluator.evaluate(srgb(reference), srgb(image), "LDR", applyMagma=False)[1])


def with_means(rows: Sequence[Row]) -> list[Row]:
    """Return one row for each scene, average spp and method, behind means over all scenes whose reference is clean.

    A scene with several views counts once. A method that was not measured on all of these scenes gets no mean.
    """
    views: dict[tuple[int, str, str], list[Row]] = {}
    for row in rows:
        views.setdefault((row["spp"], row["method"], row["scene"]), []).append(row)
    by_scene = [_mean(members, members[0]["scene"]) for members in views.values()]
    clean = {row["scene"] for row in rows} - NOISY_REFERENCE
    by_method: dict[tuple[int, str], list[Row]] = {}
    for row in by_scene:
        if row["scene"] in clean:
            by_method.setdefault((row["spp"], row["method"]), []).append(row)
    return [_mean(members, MEAN) for members in by_method.values() if len(members) == len(clean)] + by_scene


def _mean(rows: Sequence[Row], scene: str) -> Row:
    key = {"scene": scene} | {name: rows[0][name] for name in ("spp", "method", "model") if name in rows[0]}
    return key | {name: float(np.mean([row[name] for row in rows])) for name in MEASURES if name in rows[0]}


def mean_note(rows: Sequence[Row]) -> str:
    """Say what the means are over."""
    names = list(dict.fromkeys(row["scene"] for row in rows if row["scene"] != MEAN))
    clean = [name for name in names if name not in NOISY_REFERENCE]
    left_out = [name for name in names if name in NOISY_REFERENCE]
    note = f"Means are over {len(clean)} scenes: {', '.join(clean)}."
    return note + f" Left out, because the reference is noisy: {', '.join(left_out)}." * bool(left_out)


def cell(measure: str, value: float) -> str:
    """Return a measure as text, with no more than the four digits that the table has."""
    return f"{value:.4g}" if "relmse" in measure and value >= 1 else MEASURES[measure][1].format(value)


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("folder", type=Path, help="renders or views")
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; default: all")
    parser.add_argument("--methods", metavar="PATTERN", help="measure only these; --table then keeps its other rows")
    parser.add_argument("--flip", action="store_true", help="also measure FLIP, which takes most of the time")
    args = parser.parse_args()
    pattern = args.methods or "*"
    sessions = load_models(args.model or list(shipped_models()), pattern)
    loaded = scenes.load(args.folder)
    rows = [row for scene in loaded for row in measure(scene, sessions, flip=args.flip, pattern=pattern)]
    if not rows:
        parser.error(f"no method matches {args.methods}")
    results.show(with_means(rows), args.table, KEYS if args.methods else ())


if __name__ == "__main__":
    main()
