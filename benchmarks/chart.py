# SPDX-License-Identifier: Apache-2.0
"""Accuracy against time, from what `benchmarks.quality` and `benchmarks.runtime` measured.

    python -m benchmarks.chart --quality results/quality.json --runtime results/runtime.json -o chart.png
    python -m benchmarks.chart ... --scene lamp -o chart_lamp.svg

A column an average spp; a point a model or peer. Left and up is better (RelMSE is drawn downwards).
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator

from benchmarks.quality import NOISY_REFERENCE

#: Peer of `benchmarks.quality` -> marker, and what it runs as `benchmarks.runtime` names it. Families of models
#: differ in colour.
PEERS = {
    "OIDN, same samples": ("*", "OIDN 2.5.1, quality high"),
    "OIDN on the HRLS": ("D", "OIDN 2.5.1, quality high"),
    "OIDN fast on the HRLS": ("d", "OIDN 2.5.1, quality fast"),
}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
MEASURES = {"psnr": "PSNR (sRGB, dB)", "relmse": "RelMSE (0.5, 0.01)"}


def mean(rows: list[dict[str, Any]], method: str, spp: int, measure: str, scene: str | None) -> float:
    """Of one scene, or of all whose reference is clean."""
    return statistics.fmean(
        row[measure]
        for row in rows
        if row["method"] == method
        and row["spp"] == spp
        and (row["scene"] == scene if scene else row["scene"] not in NOISY_REFERENCE)
    )


def draw(rows: list[dict[str, Any]], runtimes: dict[str, Any], scene: str | None) -> plt.Figure:
    seconds = {name: statistics.median(entry["seconds"]) for name, entry in runtimes.items()}
    models = [name for name in seconds if any(row["method"] == name for row in rows)]
    families: dict[str, list[str]] = {}
    for name in models:
        families.setdefault(name.rpartition("-x")[0], []).append(name)
    averages = sorted({row["spp"] for row in rows})
    figure, axes = plt.subplots(
        len(MEASURES), len(averages), figsize=(4.2 * len(averages), 7), sharex=True, sharey="row", squeeze=False
    )
    for line, (measure, label) in zip(axes, MEASURES.items(), strict=True):
        for axis, spp in zip(line, averages, strict=True):
            for colour, (family, members) in zip(COLOURS, families.items(), strict=False):
                points = [(seconds[name], mean(rows, name, spp, measure, scene)) for name in members]
                axis.plot(*zip(*points, strict=True), "-o", color=colour, label=family, linewidth=1)
                for name, point in zip(members, points, strict=True):
                    axis.annotate(name.rpartition("-")[2], point, (4, 4), textcoords="offset points", fontsize=8)
            for peer, (marker, run) in PEERS.items():
                if run in seconds:
                    value = mean(rows, peer, spp, measure, scene)
                    axis.plot(seconds[run], value, marker, color="black", markersize=8, label=peer, linestyle="none")
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter("")
            axis.grid(True, which="both", alpha=0.25)
            if measure == "psnr":
                axis.set_title(f"{spp} spp on average")
            else:
                axis.set_yscale("log")
                axis.set_xlabel("seconds for 1024 x 1024")
        line[0].set_ylabel(label)
    axes[1][0].invert_yaxis()
    figure.suptitle(f"Accuracy against time: {scene or 'mean of the scenes'} (left and up is better)")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), fontsize=9)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    results = Path(__file__).parent / "results"
    parser.add_argument("--quality", type=Path, default=results / "quality.json")
    parser.add_argument("--runtime", type=Path, default=results / "runtime.json")
    parser.add_argument("--scene", help="one scene instead of the mean")
    parser.add_argument("-o", "--output", type=Path, required=True, help="PNG, SVG or PDF")
    args = parser.parse_args()
    rows = json.loads(args.quality.read_text())["rows"]
    runtimes = json.loads(args.runtime.read_text())["results"]
    draw(rows, runtimes, args.scene).savefig(args.output, dpi=110)


if __name__ == "__main__":
    main()
