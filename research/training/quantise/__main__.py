# SPDX-License-Identifier: Apache-2.0
"""Write the denoiser of both renders' mean in 8 bits, which is part of the models that ship.

    python -m research.training.quantise VIEWS --checkpoint JOINT.pt --output mean_denoiser.onnx

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
import torch
from onnx import helper
from torch import Tensor

from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.runtime import load_network
from research.training import CHECKPOINTS
from research.training.checkpoints import load_joint
from research.training.data import Batches
from research.training.denoisers import mean_images
from research.training.oidn import provenance
from research.training.quantise.codes import OUTPUT_SLICES, denoiser_codes, log_encoded_of_code
from research.training.quantise.gptq import quantise_mean_denoiser
from research.training.quantise.graph import Graph
from research.training.render_mean import with_mean
from research.training.whole_model import denoiser_file

CHECKPOINT = CHECKPOINTS / "joint.pt"
#: Calibration images, and their width.
IMAGES, PATCH = 96, 256


def means(views: Path, split: str) -> Iterator[tuple[Tensor, ...]]:
    """Yield the inputs of the denoiser of both renders' mean, from views as training draws them."""
    for batch in Batches(views, SCALES, PATCH, 1, with_mean, split=split):
        yield mean_images(batch["lrhs"], batch["hrls"])


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="of a joint network (default: the shipped)")
    parser.add_argument("-o", "--output", type=Path, help="file to write (default: the shipped)")
    args = parser.parse_args()
    joint, _ = load_joint(args.checkpoint)
    exact, path = joint.mean_denoiser, args.output or CHECKPOINTS / f"{denoiser_file(joint.denoiser(SCALES[0]))}.onnx"
    if exact is None:
        raise SystemExit(f"{args.checkpoint}: the size large has no denoiser of both renders' mean of its own")
    codes = [denoiser_codes(*images) for images in islice(means(args.views, "train"), IMAGES)]
    model = Graph(quantise_mean_denoiser(exact.shape, exact.weights(), codes)).model()
    helper.set_model_props(model, {"provenance": json.dumps(provenance(exact.network))})
    onnx.save(model, path)
    differences = []
    for images in islice(means(args.views, "validation"), 24):
        with torch.inference_mode():
            expected = exact(*images)[0].permute(1, 2, 0).numpy()
        differences.append(np.abs(run_denoiser(path, denoiser_codes(*images)) - expected).mean())
    print(f"mean difference of encoded values {np.mean(differences):.4f}, at most {np.max(differences):.4f}")


def run_denoiser(path: Path, codes: Tensor) -> np.ndarray:
    """Run a quantised denoiser on :func:`research.training.quantise.codes.denoiser_codes`: log-encoded (h, w, 3)."""
    layers = codes.permute(0, 2, 3, 1).to(torch.uint8).contiguous().numpy()
    (sums,) = load_network(path).run(["codes"], {"layers": layers})
    return log_encoded_of_code(OUTPUT_SLICES)[sums[0]]


if __name__ == "__main__":
    main()
