# SPDX-License-Identifier: Apache-2.0
"""Compares the error that a model predicts for its own result (`msspl-fuse --error-layer`) with the actual error.

    python -m research.benchmarks.confidence RENDERS --table research/benchmarks/results/confidence.csv
    python -m research.benchmarks.confidence --picture docs/images/confidence.png        # draws the table

Both errors are in log-encoded radiance, which is close to sRGB. All pixels of the development scenes with a clean
reference are used, at every scale and at 2, 4 and 8 spp on average. They are sorted by their predicted error into bins
of equal size. Three figures say how good the prediction is: its mean beside the mean actual error; the share of all
error that lies in the tenth of the pixels with the largest prediction; and the correlation of the logarithms of both
over squares of 8 x 8 pixels. The noise of the references counts as error.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oiio_msspl import fuse
from oiio_msspl.image.arrays import Array, box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.session import Session
from research.benchmarks import results, scenes
from research.benchmarks.accuracy import AVERAGES
from research.benchmarks.results import Row

#: In the column `bin`: all pixels. Bins have the numbers 1 to `BINS`.
ALL, BINS = 0, 20
SQUARE = 8


def errors(scene: scenes.Scene, session: Session, spp: int) -> tuple[Array, Array]:
    """Predicted and actual error of the fused frame, each (h, w, 1), in log-encoded radiance."""
    pair = scene.lrhs(session.contract.scale, spp // 2), scene.hrls(spp // 2)
    fused = fuse(*pair, session, error=True)
    assert fused.error is not None
    values, truth = (encode_radiance(image, fused.exposure) for image in (fused.rgb, scene.reference))
    middle = values.mean(axis=-1, keepdims=True)
    brighter = decode_radiance(middle, fused.exposure) + fused.error
    actual = np.abs(values - truth).mean(axis=-1, keepdims=True)
    return encode_radiance(brighter, fused.exposure) - middle, actual


def measure(model: str, pairs: list[tuple[Array, Array]]) -> list[Row]:
    """A row for all pixels and one for each bin, from predicted and actual errors."""
    predicted, actual = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in range(2))
    order = np.argsort(predicted)
    worst = order[-len(order) // 10 :]
    squares = [np.concatenate([box_downsample(_cropped(pair[i]), SQUARE).ravel() for pair in pairs]) for i in range(2)]
    quality = {
        "worst_tenth": float(actual[worst].sum() / actual.sum()),
        "correlation": float(np.corrcoef(*np.log(np.maximum(squares, 1e-4)))[0, 1]),
    }

    def means(number: int, pixels: NDArray[np.intp]) -> Row:
        errors = {"predicted": float(predicted[pixels].mean()), "actual": float(actual[pixels].mean())}
        return {"method": model, "bin": number, **errors}

    bins = [means(number, pixels) for number, pixels in enumerate(np.array_split(order, BINS), 1)]
    return [means(ALL, order) | quality, *bins]


def _cropped(image: Array) -> Array:
    height, width = (n // SQUARE * SQUARE for n in image.shape[:2])
    return image[:height, :width]


def layout(rows: list[Row]) -> str:
    """A line for each model."""
    body = [
        [
            f"`{row['method']}`",
            f"{row['predicted']:.4f}",
            f"{row['actual']:.4f}",
            f"{row['worst_tenth']:.0%}",
            f"{row['correlation']:.2f}",
        ]
        for row in rows
        if row["bin"] == ALL
    ]
    return results.markdown(["model", "predicted", "actual", "error in the worst tenth", "correlation"], body)


def draw(rows: list[Row], path: Path) -> None:
    """Actual against predicted error, a line for each model."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(5, 4.6))
    bins = [row for row in rows if row["bin"] != ALL]
    for model in dict.fromkeys(row["method"] for row in bins):
        errors = [(row["predicted"], row["actual"]) for row in bins if row["method"] == model]
        axis.loglog(*zip(*errors, strict=True), "-o", markersize=3, label=model)
    values = [row[error] for row in bins for error in ("predicted", "actual")]
    ends = [min(values), max(values)]
    axis.plot(ends, ends, color="grey", linewidth=1, label="as predicted")
    axis.set_xlabel("predicted error")
    axis.set_ylabel("actual error")
    axis.grid(True, which="both", alpha=0.25)
    axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="renders or views; without it nothing is measured")
    parser.add_argument("--model", default="auto", help="a family of models")
    parser.add_argument("--picture", type=Path, help="draw a PNG")
    results.add_option(parser)
    args = parser.parse_args()
    rows: list[Row] = []
    if args.folder:
        clean = [scene for scene in scenes.load(args.folder) if scene.name not in scenes.NOISY_REFERENCE]
        for scale in SCALES:
            session = Session(find_model(scale, args.model))
            pairs = [errors(scene, session, spp) for scene in clean for spp in AVERAGES]
            rows += measure(session.contract.name, pairs)
        if args.table:
            results.write(args.table, rows)
    else:
        rows = results.read(args.table or "confidence")
    print(layout(rows))
    if args.picture:
        draw(rows, args.picture)


if __name__ == "__main__":
    main()
