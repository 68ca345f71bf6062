# SPDX-License-Identifier: Apache-2.0
"""Export the `joint` or the `ensemble` models for GPUs: convolutions in half floats, the rest in float32.

    python -m training.gpu training/checkpoints/joint.pt oiio_msspl/model/weights/joint-x*.onnx
    python -m training.gpu training/checkpoints/joint_small.pt oiio_msspl/model/weights/joint-small-x*.onnx
    python -m training.gpu training/checkpoints/joint.pt oiio_msspl/model/weights/ensemble-x*.onnx \\
        --ensemble training/checkpoints/ensemble.pt

The arguments are a checkpoint of `joint` and the files for CPUs that were exported from it. Each file for GPUs lies in
the folder `gpu` beside the one for CPUs and has the same contract, so every device cuts a frame into the same tiles.
With `joint`, the denoiser of both renders' mean is written, too; `ensemble` uses the same.

The log curve stays in float32, because half floats overflow in it. Weights are stored as 8-bit codes with a scale for
each 3 x 3 kernel, and become half floats when the file is loaded. The networks of all scales have the same weights,
which lie in a file that they share.
"""

from __future__ import annotations

import argparse
import copy
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from onnx.external_data_helper import set_external_data
from torch import Tensor, nn

from oiio_msspl.model import mean_denoiser
from oiio_msspl.model.contract import METADATA_KEY, SCALES, Contract
from oiio_msspl.model.devices import GPU_FOLDER
from training.checkpoints import load
from training.ensemble import BandWeights, EnsembleFusion, load_weights
from training.export import example, traced
from training.joint import JointFusion
from training.mean_denoiser import MeanDenoiser
from training.oidn import provenance

IR_VERSION = 8
#: What is added to the provenance of a file.
PRECISION = {"precision": "convolutions in half floats, their weights stored in 8 bits with a scale for each kernel"}
#: Tensors of fewer bytes, such as biases, stay in the graph and are stored as they are.
SMALL = 1024


class Fuse(nn.Module):
    """:meth:`JointFusion.fuse` as a module for the exporter."""

    def __init__(self, network: JointFusion) -> None:
        super().__init__()
        self.network = network

    def forward(self, lrhs: Tensor, hrls: Tensor) -> tuple[Tensor, Tensor]:
        return self.network.fuse(lrhs, hrls)


def in_half_floats(network: JointFusion) -> JointFusion:
    """A copy whose convolutions compute in half floats, with one weight and one bias each."""
    network = copy.deepcopy(network)
    for part in (network, network.mean_denoiser):
        part.convs = nn.ModuleDict({name: conv.merged() for name, conv in part.convs.items()}).half()
    network.heads.half()
    network.error.half()
    return network.eval()


def ensemble_in_half_floats(network: JointFusion, weights: BandWeights) -> EnsembleFusion:
    """The ensemble with a network of :func:`in_half_floats`."""
    ensemble = EnsembleFusion(network, copy.deepcopy(weights).half())
    ensemble.oidn.half()
    return ensemble.eval()


@torch.inference_mode()
def to_onnx(network: JointFusion | EnsembleFusion, contract: Contract) -> onnx.ModelProto:
    """The graph of a network in half floats for the contract's scale."""
    joint, module = (network, Fuse(network)) if isinstance(network, JointFusion) else (network.joint, network)
    inputs = example(joint, contract.scale, 4 * contract.alignment, 6 * contract.alignment)
    outputs = ["fused", "log_error", *(["albedo", "normal"] if isinstance(network, EnsembleFusion) else [])]
    model = traced(module, inputs, ["lrhs", "hrls"], outputs, contract.alignment)
    contract = replace(contract, provenance=contract.provenance | PRECISION)
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    return _finished(model)


@torch.inference_mode()
def mean_denoiser_to_onnx(network: MeanDenoiser) -> onnx.ModelProto:
    """The graph of the denoiser of both renders' mean. Inputs are the images of
    :func:`oiio_msspl.model.render_mean.mean_of_renders`, the output is ``denoised``."""
    alignment = mean_denoiser.ALIGNMENT
    inputs = tuple(torch.rand(1, channels, 4 * alignment, 6 * alignment) for channels in (3, 1, 3, 3))
    model = traced(network, inputs, ["colour", "noise", "albedo", "normal"], ["denoised"], alignment)
    helper.set_model_props(model, {"provenance": json.dumps(provenance(network.start.network) | PRECISION)})
    return _finished(model)


def _finished(model: onnx.ModelProto) -> onnx.ModelProto:
    model.ir_version = IR_VERSION
    _store_kernels_in_8_bits(model.graph)
    onnx.checker.check_model(model, full_check=True)
    return model


def _store_kernels_in_8_bits(graph: onnx.GraphProto) -> None:
    """Replace the weights of convolutions by codes, scales and their product, which ONNX Runtime folds when it loads
    the file. One scale for each output would cost 0.5 dB."""
    products = []
    for tensor in list(graph.initializer):
        if tensor.data_type != TensorProto.FLOAT16 or len(tensor.dims) != 4 or len(tensor.raw_data) < SMALL:
            continue
        name, weights = tensor.name, numpy_helper.to_array(tensor).astype(np.float32)
        scales = (np.abs(weights).max(axis=(2, 3), keepdims=True) / 127).astype(np.float16)
        codes = np.round(weights / np.maximum(scales.astype(np.float32), 1e-12)).clip(-127, 127).astype(np.int8)
        tensor.CopyFrom(numpy_helper.from_array(codes, f"{name}.codes"))
        graph.initializer.append(numpy_helper.from_array(scales, f"{name}.scales"))
        # ONNX Runtime has no product of half floats on the CPU, where it folds constants
        products += [
            helper.make_node("Cast", [f"{name}.codes"], [f"{name}.codes.float"], to=TensorProto.FLOAT),
            helper.make_node("Cast", [f"{name}.scales"], [f"{name}.scales.float"], to=TensorProto.FLOAT),
            helper.make_node("Mul", [f"{name}.codes.float", f"{name}.scales.float"], [f"{name}.float"]),
            helper.make_node("Cast", [f"{name}.float"], [name], to=TensorProto.FLOAT16),
        ]
    nodes = [*products, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def share_weights(models: Sequence[onnx.ModelProto], file: Path) -> None:
    """Move the weights of models into one file, equal ones once. The models are saved into the same folder."""
    places: dict[bytes, int] = {}
    with file.open("wb") as out:
        for model in models:
            for tensor in model.graph.initializer:
                data = tensor.raw_data
                if len(data) < SMALL:
                    continue
                if data not in places:
                    places[data] = out.tell()
                    out.write(data)
                set_external_data(tensor, file.name, places[data], len(data))
                tensor.ClearField("raw_data")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("models", type=Path, nargs="+", help="the network's files for CPUs, one for each scale")
    parser.add_argument("--ensemble", type=Path, metavar="WEIGHTS", help="weights of the ensemble models")
    args = parser.parse_args()
    joint, _ = load(args.checkpoint)
    if not isinstance(joint, JointFusion):
        raise SystemExit(f"{args.checkpoint}: not a joint network")
    joint = in_half_floats(joint)
    network: JointFusion | EnsembleFusion = joint
    folder, family = args.models[0].parent / GPU_FOLDER, args.models[0].stem.rpartition("-x")[0]
    folder.mkdir(exist_ok=True)
    if args.ensemble:
        network = ensemble_in_half_floats(joint, load_weights(args.ensemble)[0])
    else:
        path = mean_denoiser.WEIGHTS[joint.denoiser(SCALES[0])]
        denoiser = path.parent / GPU_FOLDER / path.name
        denoiser.parent.mkdir(exist_ok=True)
        onnx.save(mean_denoiser_to_onnx(joint.mean_denoiser), denoiser)

    models = {path.name: to_onnx(network, Contract.of_file(path)) for path in args.models}
    share_weights(list(models.values()), folder / f"{family}.weights")
    for name, model in models.items():
        onnx.save(model, folder / name)
    for path in sorted([*folder.glob(f"{family}-x*"), folder / f"{family}.weights"]):
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
