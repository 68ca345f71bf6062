# SPDX-License-Identifier: Apache-2.0
"""Is the predicted error (`msspl-fuse --error-layer`) that of the result?

    python -m benchmarks.confidence ../shared/renders --model mix --json results/confidence.json \
        --picture docs/images/confidence.png

Pixels of all scenes of :mod:`benchmarks.scenes` whose reference is clean, at every scale and 2, 4 and 8 average spp,
are sorted by their predicted error into bins of equal number. Printed: the mean of prediction and actual error, in
network values (about those of the sRGB picture); how much of all error lies in the tenth of the pixels with the largest
prediction; and how the two correlate over squares of 8 x 8 pixels. The references' own noise counts as error.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import scenes
from benchmarks.quality import AVERAGES
from oiio_msspl import fuse, transforms
from oiio_msspl.render import Array
from oiio_msspl.schema import SCALES
from oiio_msspl.session import Session, find_model

BINS, SQUARE = 20, 8


def errors(scene: scenes.Scene, session: Session, spp: int) -> tuple[Array, Array]:
    """Predicted and actual error of the fused frame (H, W, 1), in network values."""
    pair = scene.lrhs(session.contract.scale, spp // 2), scene.hrls(spp // 2)
    fused = fuse(*pair, session, error=True)
    assert fused.error is not None
    values, truth = (transforms.compress(image, fused.exposure) for image in (fused.rgb, scene.reference))
    middle = values.mean(axis=-1, keepdims=True)
    brighter = transforms.expand(middle, fused.exposure) + fused.error
    actual = np.abs(values - truth).mean(axis=-1, keepdims=True)
    return transforms.compress(brighter, fused.exposure) - middle, actual


def measure(pairs: list[tuple[Array, Array]]) -> dict[str, Any]:
    """What is printed, of predictions and actual errors."""
    predicted, actual = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in range(2))
    order = np.argsort(predicted)
    bins = [(float(predicted[part].mean()), float(actual[part].mean())) for part in np.array_split(order, BINS)]
    worst = order[-len(order) // 10 :]
    squares = [
        np.concatenate([transforms.box_downsample(_cropped(pair[i]), SQUARE).ravel() for pair in pairs])
        for i in range(2)
    ]
    return {
        "bins": bins,
        "share_of_worst_tenth": float(actual[worst].sum() / actual.sum()),
        "correlation": float(np.corrcoef(*np.log(np.maximum(squares, 1e-4)))[0, 1]),
        "mean": (float(predicted.mean()), float(actual.mean())),
    }


def _cropped(image: Array) -> Array:
    height, width = (n // SQUARE * SQUARE for n in image.shape[:2])
    return image[:height, :width]


def print_table(results: dict[str, dict[str, Any]]) -> None:
    """A line a model."""
    print("| model | predicted | actual | error in the worst tenth | correlation |\n|---|---|---|---|---|")
    for name, result in results.items():
        predicted, actual = result["mean"]
        print(
            f"| {name} | {predicted:.4f} | {actual:.4f} | {result['share_of_worst_tenth']:.0%} | "
            f"{result['correlation']:.2f} |"
        )


def draw(results: dict[str, dict[str, Any]], path: Path) -> None:
    """Predicted against actual error, a line a scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(5, 4.6))
    for name, result in results.items():
        axis.loglog(*zip(*result["bins"], strict=True), "-o", markersize=3, label=name)
    ends = [min(min(r["bins"][0]) for r in results.values()), max(max(r["bins"][-1]) for r in results.values())]
    axis.plot(ends, ends, color="grey", linewidth=1, label="as predicted")
    axis.set_xlabel("predicted error")
    axis.set_ylabel("actual error")
    axis.grid(True, which="both", alpha=0.25)
    axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="renders or views")
    parser.add_argument("--model", default="auto", help="a family of models")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    clean = [scene for scene in scenes.load(args.folder) if scene.name not in scenes.NOISY_REFERENCE]
    results = {}
    for scale in SCALES:
        session = Session(find_model(scale, args.model))
        pairs = [errors(scene, session, spp) for scene in clean for spp in AVERAGES]
        results[session.contract.name] = measure(pairs)
    print_table(results)
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")
    if args.picture:
        draw(results, args.picture)


if __name__ == "__main__":
    main()
