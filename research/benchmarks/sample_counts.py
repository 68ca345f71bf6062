# SPDX-License-Identifier: Apache-2.0
"""PSNR of `paper-x4` for several spp of either render, as in the paper's table 6.

    python -m research.benchmarks.spp_grid RENDERS --table research/benchmarks/results/spp_grid.csv

The mean is over the development scenes whose reference is clean (:mod:`research.benchmarks.scenes`).
"""

from __future__ import annotations

import argparse
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
    """A row for each pair of spp."""
    session = Session(find_model(SCALE, MODEL))

    def score(scene: scenes.Scene, low: int, high: int) -> float:
        pair = scene.lrhs(SCALE, low // SCALE**2), scene.hrls(high)
        return psnr(fuse(*pair, session).rgb, scene.reference)

    return [
        {"lrhs_spp": low, "hrls_spp": high, "psnr": float(np.mean([score(scene, low, high) for scene in clean]))}
        for low in LRHS_SPP
        for high in HRLS_SPP
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", type=Path)
    results.add_option(parser)
    args = parser.parse_args()
    rows = measure([scene for scene in scenes.load(args.renders) if scene.name not in scenes.NOISY_REFERENCE])
    found = results.index(rows, "lrhs_spp", "hrls_spp")
    body = [[f"{low} spp", *(f"{found[low, high]['psnr']:.2f}" for high in HRLS_SPP)] for low in LRHS_SPP]
    print(results.markdown(["LRHS \\ HRLS", *(f"{high} spp" for high in HRLS_SPP)], body))
    if args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
