# SPDX-License-Identifier: Apache-2.0
"""The paper's tables, measured with what ships, the paper's own figures beside them.

    python -m benchmarks.paper RENDERS > docs/paper.md

RENDERS are folders of :mod:`benchmarks.scenes`; the grid of spp is measured on them, everything else is read from
`benchmarks/results`: `quality.json` and `quality_cycles.json` (`benchmarks.quality`), `runtime.json`
(`benchmarks.runtime`) and `ablations.json` (`training.ablations`).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import quality, runtime, scenes
from oiio_msspl import fuse, metrics
from oiio_msspl.session import Session, find_model

RESULTS = Path(__file__).parent / "results"
#: From the paper: (PSNR, RelMSE) on its BCR data set at 2, 4 and 8 spp on average (table 2), ...
BCR = {
    "full resolution": ((18.12, 0.2953), (21.51, 0.1400), (24.75, 0.0646)),
    "paper-x2": ((33.27, 0.0044), (35.15, 0.0027), (36.74, 0.0019)),
    "paper-x4": ((33.94, 0.0039), (35.21, 0.0028), (36.31, 0.0022)),
    "paper-x8": ((31.37, 0.0075), (32.35, 0.0057), (33.14, 0.0049)),
}
#: ... PSNR on the Gharbi data set at 4 and 8 spp on average (table 3), ...
GHARBI = {
    "full resolution": (19.58, 21.91),
    "paper-x2": (34.02, 35.30),
    "paper-x4": (33.94, 35.22),
    "paper-x8": (31.56, 32.60),
}
#: ... of super-resolution (bicubic, the better of EDSR and RCAN) and of itself, for x2, x4, x8 (table 5), ...
SUPER_RESOLUTION = {2: (30.57, 32.03, 38.40), 4: (25.39, 30.73, 34.27), 8: (22.36, 27.97, 31.08)}
#: ... and at x4 for LRHS of 16, 32 and 64 spp and HRLS of 1, 2 and 4 (table 6).
GRID = {16: (33.94, 34.88, 35.71), 32: (34.22, 35.21, 36.06), 64: (34.42, 35.44, 36.31)}
GRID_HRLS = (1, 2, 4)

Rows = list[dict[str, Any]]


def result(name: str) -> dict[str, Any]:
    """What a benchmark wrote."""
    found: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return found


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def _cell(rows: Rows, method: str, spp: int) -> str:
    if not any((row["method"], row["spp"]) == (method, spp) for row in rows):
        return ""  # views have too few samples for some of the paper's LRHS
    psnr, relmse = (quality.mean_of(rows, method, spp, measure) for measure in ("psnr", "relmse"))
    return f"{psnr:.2f} / {relmse:.4f}"


def comparison(rows: Rows, paper: dict[str, tuple[Any, ...]], averages: tuple[int, ...]) -> str:
    """PSNR and RelMSE by average spp, and the paper's own."""
    ours = ["full resolution", "OIDN, same samples", "OIDN on the HRLS"]
    models = {row["method"] for row in rows if row["method"].startswith(("paper-", "pyramid", "mix", "joint"))}
    ours += sorted(name for name in models if ":" not in name)  # halved, as in the paper
    body = []
    for method in ours:
        theirs = paper.get(method, ("",) * len(averages))
        shown = [f"{a[0]:.2f} / {a[1]:.4f}" if isinstance(a, tuple) else f"{a:.2f}" if a else "" for a in theirs]
        body.append([f"`{method}`" if "-x" in method else method, *(_cell(rows, method, n) for n in averages), *shown])
    return table(["", *(f"{n} spp" for n in averages), *(f"paper, {n} spp" for n in averages)], body)


def runtimes(results: dict[str, dict[str, Any]]) -> str:
    """Seconds and MB for 1024 x 1024."""
    body = [
        [
            f"`{name}`" if "-x" in name else name,
            f"{np.median(row['seconds']):.2f}",
            f"{row['peak_mb']:.0f}",
            *_of_the_paper(name),
        ]
        for name, row in results.items()
        if name.startswith(("paper", "OIDN"))
    ]
    return table(["", "median s", "peak MB", "paper, s", "paper, MB"], body)


def _of_the_paper(name: str) -> list[str]:
    family, _, scale = name.rpartition("-x")
    return [str(value) for value in runtime.PAPER[int(scale)]] if family == "paper" else ["", ""]


def measure_grid(folder: Path) -> dict[tuple[int, int], float]:
    """PSNR of paper-x4 by the spp of LRHS and HRLS, mean of the scenes with clean references."""
    session = Session(find_model(4, "paper-x4"))
    judged = [scene for scene in scenes.load(folder) if scene.name not in scenes.NOISY_REFERENCE]

    def psnr(low: int, high: int) -> float:
        values = []
        for scene in judged:
            fused = fuse(scene.lrhs(4, low // 16), scene.hrls(high), session).rgb
            values.append(metrics.psnr(fused, scene.reference))
        return float(np.mean(values))

    return {(low, high): psnr(low, high) for low in GRID for high in GRID_HRLS}


def grid(measured: dict[tuple[int, int], float]) -> str:
    """The same as a table."""
    body = []
    for low, theirs in GRID.items():
        pairs = zip(GRID_HRLS, theirs, strict=True)
        body.append([f"{low} spp", *(f"{measured[low, high]:.2f} ({paper:.2f})" for high, paper in pairs)])
    return table(["LRHS \\ HRLS", *(f"{high} spp" for high in GRID_HRLS)], body)


def super_resolution(rows: dict[str, dict[str, Any]]) -> str:
    """With and without an HRLS."""
    body = []
    for scale, theirs in SUPER_RESOLUTION.items():
        start = "" if scale == 4 else f"x{scale}, "
        none, layers = rows[f"{start}HRLS: none"], rows[f"{start}HRLS: and diffuse, specular"]
        cells = [none["bicubic_psnr"], none["psnr"], layers["psnr"], *theirs]
        body.append([f"x{scale}", *(f"{value:.2f}" for value in cells)])
    head = ["bicubic", "without an HRLS", "with all of its layers", "paper: bicubic", "EDSR or RCAN", "with"]
    return table(["", *head], body)


def ablations(rows: dict[str, dict[str, Any]]) -> Iterator[str]:
    """The three figures, as tables."""

    def one(title: str, names: dict[str, str]) -> str:
        body = [[shown, f"{rows[n]['psnr']:.2f}", f"{rows[n]['relmse']:.4f}"] for shown, n in names.items()]
        return table([title, "PSNR", "RelMSE"], body)

    same = "both RGB, l1"
    high = {"none": "HRLS: none", "RGB": same} | {f"… {n}": f"HRLS: {n}" for n in ("and albedo", "and normal")}
    yield one("HRLS, beside an LRHS of RGB", high | {"… and diffuse, specular": "HRLS: and diffuse, specular"})
    low = {"none": "LRHS: none", "RGB": same, "all layers": "LRHS: and diffuse, specular"}
    yield one("LRHS, beside an HRLS of RGB", low)
    losses = {"l1": same} | {name: name for name in rows if "loss" in name or "linear" in name}
    yield one("loss", losses)


def claims(ablated: dict[str, dict[str, Any]], rows: Rows, measured: dict[tuple[int, int], float]) -> Iterator[str]:
    """What the paper finds, and whether it is found here: PSNR, which must rise from figure to figure."""

    def claim(text: str, *psnr: float) -> str:
        holds = all(before < after for before, after in pairwise(psnr))
        return (
            f"| {text} | {', '.join(f'{value:.2f}' for value in psnr)} | {'holds' if holds else '**does not hold**'} |"
        )

    def of(*names: str) -> list[float]:
        return [ablated[name]["psnr"] for name in names]

    def mean(method: str, spp: int) -> float:
        return quality.mean_of(rows, method, spp, "psnr")

    same, layers = "both RGB, l1", "HRLS: and diffuse, specular"
    yield "| the paper finds | PSNR here | |\n| --- | --- | --- |"
    yield claim("an HRLS beats super-resolution: none, RGB", *of("HRLS: none", same))
    yield claim("its further layers help: RGB, all", *of(same, layers))
    yield claim("the LRHS's do not: all, RGB", *of("LRHS: and diffuse, specular", same))
    yield claim(
        "of linear radiance, the robust loss is better: l1, robust",
        *of("l1 of linear radiance", "robust loss of linear radiance, beta 0.1"),
    )
    for beta in ("0.01", "1"):
        yield claim(f"its beta is best at 0.1: {beta}, 0.1", *of(f"robust loss, beta {beta}", "robust loss, beta 0.1"))
    for low in GRID:
        yield claim(f"more spp in the HRLS is better, LRHS of {low}", *(measured[low, high] for high in GRID_HRLS))
    for high in GRID_HRLS:
        yield claim(f"more spp in the LRHS is better, HRLS of {high}", *(measured[low, high] for low in GRID))
    yield claim("x4 is best at 2 spp: x2, x4", mean("paper-x2", 2), mean("paper-x4", 2))
    yield claim("x2 is best at 8 spp: x4, x2", mean("paper-x4", 8), mean("paper-x2", 8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", type=Path)
    args = parser.parse_args()

    ablated = result("ablations")
    by_name = {row["name"]: row for row in ablated["rows"]}
    print("# The paper's tables\n")
    print(
        "Made by `python -m benchmarks.paper RENDERS`. The paper's figures are on its own data, which never came out:"
    )
    print("orders and differences compare, values do not. PSNR is of sRGB pictures, RelMSE has (0.5, 0.01).\n")
    print("## Table 2: scenes of the renderer and kind that training had, held out\n")
    cycles = result("quality_cycles")["rows"]
    count = len({row["scene"] for row in cycles})
    print(f"Cycles, {count} scenes, `quality_cycles.json`; beside it the paper's Blender scenes.\n")
    print(comparison(cycles, BCR, quality.AVERAGES))
    print("## Table 3: other people's scenes, another renderer, layers missing\n")
    print("Mitsuba 3, no variance, diffuse and specular, `quality.json`; beside it PSNR on the Gharbi data set.\n")
    print(comparison(result("quality")["rows"], GHARBI, (4, 8)))
    print("## Table 4: time and memory for 1024 x 1024\n")
    print("Two CPU cores; the paper's on a Titan Xp.\n")
    print(runtimes(result("runtime")["results"]))
    print("## Table 5: against super-resolution\n")
    budget = f"{ablated['steps']} steps, {ablated['train_views']} views"
    print(f"PSNR of reduced networks ({budget}) on {ablated['held_out_views']} held-out views: HRLS of 1 spp,")
    print("LRHS of 16 samples for every pixel of the frame.\n")
    print(super_resolution(by_name))
    print("## Table 6: samples, `paper-x4`\n")
    print("PSNR on the scenes of table 3; in brackets the paper's.\n")
    measured = measure_grid(args.renders)
    print(grid(measured))
    print("## Figures 9 and 10: layers and loss\n")
    print("The same reduced networks, x4.\n")
    print("\n".join(ablations(by_name)))
    print("## What the paper finds\n")
    print("\n".join(claims(by_name, result("quality")["rows"], measured)))
    print(
        "\nThe robust loss was made for linear radiance, whose few huge errors would rule l1. There it is better than\n"
        "l1 here, too. Our networks learn on logarithms, which have no such tail: there a large beta, and l1, is best."
    )


if __name__ == "__main__":
    main()
