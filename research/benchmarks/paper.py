# SPDX-License-Identifier: Apache-2.0
"""The paper's tables, with our results beside the paper's own.

    python -m research.benchmarks.paper

Everything is read from `research/benchmarks/results`. The tables there come from `research.benchmarks.accuracy`,
`research.benchmarks.runtime`, `research.benchmarks.spp_grid` and `research.benchmarks.ablations`.
"""

from __future__ import annotations

import argparse
from collections.abc import Hashable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from oiio_msspl.model.contract import SCALES
from research.benchmarks import quality, results, tables
from research.benchmarks.results import MEAN, Row
from research.benchmarks.spp_grid import HRLS_SPP, LRHS_SPP

#: (PSNR, RelMSE) on the paper's BCR data set at 2, 4 and 8 spp on average (its table 2).
BCR = {
    "full resolution": ((18.12, 0.2953), (21.51, 0.1400), (24.75, 0.0646)),
    "paper-x2": ((33.27, 0.0044), (35.15, 0.0027), (36.74, 0.0019)),
    "paper-x4": ((33.94, 0.0039), (35.21, 0.0028), (36.31, 0.0022)),
    "paper-x8": ((31.37, 0.0075), (32.35, 0.0057), (33.14, 0.0049)),
}
#: Scale -> seconds on a Titan Xp GPU and MB of its memory (its table 4 and text).
RUNTIME = {2: (0.362, 1134), 4: (0.118, 749), 8: (0.052, 737)}
#: Scale -> PSNR of bicubic upsampling, of the better of EDSR and RCAN, and of the paper's method (its table 5).
SUPER_RESOLUTION = {2: (30.57, 32.03, 38.40), 4: (25.39, 30.73, 34.27), 8: (22.36, 27.97, 31.08)}
#: spp of the LRHS -> PSNR at x4 for an HRLS of 1, 2 and 4 spp (its table 6).
GRID = {16: (33.94, 34.88, 35.71), 32: (34.22, 35.21, 36.06), 64: (34.42, 35.44, 36.31)}

#: Rows of `research.benchmarks.ablations` that several tables show.
SAME, ALL_LAYERS = "both RGB, l1", "HRLS: and diffuse, specular"

Found = Mapping[Hashable, Row]


def title(method: str) -> str:
    """A method's name, as code if it is a model's."""
    return f"`{method}`" if "-x" in method else method


def comparison(rows: list[Row], averages: tuple[int, ...], paper: dict[str, tuple[Any, ...]] | None = None) -> str:
    """PSNR and RelMSE by average spp, and the paper's own if they are measured alike."""
    means = results.index((row for row in rows if row["scene"] == MEAN), "spp", "method")
    models = sorted({row["method"] for row in rows if row["method"].startswith(("paper-", "joint-"))})
    peers = ("full resolution", *tables.PEERS)
    body = []
    for method in [*peers, *(name for name in models if ":" not in name)]:
        cells = [quality.cell(means.get((spp, method)), "psnr", "relmse") for spp in averages]
        if not any(cells):
            continue
        theirs = paper.get(method) if paper else None
        shown = [f"{psnr:.2f} / {relmse:.4f}" for psnr, relmse in theirs] if theirs else [""] * len(averages)
        body.append([title(method), *cells, *(shown if paper else ())])
    head = [f"{n} spp" for n in averages]
    return results.markdown(["", *head, *(f"paper, {n}" for n in head if paper)], body)


def runtimes(rows: list[Row]) -> str:
    """Seconds and MB for 1024 x 1024."""
    body = []
    for row in rows:
        name, _, scale = row["method"].rpartition("-x")
        if name == "paper" or "version" in row:
            theirs = [str(value) for value in RUNTIME[int(scale)]] if name == "paper" else ["", ""]
            body.append([title(row["method"]), f"{row['seconds']:.2f}", f"{row['peak_mb']:.0f}", *theirs])
    return results.markdown(["", "median s", "peak MB", "paper, s", "paper, MB"], body)


def grid(measured: Found) -> str:
    """PSNR by the spp of either render, with the paper's in brackets."""
    body = []
    for low, theirs in GRID.items():
        pairs = zip(HRLS_SPP, theirs, strict=True)
        body.append([f"{low} spp", *(f"{measured[low, high]['psnr']:.2f} ({paper:.2f})" for high, paper in pairs)])
    return results.markdown(["LRHS \\ HRLS", *(f"{high} spp" for high in HRLS_SPP)], body)


def super_resolution(ablated: Found) -> str:
    """Networks with and without an HRLS."""
    body = []
    for scale, theirs in SUPER_RESOLUTION.items():
        none, layers = _super_resolution(ablated, scale)
        cells = [none["bicubic_psnr"], none["psnr"], layers["psnr"], *theirs]
        body.append([f"x{scale}", *(f"{value:.2f}" for value in cells)])
    head = ["bicubic", "without an HRLS", "with all of its layers", "paper: bicubic", "EDSR or RCAN", "with"]
    return results.markdown(["", *head], body)


def _super_resolution(ablated: Found, scale: int) -> tuple[Row, Row]:
    """The network without an HRLS, and the one with all of its layers."""
    start = "" if scale == 4 else f"x{scale}, "
    return ablated[f"{start}HRLS: none"], ablated[f"{start}{ALL_LAYERS}"]


def _range_of(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def ablations(ablated: Found) -> Iterator[str]:
    """The paper's figures 9 and 10, as tables."""

    def one(title: str, names: dict[str, str]) -> str:
        body = [[shown, f"{ablated[n]['psnr']:.2f}", f"{ablated[n]['relmse']:.4f}"] for shown, n in names.items()]
        return results.markdown([title, "PSNR", "RelMSE"], body)

    added = {f"… {name}": f"HRLS: {name}" for name in ("and albedo", "and normal", "and diffuse, specular")}
    yield one("HRLS, beside an LRHS of RGB", {"none": "HRLS: none", "RGB": SAME, **added})
    low = {"none": "LRHS: none", "RGB": SAME, "all layers": "LRHS: and diffuse, specular"}
    yield one("LRHS, beside an HRLS of RGB", low)
    losses = [str(name) for name in ablated if "loss" in str(name) or "linear" in str(name)]
    yield one("loss", {"l1": SAME, **{name: name for name in losses}})


def claims(ablated: Found, rows: list[Row], measured: Found) -> str:
    """What the paper finds, and whether our figures agree: PSNR must rise from figure to figure, RelMSE must fall."""
    means = results.index((row for row in rows if row["scene"] == MEAN), "spp", "method")
    body = []

    def claim(text: str, rows: Sequence[Row]) -> None:
        psnr, relmse = ([row[measure] for row in rows if measure in row] for measure in ("psnr", "relmse"))
        agrees = [all(before < after for before, after in pairwise(psnr))]
        if relmse:
            agrees.append(all(before > after for before, after in pairwise(relmse)))
        verdict = "agrees" if all(agrees) else "PSNR and RelMSE disagree" if any(agrees) else "**differs**"
        shown = (", ".join(form.format(v) for v in values) for form, values in (("{:.2f}", psnr), ("{:.4f}", relmse)))
        body.append([text, *shown, verdict])

    def ablation(text: str, *names: str) -> None:
        claim(text, [ablated[name] for name in names])

    ablation("an HRLS beats super-resolution: none, RGB", "HRLS: none", SAME)
    ablation("its further layers help: RGB, all", SAME, ALL_LAYERS)
    ablation("the LRHS's do not: all, RGB", "LRHS: and diffuse, specular", SAME)
    robust = "robust loss of linear radiance, beta 0.1"
    ablation("the robust loss is better for linear radiance: l1, robust", "l1 of linear radiance", robust)
    for beta in ("0.01", "1"):
        ablation(f"its beta is best at 0.1: {beta}, 0.1", f"robust loss, beta {beta}", "robust loss, beta 0.1")
    for low in LRHS_SPP:
        claim(f"more spp in the HRLS is better, LRHS of {low}", [measured[low, high] for high in HRLS_SPP])
    for high in HRLS_SPP:
        claim(f"more spp in the LRHS is better, HRLS of {high}", [measured[low, high] for low in LRHS_SPP])
    claim("x4 is best at 2 spp: x2, x4", [means[2, "paper-x2"], means[2, "paper-x4"]])
    claim("x2 is best at 8 spp: x4, x2", [means[8, "paper-x4"], means[8, "paper-x2"]])
    return results.markdown(["the paper finds", "PSNR here", "RelMSE", ""], body)


PAGE = """\
# The paper's tables

Made by `python -m research.benchmarks.paper`. PSNR is of sRGB pictures, RelMSE has (0.5, 0.01). The paper's figures
are on its own data, which was never released, so its values and ours can't be compared. Nor can differences: an HRLS
gains {their_gains} dB in the paper, and {our_gains} dB here (table 5).

## Table 2: another renderer than `paper` was trained with

{cycles_scenes} procedural scenes of this project's generator for Cycles (`quality_cycles.csv`), beside the paper's
Blender scenes. `paper` was trained on views by Mitsuba.

{table2}
## Table 3: other people's scenes, the renderer of training, missing layers

Mitsuba 3 without variance, diffuse and specular (`quality.csv`). The paper's figures for Gharbi's data are not shown:
their PSNR is of linear values clamped to [0, 1], and their RelMSE has (1, 1e-4).

{table3}
## Table 4: time and memory for 1024 x 1024

{machine}; the paper's on a Titan Xp.

{table4}
## Table 5: against super-resolution

PSNR of reduced networks ({steps} steps, {train_views} views) on {held_out_views} held-out views: HRLS of 1 spp, LRHS
with 16 samples for every HRLS pixel.

{table5}
## Table 6: samples, `paper-x4`

PSNR on the scenes of table 3; in brackets the paper's.

{table6}
## Figures 9 and 10: layers and loss

The same reduced networks, x4.

{figures}
## What the paper finds

{claims}
Layers and losses are judged by one run for each, with one seed and {steps} steps. That is too little for a verdict.
The robust loss was made for linear radiance, whose few huge errors dominate l1. Our networks are trained on
log-encoded radiance, which has no such errors: there l1, or a large beta, has the better figures.
"""


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(page(), end="")


def page() -> str:
    """The whole page."""
    runtime, cycles, development = (results.read(name) for name in ("runtime", "quality_cycles", "quality"))
    ablated = results.index(results.read("ablations"), "name")
    measured = results.index(results.read("spp_grid"), "lrhs_spp", "hrls_spp")
    budget = ablated[SAME]
    their_gains = [ours - best for _, best, ours in SUPER_RESOLUTION.values()]
    our_gains = [layers["psnr"] - none["psnr"] for none, layers in (_super_resolution(ablated, s) for s in SCALES)]
    return PAGE.format(
        their_gains=_range_of(their_gains),
        our_gains=_range_of(our_gains),
        cycles_scenes=len({row["scene"] for row in cycles} - {MEAN}),
        table2=comparison(cycles, quality.AVERAGES, BCR),
        table3=comparison(development, quality.AVERAGES),
        machine=f"{runtime[0]['cores']} cores, {runtime[0]['machine']}",
        table4=runtimes(runtime),
        **{name: budget[name] for name in ("steps", "train_views", "held_out_views")},
        table5=super_resolution(ablated),
        table6=grid(measured),
        figures="\n".join(ablations(ablated)),
        claims=claims(ablated, development, measured),
    )


if __name__ == "__main__":
    main()
