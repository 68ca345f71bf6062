# SPDX-License-Identifier: Apache-2.0
"""Accuracy against time, from what `benchmarks.quality`, `benchmarks.runtime` and `benchmarks.render_time` measured.

    python -m benchmarks.chart -o docs/images/chart.png
    python -m benchmarks.chart -o docs/chart.html              # also against render and all, and every scene
    python -m benchmarks.chart --scene lamp --total -o lamp.svg

A column an average spp; a point a model or peer. Left and up is better (errors are drawn downwards). Dashed: where the
HRLS has as large a part of the samples as was measured, instead of half.
"""

from __future__ import annotations

import argparse
import html
import io
import json
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator

from benchmarks.quality import UNEVEN
from benchmarks.scenes import NOISY_REFERENCE

#: Peer of `benchmarks.quality` -> marker, and what it runs as `benchmarks.runtime` names it. Families of models
#: differ in colour.
PEERS = {
    "OIDN, same samples": ("*", "OIDN 2.5.1, quality high"),
    "OIDN on the HRLS": ("D", "OIDN 2.5.1, quality high"),
    "OIDN fast on the HRLS": ("d", "OIDN 2.5.1, quality fast"),
}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
#: What is drawn of what was measured, a row each.
MEASURES = {"psnr": "PSNR (sRGB, dB)", "relmse": "RelMSE (0.5, 0.01)", "flip": "FLIP"}


@dataclass(frozen=True)
class Timings:
    """Seconds for 1024 x 1024."""

    methods: dict[str, float]
    samples: dict[str, float]
    """For one sample a pixel, by scene."""

    def of_a_sample(self, scene: str | None) -> float:
        """Of one scene, or the mean of those that are averaged."""
        if scene is not None:
            return self.samples[scene]
        return statistics.fmean(value for name, value in self.samples.items() if name not in NOISY_REFERENCE)


def mean(rows: list[dict[str, Any]], method: str, spp: int, measure: str, scene: str | None) -> float:
    """Of one scene, or of all whose reference is clean."""
    return statistics.fmean(
        row[measure]
        for row in rows
        if row["method"] == method
        and row["spp"] == spp
        and (row["scene"] == scene if scene else row["scene"] not in NOISY_REFERENCE)
    )


def draw(rows: list[dict[str, Any]], timings: Timings, scene: str | None, *, total: bool) -> plt.Figure:
    """Of one scene or the mean; against the time of the method, or of method and render together."""
    seconds = timings.methods
    models = [name for name in seconds if any(row["method"] == name for row in rows)]
    families: dict[str, list[str]] = {}
    for name in models:
        families.setdefault(name.rpartition("-x")[0], []).append(name)
    averages = sorted({row["spp"] for row in rows})
    measures = {measure: label for measure, label in MEASURES.items() if measure in rows[0]}
    measured = {(row["method"], row["spp"]) for row in rows if scene in (None, row["scene"])}
    figure, axes = plt.subplots(
        len(measures),
        len(averages),
        figsize=(4.2 * len(averages), 3.5 * len(measures)),
        sharex=not total,
        sharey="row",
        squeeze=False,
    )
    for line, (measure, label) in zip(axes, measures.items(), strict=True):
        for axis, spp in zip(line, averages, strict=True):
            before = spp * timings.of_a_sample(scene) if total else 0.0
            for colour, (family, members) in zip(COLOURS, families.items(), strict=False):
                points = [(before + seconds[name], mean(rows, name, spp, measure, scene)) for name in members]
                axis.plot(*zip(*points, strict=True), "-o", color=colour, label=family, linewidth=1)
                for more, less in reversed(UNEVEN):
                    uneven = [f"{name}, {more}:{less}" for name in members]
                    if all((name, spp) in measured for name in uneven):
                        values = [mean(rows, name, spp, measure, scene) for name in uneven]
                        axis.plot([x for x, _ in points], values, "--^", color=colour, linewidth=1, markersize=4)
                        break
                for name, point in zip(members, points, strict=True):
                    axis.annotate(name.rpartition("-")[2], point, (4, 4), textcoords="offset points", fontsize=8)
            for peer, (marker, run) in PEERS.items():
                if run in seconds:
                    value = mean(rows, peer, spp, measure, scene)
                    axis.plot(
                        before + seconds[run], value, marker, color="black", markersize=8, label=peer, linestyle="none"
                    )
            if not total:
                axis.set_xscale("log")
                axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.xaxis.set_major_formatter("{x:g}")
                axis.xaxis.set_minor_formatter("")
            axis.grid(True, which="both", alpha=0.25)
            if measure == "psnr":
                axis.set_title(f"{spp} spp on average")
            else:
                axis.set_yscale("log")
            if measure == list(measures)[-1]:
                axis.set_xlabel("seconds for 1024 x 1024" + (", render included" if total else ""))
        line[0].set_ylabel(label)
        if measure != "psnr":
            line[0].invert_yaxis()
    figure.suptitle(f"Accuracy against time: {scene or 'mean of the scenes'} (left and up is better)")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), fontsize=9)
    figure.tight_layout(rect=(0, 0.04, 1, 1))
    return figure


def page(rows: list[dict[str, Any]], timings: Timings) -> str:
    """All charts, as an HTML page that needs nothing else."""
    names = [None, *dict.fromkeys(row["scene"] for row in rows)]
    parts = ["<!doctype html>", '<meta charset="utf-8">', "<title>Accuracy against time</title>"]
    parts.append("<style>body {font-family: sans-serif; margin: 2em} svg {max-width: 100%; height: auto}</style>")
    for name in names:
        noisy = " (noisy reference)" if name in NOISY_REFERENCE else ""
        parts.append(f"<h2>{html.escape(name or 'Mean of the scenes')}{noisy}</h2>")
        for total in (False, True):
            with plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "msspl"}):
                text = io.StringIO()
                figure = draw(rows, timings, name, total=total)
                figure.savefig(text, format="svg", metadata={"Date": None})
                plt.close(figure)
            svg = text.getvalue()
            parts.append(svg[svg.index("<svg") :])  # without the XML declaration
    return "\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    results = Path(__file__).parent / "results"
    parser.add_argument("--quality", type=Path, default=results / "quality.json")
    parser.add_argument("--runtime", type=Path, default=results / "runtime.json")
    parser.add_argument("--render-time", type=Path, default=results / "render_time.json")
    parser.add_argument("--scene", help="one scene instead of the mean")
    parser.add_argument("--total", action="store_true", help="against the time of render and method together")
    parser.add_argument("-o", "--output", type=Path, required=True, help="PNG, SVG or PDF; or HTML: every chart")
    args = parser.parse_args()
    rows = json.loads(args.quality.read_text())["rows"]
    runtimes = json.loads(args.runtime.read_text())["results"]
    samples = json.loads(args.render_time.read_text())["seconds_per_spp"]
    timings = Timings(
        {name: statistics.median(entry["seconds"]) for name, entry in runtimes.items()},
        {name: entry["hrls"] for name, entry in samples.items()},
    )
    if args.output.suffix == ".html":
        args.output.write_text(page(rows, timings))
    else:
        draw(rows, timings, args.scene, total=args.total).savefig(args.output, dpi=110)


if __name__ == "__main__":
    main()
