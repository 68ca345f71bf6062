# SPDX-License-Identifier: Apache-2.0
"""The logs of the networks that ship, as curves.

    python -m benchmarks.curves docs/images/training.png

A column a log, `benchmarks/results/training_*.csv`; runs that went on from one another stand side by side. What they
gained is PSNR since each began: from run to run views, references and losses changed, and with them every figure.
"""

from __future__ import annotations

import argparse
import csv
import itertools
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
Curve = tuple[list[float], list[float]]


def read(path: Path) -> dict[str, tuple[Curve, Curve]]:
    """Of every run: gain in PSNR on held-out views, and training loss, by minutes of the log."""
    runs: dict[str, tuple[Curve, Curve]] = {}
    before = 0.0
    with path.open(newline="") as file:
        for name, rows in itertools.groupby(csv.DictReader(file), key=lambda row: row.get("run", "")):
            psnr, loss = runs.setdefault(name, (([], []), ([], [])))
            minutes, start = before, None
            for row in rows:
                minutes = before + float(row["minutes"])
                start = float(row["psnr"]) if start is None else start
                psnr[0].append(minutes)
                psnr[1].append(float(row["psnr"]) - start)
                if float(row["loss"]):  # none yet before the first step
                    loss[0].append(minutes)
                    loss[1].append(float(row["loss"]))
            before = minutes
    return runs


def draw(logs: list[Path], picture: Path) -> None:
    """PSNR above, loss below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(logs), figsize=(2.9 * len(logs), 5), sharex="col", squeeze=False)
    for (upper, lower), path in zip(axes.T, logs, strict=True):
        for name, (psnr, loss) in read(path).items():
            upper.plot(*psnr, "-o", markersize=2)
            lower.plot(*loss, "-o", markersize=2, label=name or None)
        upper.set_title(path.stem.removeprefix("training_"), fontsize=10)
        lower.set_xlabel("minutes")
        for axis in (upper, lower):
            axis.grid(alpha=0.25)
            axis.tick_params(labelsize=8)
        if lower.get_legend_handles_labels()[1]:
            lower.legend(fontsize=6, ncol=2)
    axes[0][0].set_ylabel("gained on held-out views, dB")
    axes[1][0].set_ylabel("training loss")
    figure.tight_layout()
    figure.savefig(picture, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("logs", type=Path, nargs="*", help="default: those of the networks that ship")
    args = parser.parse_args()
    draw(args.logs or sorted(RESULTS.glob("training_*.csv")), args.picture)


if __name__ == "__main__":
    main()
