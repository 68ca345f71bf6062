# SPDX-License-Identifier: Apache-2.0
"""Measure PSNR of `paper-x4` for several spp of either render, as in the paper's table 6.

    python -m research.benchmarks.sample_counts RENDERS --table research/benchmarks/results/sample_counts.csv

The mean is over the development scenes whose reference is clean (:mod:`research.benchmarks.scenes`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.image.metrics import psnr
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.session import Session
from research.benchmarks import results, scenes
from research.benchmarks.results import Row

MODEL, SCALE = "paper-x4", 4
LRHS_SPP, HRLS_SPP = (16, 32, 64), (1, 2, 4)


def measure(clean: list[scenes.Scene]) -> list[Row]:
    """Return a row for each pair of spp."""
    session = Session(find_model(SCALE, MODEL))

    def score(scene: scenes.Scene, low: int, high: int) -> float:
        pair = scene.lrhs(SCALE, low // SCALE**2), scene.hrls(high)
        return psnr(fuse(*pair, session).rgb, scene.reference)

    return [
        {"lrhs_spp": low, "hrls_spp": high, "model": MODEL}
        | {"psnr": float(np.mean([score(scene, low, high) for scene in clean]))}
        for low in LRHS_SPP
        for high in HRLS_SPP
    ]


def main() -> None:
    """Measure the scenes of a folder."""
    parser = results.parser(__doc__)
    parser.add_argument("renders", type=Path)
    args = parser.parse_args()
    clean = [scene for scene in scenes.load(args.renders) if scene.name not in scenes.NOISY_REFERENCE]
    results.show(results.plain, measure(clean), args.table)


if __name__ == "__main__":
    main()
