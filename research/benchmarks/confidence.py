# SPDX-License-Identifier: Apache-2.0
"""Compare the error that a model predicts for its own result (`msspl-fuse --error-layer`) with the actual error.

    python -m research.benchmarks.confidence RENDERS --table research/benchmarks/results/confidence.csv

Both errors are in log-encoded radiance, which is close to sRGB. All pixels of the development scenes with a clean
reference are used, at every scale and at 2, 4 and 8 spp on average. Three figures say how good the prediction is: its
mean beside the mean actual error; the share of all error that lies in the tenth of the pixels with the largest
prediction; and the correlation of the logarithms of both over squares of 8 x 8 pixels. The noise of the references
counts as error.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.catalogue import find_model
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.session import Session
from research.benchmarks import results, scenes
from research.benchmarks.accuracy import AVERAGES
from research.benchmarks.results import Row

SQUARE = 8


def errors(scene: scenes.Scene, session: Session, spp: int) -> tuple[Array, Array]:
    """Return the predicted and the actual error of the fused frame, each (h, w, 1), in log-encoded radiance."""
    pair = scene.lrhs(session.contract.scale, spp // 2), scene.hrls(spp // 2)
    fused = fuse(*pair, session, error=True)
    assert fused.error is not None
    values, truth = (encode_radiance(image, fused.exposure) for image in (fused.rgb, scene.reference))
    middle = values.mean(axis=-1, keepdims=True)
    brighter = decode_radiance(middle, fused.exposure) + fused.error
    actual = np.abs(values - truth).mean(axis=-1, keepdims=True)
    return encode_radiance(brighter, fused.exposure) - middle, actual


def measure(model: str, pairs: list[tuple[Array, Array]]) -> Row:
    """Return the row of a model, from predicted and actual errors."""
    predicted, actual = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in range(2))
    worst = np.argsort(predicted)[-len(predicted) // 10 :]
    squares = [np.concatenate([box_downsample(pair[i], SQUARE).ravel() for pair in pairs]) for i in range(2)]
    return {
        "method": model,
        "model": model,
        "predicted": float(predicted.mean()),
        "actual": float(actual.mean()),
        "worst_tenth": float(actual[worst].sum() / actual.sum()),
        "correlation": float(np.corrcoef(*np.log(np.maximum(squares, 1e-4)))[0, 1]),
    }


def main() -> None:
    parser = results.parser(__doc__)
    parser.add_argument("folder", type=Path, help="renders or views")
    args = parser.parse_args()
    clean = [scene for scene in scenes.load(args.folder) if scene.name not in scenes.NOISY_REFERENCE]
    rows = []
    for scale in SCALES:
        session = Session(find_model(scale, "auto"))
        pairs = [errors(scene, session, spp) for scene in clean for spp in AVERAGES]
        rows.append(measure(session.contract.name, pairs))
    results.show(rows, args.table)


if __name__ == "__main__":
    main()
