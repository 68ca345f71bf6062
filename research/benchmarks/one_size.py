# SPDX-License-Identifier: Apache-2.0
"""Measure what one render, two renders of one size, and a pair of two sizes give, at equal average samples.

    python -m research.benchmarks.one_size RENDERS --one 32 --two 16:32 --table research/benchmarks/results/one_size.csv

RENDERS are those of :mod:`research.benchmarks.scenes`. "best-x1" is the model that `--quality best` takes for the noise
of one render, "best-x1, two seeds" that for two of the same size, "best-x2" and "best-x4" that for an LRHS of half
or a quarter of the size and an HRLS with half of the samples each. "OIDN" and "OIDN prefiltered" get the one render,
and "OIDN, two seeds" the mean of both, weighted by their spp.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from oiio_msspl import Render, fuse
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.compare import scores
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.arrays import Array
from oiio_msspl.jobs.settings import family_for_noise
from oiio_msspl.model.catalogue import QUALITIES, load_model
from oiio_msspl.model.session import Session
from research.benchmarks import results, scenes
from research.benchmarks.accuracy import KEYS, with_means
from research.benchmarks.peers import oidn, oidn_prefiltered
from research.benchmarks.results import Row

#: Ending of a method that gets two renders of one size.
SEEDS = ", two seeds"
#: Scales of pairs of two sizes.
PAIRS = (2, 4)

#: A method, its model if it is one of ours, and a function that computes its picture.
Method = tuple[str, str | None, Callable[[], Array]]


def of_one(scene: scenes.Scene, spp: int) -> Iterator[Method]:
    """Yield every method that gets one render or a pair of two sizes."""
    render = scene.hrls(spp)
    yield "OIDN", None, partial(oidn, render)
    yield "OIDN prefiltered", None, partial(oidn_prefiltered, render)
    yield from _chosen(render, render)
    for scale in PAIRS:
        yield from _chosen(scene.lrhs(scale, spp // 2), scene.hrls(spp // 2))


def of_two(scene: scenes.Scene, spp: tuple[int, int]) -> Iterator[Method]:
    """Yield every method that gets two renders of one size."""
    first, second = (scene.hrls(count) for count in spp)
    share = spp[0] / sum(spp)
    low, high = (render.read(render.data_window) for render in (first, second))
    mean = Render.from_arrays("mean", **{name: share * low[name] + (1 - share) * high[name] for name in high})
    yield f"OIDN{SEEDS}", None, partial(oidn, mean)
    yield f"OIDN prefiltered{SEEDS}", None, partial(oidn_prefiltered, mean)
    for method, model, picture in _chosen(first, second, share):
        yield f"{method}{SEEDS}", model, picture


def _chosen(lr: ReadableRender, hr: ReadableRender, share: float | None = None) -> Iterator[Method]:
    """Yield each quality, with the model that it takes for the noise of the renders."""
    alignment = align(lr, hr)
    for quality, family in QUALITIES.items():
        session = _loaded(alignment.scale, family_for_noise(family, lr, hr, alignment)[0])
        yield f"{quality}-x{alignment.scale}", session.name, partial(_fused, lr, hr, session, share)


_loaded = functools.cache(load_model)


def _fused(lr: ReadableRender, hr: ReadableRender, session: Session, share: float | None = None) -> Array:
    return fuse(lr, hr, session, share=share).rgb


def measure(folder: Path, one: Sequence[int], two: Sequence[tuple[int, int]]) -> list[Row]:
    """Return a row for each scene, average spp and method."""
    rows: list[Row] = []
    for scene in scenes.load(folder):
        jobs = [(spp, of_one(scene, spp)) for spp in one]
        jobs += [(sum(spp), of_two(scene, spp)) for spp in two]
        for spp, methods in jobs:
            for method, model, picture in methods:
                key = {"scene": scene.name, "spp": spp, "method": method} | ({"model": model} if model else {})
                rows.append(key | scores(picture(), scene.reference))
    return rows


def _two(text: str) -> tuple[int, int]:
    first, second = map(int, text.split(":"))
    return first, second


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("folder", type=Path, help="renders")
    parser.add_argument("--one", type=int, nargs="*", default=[], metavar="SPP", help="of one render, and of a pair")
    parser.add_argument("--two", type=_two, nargs="*", default=[], metavar="SPP:SPP", help="of two renders of one size")
    args = parser.parse_args()
    results.show(with_means(measure(args.folder, args.one, args.two)), args.table, KEYS)


if __name__ == "__main__":
    main()
