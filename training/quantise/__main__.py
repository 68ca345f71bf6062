# SPDX-License-Identifier: Apache-2.0
"""Write Open Image Denoise's networks in 8 bits, which :mod:`oiio_msspl.model.quantised` runs.

    python -m training.quantise VIEWS

Writes ``oiio_msspl/model/weights/denoisers/NAME.onnx`` for each network, and prints how close it is to the network in
32 bits.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import onnx

from oiio_msspl.arrays import box_downsample
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.oidn import OidnDenoiser
from oiio_msspl.model.oidn_weights import require_weights
from oiio_msspl.model.quantised import NETWORK_IMAGES, WEIGHTS, QuantisedDenoiser
from oiio_msspl.model.render_mean import Images, denoiser_images, mean_of_renders
from training.checkpoints import load_mean_denoiser
from training.data import fixed_batches
from training.mean_denoiser import MeanDenoiser
from training.oidn import BASE_ALBEDO, BASE_HDR, LARGE_HDR, pretrained_weights
from training.quantise.gptq import MEAN_DENOISER, SHAPES, quantise
from training.quantise.graph import Graph

CHECKPOINT = Path(__file__).parents[1] / "checkpoints" / "joint.pt"
#: Calibration images, and their width.
IMAGES, PATCH = 96, 256
#: Consecutive images without the necessary AOVs after which the command gives up.
PATIENCE = 200


def network_inputs(views: Path, split: str, name: str) -> Iterator[Images]:
    """Inputs of a network, from views as training draws them; images without the necessary AOVs are left out."""
    denoiser, rng = OidnDenoiser(exact=True), np.random.default_rng(0)
    scales = [2] if name == BASE_ALBEDO else SCALES
    left_out = 0
    for batch in fixed_batches(views, split, scales, PATCH, 1, rng=rng):
        lrhs, hrls = (batch[key][0].permute(1, 2, 0).numpy() for key in ("lrhs", "hrls"))
        layers = denoiser_images(hrls)
        if name == MEAN_DENOISER:
            layers = mean_of_renders(lrhs, denoiser_images(hrls, complete=True))
        elif name == LARGE_HDR:
            layers = denoiser.clean_mean(lrhs, layers)
        elif name == BASE_ALBEDO and "albedo" in layers:
            albedo = box_downsample(layers["albedo"], scales[0])
            # Depth of field, hair and glass make an albedo noisier than it is in these views
            noise = rng.normal(0, rng.choice([0, 0, 0.1, 0.3]), albedo.shape)
            layers = {"albedo": (albedo + noise).clip(0, 1).astype(np.float32)}
        if layers.keys() == NETWORK_IMAGES[name]:
            left_out = 0
            yield layers
        elif (left_out := left_out + 1) > PATIENCE:
            raise SystemExit(f"{views}: too few {split} views have an albedo and a normal, which {name} reads")


def compare(name: str, network: QuantisedDenoiser, views: Path, mean_denoiser: MeanDenoiser) -> None:
    """Print the difference of a network in 8 bits from the same network in 32 bits, on validation views."""
    exact = OidnDenoiser(exact=True)
    peers = {
        BASE_HDR: exact.hrls,
        LARGE_HDR: exact.mean,
        BASE_ALBEDO: exact.albedo,
        MEAN_DENOISER: mean_denoiser.denoise,
    }
    images = islice(network_inputs(views, "validation", name), 24)
    differences = [np.abs(network(**layers) - peers[name](layers)).mean() for layers in images]
    print(f"{name}: mean difference of encoded values {np.mean(differences):.4f}, at most {np.max(differences):.4f}")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m training.quantise", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--networks", nargs="+", choices=SHAPES, default=list(SHAPES), help="(default: all)")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help=f"of a joint network, for {MEAN_DENOISER}")
    args = parser.parse_args()
    mean_denoiser = load_mean_denoiser(args.checkpoint)
    for name in args.networks:
        original = LARGE_HDR if name == MEAN_DENOISER else name
        pretrained = pretrained_weights(original)
        weights = mean_denoiser.weights() if name == MEAN_DENOISER else pretrained
        images = list(islice(network_inputs(args.views, "train", name), IMAGES))
        onnx.save(Graph(quantise(name, weights, pretrained, images)).model(), WEIGHTS / f"{name}.onnx")
        compare(name, QuantisedDenoiser(name, require_weights(original)), args.views, mean_denoiser)


if __name__ == "__main__":
    main()
