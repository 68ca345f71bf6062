# SPDX-License-Identifier: Apache-2.0
"""Measure sequences that are fused frame by frame and with their neighbours, beside OIDN's.

    python -m research.benchmarks.render.sequences SEQUENCES --scenes SCENES
    python -m research.datagen.cycles.sequence SEQUENCES
    python -m research.benchmarks.shots SEQUENCES --table research/benchmarks/results/shots.csv
    python -m research.benchmarks.shots SPREAD --spread --table research/benchmarks/results/shots_spread.csv

The things in ``cycles/slide`` move to the side alone, so its pixels don't tell which way y points. If the benchmark
says so, give that sequence Blender's format, in one line::

    --motion-format layer=Vector,channels=XY,to=previous,x=right,y=up,unit=pixels
                   +layer=Vector,channels=ZW,to=next,x=left,y=down,unit=pixels

:mod:`research.benchmarks.shots.measures` defines the measures.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import srgb
from oiio_msspl.jobs.plan import AUTO, TemporalOptions
from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.shots.measures import flicker, psnr
from research.benchmarks.shots.methods import all_methods
from research.benchmarks.shots.sequence import Sequence, load, without_vectors

KEYS = ("sequence", "scale", "method")


def measure(sequence: Sequence, made: list[tuple[Row, Array]]) -> Iterator[Row]:
    """Yield a row for each method of :func:`research.benchmarks.shots.methods.all_methods`."""
    truth = srgb(sequence.truth[0]), srgb(sequence.truth[1])
    for columns, linear in made:
        images = srgb(linear)
        by_frame = [psnr(image, (first, second)) for image, first, second in zip(images, *truth, strict=True)]
        row: Row = {"sequence": sequence.name, **columns}
        row |= {"psnr": float(np.mean(by_frame)), "flicker": flicker(images, truth)}
        yield row | {name: psnr(images, truth, mask) for name, mask in sequence.masks.items()}


def main() -> None:
    """Measure sequences. Their rows replace those of the same sequences and methods in the table."""
    parser = results.parser(__doc__)
    parser.add_argument("folder", type=Path, help="the sequences")
    parser.add_argument("--sequence", action="append", default=[], help="SCENE/KIND; default: all that are there")
    parser.add_argument("--motion-format", help="as that of msspl-fuse, for all these sequences")
    parser.add_argument("--without-vectors", action="store_true", help="leave out the motion vectors of Mitsuba's")
    parser.add_argument("--spread", action="store_true", help="a pixel filter has spread the noise")
    parser.add_argument("--methods", default="*", metavar="PATTERN", help="measure only these")
    args = parser.parse_args()
    files = args.folder.glob("*/*/hr.0001.exr")
    names = args.sequence or sorted(f"{path.parent.parent.name}/{path.parent.name}" for path in files)
    if not names:
        parser.error(f"{args.folder}: holds no sequences; python -m research.benchmarks.render.sequences makes them")
    for name in names:
        sequence = load(args.folder / name, args.motion_format)
        options = TemporalOptions(AUTO, args.motion_format)
        with tempfile.TemporaryDirectory() as folder:
            judged = without_vectors(sequence, Path(folder)) if args.without_vectors else sequence
            made = list(all_methods(judged, options, args.methods, spread=args.spread))
        results.show(list(measure(sequence, made)), args.table, KEYS)


if __name__ == "__main__":
    main()
