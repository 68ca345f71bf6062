# SPDX-License-Identifier: Apache-2.0
"""Disturb pairs in every way that goes wrong in production, and measure what each method makes of them.

    python -m research.benchmarks.stability --table research/benchmarks/results/stability.csv
    python -m research.benchmarks.stability --scale 4 --model paper-x4 --model my.onnx

The scenes are analytic pictures with exact references, rendered with the noise of one-sample Monte Carlo. The HRLS has
1 spp, or 4 where layers or the variance are disturbed. The LRHS has one sample for every HRLS pixel. A case may say
otherwise. :mod:`research.benchmarks.stability.measures` says what is measured and judged.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.aovs.features import RGB
from oiio_msspl.compare import upsample_bicubic
from oiio_msspl.image.arrays import Array, repair
from oiio_msspl.model.catalogue import find_model, shipped_models
from oiio_msspl.model.contract import CLEAN, SCALES
from oiio_msspl.model.session import Session
from research.benchmarks import peers, results
from research.benchmarks.stability import cases
from research.benchmarks.stability.cases import Pair
from research.benchmarks.stability.measures import KEYS, judged, measure

#: Side of the analytic frames.
SIZE = 256

#: From a pair to the picture (h, w, 3) and the warnings.
Method = Callable[[Pair], tuple[Array, list[str]]]


def enlarged(pair: Pair) -> Array:
    """Enlarge the LRHS."""
    return upsample_bicubic(repair(pair.lr.layers[RGB])[0], pair.hr.data_window.width, pair.hr.data_window.height)


def ours(session: Session) -> Method:
    """Return the method that fuses with a model."""

    def run(pair: Pair) -> tuple[Array, list[str]]:
        fused = fuse(pair.lr, pair.hr, session)
        return fused.rgb, [*fused.warnings]

    return run


def run(scale: int, methods: dict[str, Method], size: int) -> list[dict[str, Any]]:
    """Return what :func:`measure` finds for each case and method, and the columns that tell them apart."""
    rows = []
    for group, make in cases.GROUPS.items():
        undisturbed: dict[tuple[str, Pair], Array] = {}
        for case in make(size, scale):
            small = enlarged(case.pair)
            for name, method in methods.items():
                if case.clean is not None and (name, case.clean) not in undisturbed:
                    undisturbed[name, case.clean] = method(case.clean)[0]
                image, warnings = method(case.pair)
                clean = undisturbed[name, case.clean] if case.clean is not None else None
                key = {"scale": scale, "group": group, "case": case.name, "method": name}
                rows.append(key | measure(case, image, clean, small, warnings))
        print(f"x{scale}: {group}", file=sys.stderr)
    return rows


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("--model", action="append", default=[], help="ONNX file or shipped name; repeat it for more")
    parser.add_argument("--scale", type=int, nargs="+", choices=SCALES, default=[2, 4], help="default: 2 4")
    args = parser.parse_args()
    # The models for little noise never see renders of so few samples.
    shipped = [file for name, file in shipped_models().items() if CLEAN not in name]
    files = [find_model(4, name) for name in args.model] or shipped
    sessions = [Session(file) for file in files]
    peer: dict[str, Method] = {"OIDN prefiltered on the HRLS": lambda pair: (peers.oidn_prefiltered(pair.hr), [])}
    rows = []
    for scale in args.scale:
        models = {session.contract.name: ours(session) for session in sessions if session.contract.scale == scale}
        rows += run(scale, models | peer, SIZE)
    results.show(judged(rows), args.table, KEYS)


if __name__ == "__main__":
    with np.errstate(all="ignore"):
        main()
