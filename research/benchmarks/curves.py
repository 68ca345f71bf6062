# SPDX-License-Identifier: Apache-2.0
"""Draws the training logs of the shipped networks.

    python -m research.benchmarks.curves docs/images/training.png

There is a column for each log, `research/benchmarks/results/training_*.csv`. Runs that continued each other stand side
by side.
The upper row shows how much PSNR each run gained since its start: views, references and losses changed from run to run,
so absolute values cannot be compared.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

from research.benchmarks import results

Curve = tuple[list[float], list[float]]


def read(path: Path) -> dict[str, tuple[Curve, Curve]]:
    """For each run the gain in PSNR on held-out views and the training loss, against the minutes of the log."""
    runs: dict[str, tuple[Curve, Curve]] = {}
    before = 0.0
    for name, rows in itertools.groupby(results.read(path), key=lambda row: str(row.get("run", ""))):
        psnr, loss = runs.setdefault(name, (([], []), ([], [])))
        minutes, start = before, None
        for row in rows:
            minutes = before + row["minutes"]
            start = row["psnr"] if start is None else start
            psnr[0].append(minutes)
            psnr[1].append(row["psnr"] - start)
            if row["loss"]:  # there is none before the first step
                loss[0].append(minutes)
                loss[1].append(row["loss"])
        before = minutes
    return runs


def draw(logs: list[Path], picture: Path) -> None:
    """Draw PSNR above and loss below."""
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
    axes[0][0].set_ylabel("PSNR gained on held-out views, dB")
    axes[1][0].set_ylabel("training loss")
    figure.tight_layout()
    figure.savefig(picture, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("logs", type=Path, nargs="*", help="default: those of the networks that ship")
    args = parser.parse_args()
    draw(args.logs or sorted(results.FOLDER.glob("training_*.csv")), args.picture)


if __name__ == "__main__":
    main()
