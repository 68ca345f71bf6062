# SPDX-License-Identifier: Apache-2.0
"""Write the denoiser of both renders' mean in 8 bits, which :mod:`oiio_msspl.model.mean_denoiser` runs.

    python -m training.quantise VIEWS

Prints how close it is to the network in 32 bits.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import onnx
from onnx import helper

from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.mean_denoiser import WEIGHTS, MeanDenoiser
from oiio_msspl.model.render_mean import denoiser_images, mean_of_renders
from training.checkpoints import load
from training.data import fixed_batches
from training.joint import JointFusion
from training.oidn import provenance
from training.quantise.gptq import quantise_mean_denoiser
from training.quantise.graph import Graph

CHECKPOINT = Path(__file__).parents[1] / "checkpoints" / "joint.pt"
#: Calibration images, and their width.
IMAGES, PATCH = 96, 256


def pairs(views: Path, split: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Encoded LRHS and HRLS, from views as training draws them."""
    for batch in fixed_batches(views, split, SCALES, PATCH, 1):
        lrhs, hrls = (batch[key][0].permute(1, 2, 0).numpy() for key in ("lrhs", "hrls"))
        yield lrhs, hrls


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m training.quantise", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="of a joint network (default: the shipped)")
    args = parser.parse_args()
    joint, _ = load(args.checkpoint)
    if not isinstance(joint, JointFusion):
        raise SystemExit(f"{args.checkpoint}: not a joint network")
    exact, path = joint.mean_denoiser, WEIGHTS[joint.denoiser(SCALES[0])]
    drawn = islice(pairs(args.views, "train"), IMAGES)
    images = [mean_of_renders(lrhs, denoiser_images(hrls)) for lrhs, hrls in drawn]
    model = Graph(quantise_mean_denoiser(exact.start.shape, exact.weights(), images)).model()
    helper.set_model_props(model, {"provenance": json.dumps(provenance(exact.start.network))})
    onnx.save(model, path)
    network = MeanDenoiser(path=path)
    differences = []
    for lrhs, hrls in islice(pairs(args.views, "validation"), 24):
        expected = exact.denoise(mean_of_renders(lrhs, denoiser_images(hrls)))
        differences.append(np.abs(network(lrhs, hrls)[0][..., 3:] - expected).mean())
    print(f"mean difference of encoded values {np.mean(differences):.4f}, at most {np.max(differences):.4f}")


if __name__ == "__main__":
    main()
