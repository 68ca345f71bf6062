# SPDX-License-Identifier: Apache-2.0
"""Print what the paper finds, and our figures beside the paper's own.

    python -m research.benchmarks.paper

The figures come from `research.benchmarks.accuracy`, `research.benchmarks.runtime`, `research.benchmarks.sample_counts`
and `research.benchmarks.ablations`. The paper's data was never published, so its values and ours can't be compared.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise

from research.benchmarks import results
from research.benchmarks.results import MEAN, Row
from research.benchmarks.sample_counts import HRLS_SPP, LRHS_SPP

#: (PSNR, RelMSE) on the paper's BCR data set at 2, 4 and 8 spp on average (its table 2).
BCR = {
    "full resolution": ((18.12, 0.2953), (21.51, 0.1400), (24.75, 0.0646)),
    "paper-x2": ((33.27, 0.0044), (35.15, 0.0027), (36.74, 0.0019)),
    "paper-x4": ((33.94, 0.0039), (35.21, 0.0028), (36.31, 0.0022)),
    "paper-x8": ((31.37, 0.0075), (32.35, 0.0057), (33.14, 0.0049)),
}
#: Scale -> PSNR of the better of EDSR and RCAN, and of the paper's method (its table 5).
SUPER_RESOLUTION = {2: (32.03, 38.40), 4: (30.73, 34.27), 8: (27.97, 31.08)}
#: spp of the LRHS -> PSNR at x4 for an HRLS of 1, 2 and 4 spp (its table 6).
GRID = {16: (33.94, 34.88, 35.71), 32: (34.22, 35.21, 36.06), 64: (34.42, 35.44, 36.31)}
#: The rows of `research.benchmarks.ablations` that several findings need.
RGB, ALL_LAYERS = "both RGB, l1", "HRLS: and diffuse, specular"
#: A finding -> rows of `research.benchmarks.ablations` from worse to better.
ABLATIONS = {
    "an HRLS beats super-resolution (table 5): none, RGB": ("HRLS: none", RGB),
    "further layers of the HRLS help: RGB, all": (RGB, ALL_LAYERS),
    "further layers of the LRHS do not help: all, RGB": ("LRHS: and diffuse, specular", RGB),
    "on linear radiance the robust loss is better: l1, robust": (
        "l1 of linear radiance",
        "robust loss of linear radiance, beta 0.1",
    ),
    "a beta of 0.1 is best for it: 1, 0.1": ("robust loss, beta 1", "robust loss, beta 0.1"),
}


def verdict(rows: Sequence[Row]) -> str:
    """Say whether rows get better from one to the next: PSNR must rise, and RelMSE must fall where it was measured."""
    agrees = [all(before["psnr"] < after["psnr"] for before, after in pairwise(rows))]
    if all("relmse" in row for row in rows):
        agrees.append(all(before["relmse"] > after["relmse"] for before, after in pairwise(rows)))
    return "agrees" if all(agrees) else "PSNR and RelMSE disagree" if any(agrees) else "**differs**"


def findings() -> str:
    """Lay out what the paper finds, and whether our figures agree."""
    ablated = results.index(results.read("ablations"), "name")
    grid = results.index(results.read("sample_counts"), "lrhs_spp", "hrls_spp")
    means = results.index(results.where(results.read("accuracy"), scene=MEAN), "spp", "method")
    cases = {finding: [ablated[name] for name in names] for finding, names in ABLATIONS.items()}
    low, high = LRHS_SPP[0], HRLS_SPP[0]
    cases["more spp in the HRLS are better (table 6)"] = [grid[low, spp] for spp in HRLS_SPP]
    cases["more spp in the LRHS are better (table 6)"] = [grid[spp, high] for spp in LRHS_SPP]
    cases["x4 is best at 2 spp (table 2): x2, x4"] = [means[2, "paper-x2"], means[2, "paper-x4"]]
    cases["x2 is best at 8 spp (table 2): x4, x2"] = [means[8, "paper-x4"], means[8, "paper-x2"]]
    body = []
    for finding, rows in cases.items():
        relmse = ", ".join(f"{row['relmse']:.4f}" for row in rows if "relmse" in row)
        body.append([finding, ", ".join(f"{row['psnr']:.2f}" for row in rows), relmse, verdict(rows)])
    table = results.markdown(["the paper finds", "PSNR here", "RelMSE here", "our figures"], body)
    return f"{table}\n{results.stamp_note(row for rows in cases.values() for row in rows)}\n"


def table_2() -> str:
    """Lay out PSNR and RelMSE by average spp on views by Cycles, and the paper's on its data."""
    means = results.index(results.where(results.read("accuracy_cycles"), scene=MEAN), "spp", "method")
    body = []
    for method, theirs in BCR.items():
        ours = [f"{means[spp, method]['psnr']:.2f} / {means[spp, method]['relmse']:.4f}" for spp in (2, 4, 8)]
        body.append([method, *ours, *(f"{psnr:.2f} / {relmse:.4f}" for psnr, relmse in theirs)])
    return results.markdown(["PSNR / RelMSE", *(f"{w}, {n} spp" for w in ("here", "paper") for n in (2, 4, 8))], body)


def table_5() -> str:
    """Lay out PSNR of reduced networks without and with an HRLS, and the paper's."""
    ablated = results.index(results.read("ablations"), "name")
    body = []
    for scale, theirs in SUPER_RESOLUTION.items():
        start = "" if scale == 4 else f"x{scale}, "
        ours = [ablated[f"{start}HRLS: none"], ablated[f"{start}{ALL_LAYERS}"]]
        body.append([f"x{scale}", *(f"{row['psnr']:.2f}" for row in ours), *(f"{psnr:.2f}" for psnr in theirs)])
    return results.markdown(["PSNR", "without an HRLS", "with it", "paper: EDSR or RCAN", "with an HRLS"], body)


def table_6() -> str:
    """Lay out PSNR by the spp of either render, with the paper's in brackets."""
    grid = results.index(results.read("sample_counts"), "lrhs_spp", "hrls_spp")
    body = []
    for low, theirs in GRID.items():
        pairs = zip(HRLS_SPP, theirs, strict=True)
        body.append([f"{low} spp", *(f"{grid[low, high]['psnr']:.2f} ({paper:.2f})" for high, paper in pairs)])
    return results.markdown(["LRHS \\ HRLS", *(f"{high} spp" for high in HRLS_SPP)], body)


def page() -> str:
    """Return all tables."""
    tables = {"What the paper finds": findings, "Table 2": table_2, "Table 5": table_5, "Table 6, paper-x4": table_6}
    return "\n".join(f"## {title}\n\n{table()}" for title, table in tables.items())


def main() -> None:
    """Print all tables."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(page(), end="")


if __name__ == "__main__":
    main()
