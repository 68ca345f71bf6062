# SPDX-License-Identifier: Apache-2.0
"""Export a joint network for GPUs: convolutions in half floats, the rest in float32.

    python -m research.training.gpu research/training/checkpoints/joint.pt oiio_msspl/model/weights/joint-x*.onnx
    python -m research.training.gpu research/training/checkpoints/joint_small.pt
    oiio_msspl/model/weights/joint-small-x*.onnx

The arguments are a checkpoint and the files for CPUs that were exported from it. Each file for GPUs lies in the folder
`gpu` beside the one for CPUs and has the same contract, so every device cuts a frame into the same tiles. The denoiser
of both renders' mean is in it, too.

The log curve stays in float32, because half floats overflow in it. Weights are stored as 8-bit codes with a scale for
each 3 x 3 kernel, and become half floats when the file is loaded. The networks of all scales have the same weights,
which :mod:`research.training.share` then stores once.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from oiio_msspl.model.contract import Contract
from oiio_msspl.model.devices import GPU_FOLDER
from research.training.checkpoints import load_joint
from research.training.denoisers import ALIGNMENT, MeanDenoiser
from research.training.export import denoiser_for
from research.training.joint import JointFusion
from research.training.oidn import FineTunedUNet
from research.training.tracing import network_example, prepend, traced
from research.training.whole_model import SMALL, whole_model

#: Inputs of the denoiser of both renders' mean, see :func:`research.training.render_mean.mean_of_renders`.
MEAN_CHANNELS = {"colour": 3, "noise": 1, "albedo": 3, "normal": 3}
#: What is added to the provenance of a file.
PRECISION = {"precision": "convolutions in half floats, their weights stored in 8 bits with a scale for each kernel"}


class Fuse(nn.Module):
    """A joint network as a module for the exporter. The denoised albedo and normal of ``large`` are in [0, 1]."""

    def __init__(self, network: JointFusion) -> None:
        super().__init__()
        self.network = network

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, ...]:
        """Return the fused image, the logarithm of its expected error, and what the size ``large`` denoises."""
        prepared = self.network.prepared(hrls)
        fused = self.network.fuse_prepared(lrhs, prepared)
        return fused if self.network.layers is None else (*fused, prepared[:, 3:6], 0.5 * prepared[:, 6:9] + 0.5)


P = TypeVar("P", JointFusion, FineTunedUNet, MeanDenoiser)


def in_half_floats(network: P) -> P:
    """Return a copy whose convolutions compute in half floats, with one weight and one bias each."""
    network = copy.deepcopy(network)
    network.convs = nn.ModuleDict({name: conv.merged() for name, conv in network.convs.items()}).half()
    return network.eval()


def joint_in_half_floats(network: JointFusion) -> JointFusion:
    """Return a copy of a `joint` network whose convolutions and heads compute in half floats."""
    network = in_half_floats(network)
    network.heads.half()
    network.error.half()
    if network.layers is not None:
        network.layers.albedo = in_half_floats(network.layers.albedo)
        network.layers.normal = in_half_floats(network.layers.normal)
    return network


@torch.inference_mode()
def to_onnx(network: JointFusion, contract: Contract, denoiser: MeanDenoiser) -> onnx.ModelProto:
    """Return the whole model of a network in half floats, with a denoiser in half floats."""
    inputs = network_example(network, contract.scale, contract.alignment)
    outputs = ["fused", "log_error", *(["albedo", "normal"] if network.layers is not None else [])]
    graph = traced(Fuse(network), inputs, ["lrhs", "hrls"], outputs, contract.alignment)
    _store_kernels_in_8_bits(graph.graph)
    contract = replace(contract, provenance=contract.provenance | PRECISION)
    model = whole_model(graph, contract, denoiser_graph(denoiser, MEAN_CHANNELS))
    onnx.checker.check_model(model, full_check=True)
    return model


def denoiser_graph(network: FineTunedUNet, channels: Mapping[str, int]) -> onnx.ModelProto:
    """Export a denoiser, whose inputs are images with these names and numbers of channels."""
    images = tuple(torch.rand(1, count, 4 * ALIGNMENT, 6 * ALIGNMENT) for count in channels.values())
    model = traced(network, images, list(channels), ["denoised"], ALIGNMENT)
    _store_kernels_in_8_bits(model.graph)
    return model


def _store_kernels_in_8_bits(graph: onnx.GraphProto) -> None:
    """Replace the weights of convolutions by the product of codes and scales, which is folded when a file is loaded.

    One scale for each output would cost 0.5 dB. The rounding error of each weight is added to the next one of the same
    kernel (error diffusion), so that their sum stays right: rounding each to nearest costs up to 0.14 dB.
    """
    products = []
    for tensor in list(graph.initializer):
        if tensor.data_type != TensorProto.FLOAT16 or len(tensor.dims) != 4 or len(tensor.raw_data) < SMALL:
            continue
        name, weights = tensor.name, numpy_helper.to_array(tensor).astype(np.float32)
        scales = (np.abs(weights).max(axis=(2, 3), keepdims=True) / 127).astype(np.float16)
        wanted = (weights / np.maximum(scales.astype(np.float32), 1e-12)).reshape(*weights.shape[:2], -1)
        codes, error = np.empty(wanted.shape, np.int8), np.zeros(weights.shape[:2], np.float32)
        for i in range(wanted.shape[2]):
            codes[..., i] = np.round(wanted[..., i] + error).clip(-127, 127)
            error += wanted[..., i] - codes[..., i]
        codes = codes.reshape(weights.shape)
        tensor.CopyFrom(numpy_helper.from_array(codes, f"{name}.codes"))
        graph.initializer.append(numpy_helper.from_array(scales, f"{name}.scales"))
        # ONNX Runtime has no product of half floats on the CPU, where it folds constants
        products += [
            helper.make_node("Cast", [f"{name}.codes"], [f"{name}.codes.float"], to=TensorProto.FLOAT),
            helper.make_node("Cast", [f"{name}.scales"], [f"{name}.scales.float"], to=TensorProto.FLOAT),
            helper.make_node("Mul", [f"{name}.codes.float", f"{name}.scales.float"], [f"{name}.float"]),
            helper.make_node("Cast", [f"{name}.float"], [name], to=TensorProto.FLOAT16),
        ]
    prepend(graph, products)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("models", type=Path, nargs="+", help="the network's files for CPUs, one for each scale")
    args = parser.parse_args()
    network, _ = load_joint(args.checkpoint)
    modes = {Contract.of_file(path).denoiser for path in args.models}
    denoisers = {mode: in_half_floats(denoiser_for(network, mode)) for mode in modes}
    network = joint_in_half_floats(network)
    for path in args.models:
        contract, file = Contract.of_file(path), path.parent / GPU_FOLDER / path.name
        file.parent.mkdir(exist_ok=True)
        onnx.save(to_onnx(network, contract, denoisers[contract.denoiser]), file)
        print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
