# SPDX-License-Identifier: Apache-2.0
"""Is `--model auto` right? What its choice costs in accuracy and saves in time.

    python -m benchmarks.ladder RENDERS --json benchmarks/results/ladder.json
    python -m benchmarks.ladder VIEWS --split validation        # where the bound comes from

For every scene, scale and average spp: the error that the fast model expects (:mod:`oiio_msspl.choice`), PSNR in sRGB
of the fast and of the best model, and which one is taken. Then means: against always taking the best. Times are from
`benchmarks/results/runtime.json`.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import scenes
from benchmarks.quality import AVERAGES
from oiio_msspl import choice, fuse, metrics, schema
from oiio_msspl.pairing import pair
from oiio_msspl.session import BEST, FAST, Session, find_model

RUNTIME = Path(__file__).parent / "results" / "runtime.json"


def measure(judged: list[scenes.Scene]) -> list[dict[str, Any]]:
    """One row a scene, scale and average: ``expected`` error, PSNR by family, ``takes``."""
    sessions = {(s, family): Session(find_model(s, family)) for s in schema.SCALES for family in (FAST, BEST)}
    rows = []
    for scene in judged:
        for scale in schema.SCALES:
            for spp in AVERAGES:
                low, high = scene.lrhs(scale, spp // 2), scene.hrls(spp // 2)
                scores = {
                    family: metrics.psnr(fuse(low, high, sessions[scale, family]).rgb, scene.reference)
                    for family in (FAST, BEST)
                }
                expected = choice.expected_error(low, high, pair(low, high), sessions[scale, FAST])
                takes = FAST if expected < choice.ENOUGH else BEST
                case = {"scene": scene.name, "scale": scale, "spp": spp}
                rows.append(case | {"expected": expected, "takes": takes} | scores)
    return rows


def print_tables(rows: list[dict[str, Any]], seconds: dict[str, float]) -> None:
    print("| scene | scale | spp | expected error | fast, dB | best, dB | takes |\n|---|---|---|---|---|---|---|")
    for row in sorted(rows, key=lambda row: row["expected"]):
        cells = [row["scene"], f"x{row['scale']}", f"{row['spp']}", f"{row['expected']:.4f}"]
        print("| " + " | ".join([*cells, f"{row[FAST]:.2f}", f"{row[BEST]:.2f}", row["takes"]]) + " |")
    expected, psnr = ([row[key] for row in rows] for key in ("expected", FAST))
    print(f"\nCorrelation of its logarithm with PSNR: {np.corrcoef(np.log(expected), psnr)[0, 1]:.2f}")
    print("\n| | PSNR, mean | lost, mean | lost, worst | time of always the best |\n|---|---|---|---|---|")
    best = statistics.fmean(seconds[f"{BEST}-x{row['scale']}"] for row in rows)
    ways = {"always the best": lambda row: BEST, "auto": lambda row: row["takes"], "always fast": lambda row: FAST}
    for name, way in ways.items():
        lost = [row[BEST] - row[way(row)] for row in rows]
        time = statistics.fmean(seconds[f"{way(row)}-x{row['scale']}"] for row in rows)
        psnr = statistics.fmean(row[way(row)] for row in rows)
        print(f"| {name} | {psnr:.2f} | {statistics.fmean(lost):.2f} | {max(lost):.2f} | {time / best:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="renders or views")
    parser.add_argument("--split", default="test", help="of views")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    args = parser.parse_args()
    judged = [scene for scene in scenes.load(args.folder, args.split) if scene.name not in scenes.NOISY_REFERENCE]
    rows = measure(judged)
    results = json.loads(RUNTIME.read_text())["results"]
    print_tables(rows, {name: statistics.median(result["seconds"]) for name, result in results.items()})
    if args.json:
        args.json.write_text(json.dumps({"bound": choice.ENOUGH, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
