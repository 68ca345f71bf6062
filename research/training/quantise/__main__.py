# SPDX-License-Identifier: Apache-2.0
"""Write a denoiser in 8 bits that is part of the models that ship: of both renders' mean, or of one render.

    python -m research.training.quantise VIEWS --checkpoint JOINT.pt --output mean_denoiser.onnx
    python -m research.training.quantise VIEWS --full-size --output full_size_denoiser.onnx

``--full-size`` is for Open Image Denoise's large network as it is, which denoises one render at full size. Prints how
close the result is to the network in 32 bits.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
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
from research.training.denoisers import FullSizeDenoiser, LayerDenoisers, mean_images
from research.training.encoding import log_decode, log_encode
from research.training.oidn import FineTunedUNet, provenance
from research.training.quantise.codes import OUTPUT_SLICES, denoiser_codes, full_size_codes, log_encoded_of_code
from research.training.quantise.gptq import quantise_denoiser
from research.training.quantise.graph import Graph
from research.training.quantise.layers import varied
from research.training.render_mean import with_mean
from research.training.whole_model import FULL_SIZE_DENOISER, denoiser_file

CHECKPOINT = CHECKPOINTS / "joint.pt"
#: Calibration images, and their width.
IMAGES, PATCH = 96, 256
#: Most samples of a calibration image of one render, as a multiple of those of the HRLS that training draws.
CLEANER = 64.0

Images = tuple[Tensor, ...]


def means(views: Path, split: str, count: int) -> Iterator[Images]:
    """Yield the inputs of the denoiser of both renders' mean, from views as training draws them."""
    for batch in islice(Batches(views, SCALES, PATCH, 1, with_mean, split=split), count):
        yield mean_images(batch["lrhs"], batch["hrls"])


def single_renders(views: Path, split: str, count: int) -> Iterator[Images]:
    """Yield the inputs of the denoiser of one render: HRLS as training draws them, and cleaner ones.

    A reference has no noise. So the weighted mean of both is a render with up to ``CLEANER`` times the samples.
    """
    layers, generator = LayerDenoisers(), torch.Generator().manual_seed(0)
    batches = list(islice(Batches(views, SCALES, PATCH, 1, split=split), count))
    for batch, hrls in zip(batches, varied([batch["hrls"] for batch in batches]), strict=True):
        share = CLEANER ** (-0.5 * torch.rand((), generator=generator))
        radiance = torch.lerp(log_decode(batch["target"]), log_decode(hrls[:, :3]), share)
        with torch.no_grad():
            yield log_encode(radiance), *layers(hrls[:, 3:6].clamp(0, 1), hrls[:, 6:9])


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--full-size", action="store_true", help="the denoiser of one render")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="of a joint network (default: the shipped)")
    parser.add_argument("-o", "--output", type=Path, help="file to write (default: the shipped)")
    args = parser.parse_args()
    exact: FineTunedUNet | None
    images: Callable[[Path, str, int], Iterator[Images]]
    codes: Callable[..., Tensor]
    if args.full_size:
        exact, shipped, images = FullSizeDenoiser(), FULL_SIZE_DENOISER, single_renders
        codes = full_size_codes
    else:
        joint, _ = load_joint(args.checkpoint)
        exact, images = joint.mean_denoiser, means
        shipped = CHECKPOINTS / f"{denoiser_file(joint.denoiser(SCALES[0]))}.onnx"
        codes = denoiser_codes
    if exact is None:
        raise SystemExit(f"{args.checkpoint}: the size large has no denoiser of both renders' mean of its own")
    calibration = [codes(*inputs) for inputs in images(args.views, "train", IMAGES)]
    fit = quantise_denoiser(exact.shape, exact.weights(), calibration, full_size=args.full_size)
    model, path = Graph(fit).model(), args.output or shipped
    helper.set_model_props(model, {"provenance": json.dumps(provenance(exact.network))})
    onnx.save(model, path)
    differences = []
    for inputs in images(args.views, "validation", 24):
        with torch.inference_mode():
            expected = exact(*inputs)[0].permute(1, 2, 0).numpy()
        differences.append(np.abs(run_denoiser(path, codes(*inputs)) - expected).mean())
    print(f"mean difference of encoded values {np.mean(differences):.4f}, at most {np.max(differences):.4f}")


def run_denoiser(path: Path, codes: Tensor) -> np.ndarray:
    """Run a quantised denoiser on codes of :mod:`research.training.quantise.codes`: log-encoded (h, w, 3)."""
    layers = codes.permute(0, 2, 3, 1).to(torch.uint8).contiguous().numpy()
    (sums,) = load_network(path).run(["codes"], {"layers": layers})
    return log_encoded_of_code(OUTPUT_SLICES)[sums[0]]


if __name__ == "__main__":
    main()
