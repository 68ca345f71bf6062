# SPDX-License-Identifier: Apache-2.0
"""Disturbs pairs in every way that goes wrong in production, and measures what each method makes of them.

    python -m research.benchmarks.stability --table research/benchmarks/results/stability.csv --picture
    docs/images/stability.png python -m research.benchmarks.stability VIEWS --scale 4 --model paper-x4 --model my.onnx

Without arguments it uses analytic scenes and all shipped models for x4. VIEWS adds the held-out views of a folder of
rendered views (see research/datagen/views.py). :mod:`research.benchmarks.stability.report` says what is measured.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.aovs.features import RGB
from oiio_msspl.compare import upsample_bicubic
from oiio_msspl.image.arrays import Array
from oiio_msspl.model.catalogue import find_model, shipped_models
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.session import Session
from research.benchmarks import peers, results
from research.benchmarks.results import Row
from research.benchmarks.stability import bases, cases, measures, report
from research.benchmarks.stability.gallery import Gallery

#: Side of the analytic frames.
SIZE = 256

#: From a pair to the picture (h, w, 3) and the warnings.
Method = Callable[[bases.Pair], tuple[Array, list[str]]]


def enlarged(pair: bases.Pair) -> tuple[Array, list[str]]:
    low = measures.repaired(pair.lr.layers[RGB])
    return upsample_bicubic(low, pair.hr.data_window.width, pair.hr.data_window.height), []


def oidn(pair: bases.Pair) -> tuple[Array, list[str]]:
    return peers.oidn(pair.hr), []


def oidn_prefiltered(pair: bases.Pair) -> tuple[Array, list[str]]:
    return peers.oidn_prefiltered(pair.hr), []


def ours(session: Session) -> Method:
    def run(pair: bases.Pair) -> tuple[Array, list[str]]:
        fused = fuse(pair.lr, pair.hr, session)
        return fused.rgb, fused.warnings

    return run


def methods_for(scale: int, sessions: list[Session]) -> dict[str, Method]:
    models = {session.contract.name: ours(session) for session in sessions if session.contract.scale == scale}
    denoisers = {"OIDN on the HRLS": oidn, "OIDN prefiltered on the HRLS": oidn_prefiltered}
    return {report.ENLARGED: enlarged, **models, **denoisers}


def groups_of(base: bases.Base | None, scale: int, size: int) -> Iterator[tuple[str, Iterator[cases.Case]]]:
    """Each group and its cases, for a rendered view, or for the analytic scenes if ``base`` is None."""
    for name, anywhere in cases.ANYWHERE.items():
        yield name, anywhere(base or cases.room(size), scale)
    if base is None:
        for name, made in cases.MADE.items():
            yield name, made(size, scale)


def run(
    base: bases.Base | None, scale: int, methods: dict[str, Method], size: int, gallery: Gallery | None = None
) -> list[dict[str, Any]]:
    """What :func:`measures.measure` finds for each case and method, and ``scale, scenes, group, case, method``."""
    rows = []
    for group, members in groups_of(base, scale, size):
        undisturbed: dict[tuple[str, bases.Pair], Array] = {}
        for case in members:
            pictures: dict[str, Array] = {}
            for name, method in methods.items():
                if case.clean is not None and (name, case.clean) not in undisturbed:
                    undisturbed[name, case.clean] = method(case.clean)[0]
                pictures[name], warnings = method(case.pair)
                clean = undisturbed[name, case.clean] if case.clean is not None else None
                figures = measures.measure(case, pictures[name], clean, pictures[report.ENLARGED], warnings)
                scenes = "views" if base else "analytic"
                key = {"scale": scale, "scenes": scenes, "group": group, "case": case.name, "method": name}
                rows.append({**key, **figures})
            if gallery is not None:
                gallery.add(scale, group, case, pictures)
        print(f"x{scale} {base.name if base else 'analytic'}: {group}", file=sys.stderr)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, nargs="?", metavar="VIEWS", help="folder of rendered views")
    parser.add_argument("--model", action="append", default=[], help="ONNX file or shipped name; repeat it for more")
    parser.add_argument("--scale", type=int, action="append", choices=SCALES, help="default: those of --model, or 4")
    parser.add_argument("--size", type=int, default=SIZE, help="side of the analytic frames (%(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="of ONNX Runtime; 0: one a core")
    parser.add_argument("--picture", type=Path, help="draw the error maps of each group's worst analytic case as a PNG")
    parser.add_argument(
        "--pictures", type=Path, help="draw results and error maps of every analytic case, a PNG a group"
    )
    results.add_option(parser)
    args = parser.parse_args()
    files = [find_model(4, name) for name in args.model] or list(shipped_models().values())
    sessions = [Session(file, threads=args.threads) for file in files]
    scales = args.scale or (sorted({session.contract.scale for session in sessions}) if args.model else [4])
    measured = []
    gallery = Gallery() if args.picture or args.pictures else None
    for scale in scales:
        methods = methods_for(scale, sessions)
        measured += run(None, scale, methods, args.size, gallery)
        for view in bases.views(args.views) if args.views else []:
            measured += run(view, scale, methods, args.size)
    rows: list[Row] = report.judged(measured)
    print(report.document(rows))
    if args.table:
        results.write(args.table, rows)
    if gallery and args.picture:
        gallery.write_worst(args.picture, rows)
    if gallery and args.pictures:
        gallery.write_groups(args.pictures)


if __name__ == "__main__":
    with np.errstate(all="ignore"):
        main()
