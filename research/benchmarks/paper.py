# SPDX-License-Identifier: Apache-2.0
"""Compare what the paper finds with the figures of `research.benchmarks.accuracy` and `research.benchmarks.ablations`.

The paper's data was never published, so only the order of its values and ours can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from research.benchmarks import results
from research.benchmarks.results import MEAN, Row

#: The row of `research.benchmarks.ablations` that several findings need.
RGB = "both RGB, l1"
#: A finding -> rows of `research.benchmarks.ablations` from worse to better.
ABLATIONS = {
    "an HRLS beats super-resolution (table 5): none, RGB": ("HRLS: none", RGB),
    "further layers of the HRLS help: RGB, all": (RGB, "HRLS: and diffuse, specular"),
    "further layers of the LRHS do not help: all, RGB": ("LRHS: and diffuse, specular", RGB),
    "on linear radiance the robust loss is better: l1, robust": (
        "l1 of linear radiance",
        "robust loss of linear radiance, beta 0.1",
    ),
    "a beta of 0.1 is best for it: 1, 0.1": ("robust loss, beta 1", "robust loss, beta 0.1"),
}


def verdict(rows: Sequence[Row]) -> str:
    """Say whether rows get better from one to the next: PSNR must rise, and RelMSE must fall."""
    agrees = [all(before["psnr"] < after["psnr"] for before, after in pairwise(rows))]
    agrees.append(all(before["relmse"] > after["relmse"] for before, after in pairwise(rows)))
    return "agrees" if all(agrees) else "PSNR and RelMSE disagree" if any(agrees) else "**differs**"


def findings() -> str:
    """Lay out what the paper finds, and whether our figures agree."""
    ablated = results.index(results.read("ablations"), "name")
    means = results.index(results.where(results.read("accuracy"), scene=MEAN), "spp", "method")
    cases = {finding: [ablated[name] for name in names] for finding, names in ABLATIONS.items()}
    cases["x4 is best at 2 spp (table 2): x2, x4"] = [means[2, "paper-x2"], means[2, "paper-x4"]]
    cases["x2 is best at 8 spp (table 2): x4, x2"] = [means[8, "paper-x4"], means[8, "paper-x2"]]
    body = []
    for finding, rows in cases.items():
        relmse = ", ".join(f"{row['relmse']:.4f}" for row in rows)
        body.append([finding, ", ".join(f"{row['psnr']:.2f}" for row in rows), relmse, verdict(rows)])
    table = results.markdown(["the paper finds", "PSNR here", "RelMSE here", "our figures"], body)
    return f"{table}\n{results.stamp_note(row for rows in cases.values() for row in rows)}\n"
