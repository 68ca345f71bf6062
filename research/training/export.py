# SPDX-License-Identifier: Apache-2.0
r"""Export a checkpoint's averaged weights as an ONNX file: a whole model with its contract.

    python -m research.training.export RUN/checkpoint.pt --name paper-x4 -o paper-x4.onnx --half
    python -m research.training.export JOINT.pt --scale 2 --name joint-x2 -o joint-x2.onnx --int8 VIEWS --overlap 48
    python -m research.training.export LARGE.pt --scale 2 4 8 --name joint-large -o joint-large --int8 VIEWS \
        --overlap 48 32 16

``--half`` stores weights as half floats, which are cast to float32 when the file is loaded: half the size, the same
computation. ``--int8`` computes convolutions in 8 bits (:mod:`research.training.quantise`). Files of several scales
have the same weights, which :mod:`research.training.share` then stores once. ``-x2`` and so on are added to ``--name``,
and ``-x2.onnx`` to the output.
"""

from __future__ import annotations

import argparse
import copy
import datetime
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from onnxscript import opset18

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.model.contract import NO_DENOISER, SCALES, SPREAD, Contract
from oiio_msspl.model.runtime import load_network
from research.training import CHECKPOINTS
from research.training.checkpoints import Network, load, load_joint, run
from research.training.denoisers import ALIGNMENT, MeanDenoiser, with_denoised_mean
from research.training.encoding import log_encode
from research.training.joint import FEATURES, SIZES, JointFusion
from research.training.oidn import provenance
from research.training.paper import MultiResolutionFusion
from research.training.quantise import joint
from research.training.quantise.layers import Networks, quantised, varied
from research.training.tracing import IR_VERSION, network_example, prepend, traced
from research.training.whole_model import example, quantised_denoiser, run_in_torch, whole_model

#: Memory of a tile in bytes per HRLS pixel, by family of models: the peak of a process that fuses a frame, without the
#: frame itself, and with room for the rows that are decoded for the next tiles.
MEMORY = {"paper": 1000, "joint-small": 700, "joint": 800, "joint-large": 1160}

#: Smaller tensors, such as biases, stay float32.
HALF_ELEMENTS = 256
#: Bits of a half float's mantissa, of 10, that are 0 in stored weights.
HALF_DROPPED = 3

#: Inputs of a joint network.
Pair = tuple[torch.Tensor, torch.Tensor]


def contract_of(network: Network, scale: int, name: str, overlap: int, state: dict[str, Any]) -> Contract:
    """Return the contract of a checkpoint's network for one of its scales."""
    denoiser = network.denoiser(scale) if isinstance(network, JointFusion) else NO_DENOISER
    # Tiles begin on the grid of the denoiser's lowest level, too, so that it divides a tile as it divides the frame.
    alignment = ALIGNMENT if denoiser else network.multiple // scale
    features: dict[str, Any] = {}
    if isinstance(network, JointFusion):
        # At x2 the average of four HRLS pixels still has noise, and the LRHS's AOVs halve it. At x4 and x8 the average
        # of 16 or 64 pixels has little, and the LRHS's AOVs differ from it where the pixel filter is not a box.
        features = {"lrhs": [RGB, *((ALBEDO, NORMAL) if scale == 2 else ())], "hrls": list(FEATURES)}
    return Contract(
        **features, name=name, scale=scale, denoiser=denoiser, alignment=alignment, overlap=overlap,
        bytes_per_pixel=MEMORY[name.rpartition("-x")[0].removesuffix(SPREAD)],
        training_spp=state["training_spp"][str(scale)],
        provenance=state["provenance"]
        | {"network": state["architecture"], **network.config, "date": datetime.date.today().isoformat()}
        | (provenance(SIZES[network.size][0]) if isinstance(network, JointFusion) else {}),
    )  # fmt: skip


def denoiser_for(network: JointFusion, mode: str) -> MeanDenoiser:
    """Return the denoiser of both renders' mean for a value of ``Contract.denoiser``.

    Where it is not the network's own, it is that of `joint`, or of `joint-spread`.
    """
    if network.mean_denoiser is None or network.denoiser(SCALES[0]) != mode:
        network, _ = load_joint(CHECKPOINTS / ("joint_spread.pt" if network.spread else "joint.pt"))
    assert network.mean_denoiser is not None
    return network.mean_denoiser


# Graph


@torch.inference_mode()
def to_onnx(network: MultiResolutionFusion, contract: Contract, *, half: bool = False) -> onnx.ModelProto:
    """Export the paper's network, which needs no calibration.

    Inputs are ``lrhs`` and ``hrls``, encoded; the output is ``fused``, log-encoded. The batch size is 1; height and
    width are any multiples of the contract's alignment.
    """
    inputs = network_example(network, contract.scale, contract.alignment)
    module = _with_onnx_channel_order(network)
    # One operator instead of the exporter's dozen
    unshuffle = torch.ops.aten.pixel_unshuffle.default
    translations = {unshuffle: lambda x, downscale_factor: opset18.SpaceToDepth(x, blocksize=downscale_factor)}
    model = traced(module, inputs, ["lrhs", "hrls"], ["fused"], contract.alignment, translations)
    if half:
        _store_as_half(model.graph)
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model, full_check=True)
    return model


@torch.inference_mode()
def joint_to_onnx(network: JointFusion, contracts: Sequence[Contract], pairs: Sequence[Pair]) -> list[onnx.ModelProto]:
    """Export a joint network with 8-bit convolutions for several scales.

    Inputs are those of :func:`to_onnx`; outputs are ``fused``, log-encoded, and ``log_error``; for the size ``large``
    also ``albedo`` and ``normal``. The graphs have the same weights. They are calibrated on pairs of the network's
    inputs, of all these scales.
    """
    layers: Networks | None = None
    if network.layers is not None:
        images = varied([hrls for _, hrls in pairs])
        layers, clean = quantised(network.layers, images)
        pairs = [
            (lrhs, torch.cat([image[:, :3], albedo, 2 * normal - 1], dim=1))
            for (lrhs, _), image, (albedo, normal) in zip(pairs, images, clean, strict=True)
        ]
    fit = joint.fitted(network, max(contract.scale for contract in contracts), pairs)
    return [joint.to_onnx(network, fit, contract, layers) for contract in contracts]


def _with_onnx_channel_order(network: MultiResolutionFusion) -> MultiResolutionFusion:
    """Return a copy whose deshuffle convolutions read SpaceToDepth's channel order instead of PyTorch's."""
    network = copy.deepcopy(network)
    with torch.no_grad():
        for stage in network.deshuffle:
            weight: torch.Tensor = stage.conv.weight  # (C', C * row * column, 3, 3)
            outputs, inputs, *kernel = weight.shape
            reordered = weight.reshape(outputs, inputs // 4, 4, *kernel).transpose(1, 2).reshape_as(weight)
            weight.copy_(reordered.clone())
    return network


def rounded_half(values: np.ndarray) -> np.ndarray:
    """Return values as half floats whose last ``HALF_DROPPED`` bits are 0. A package compresses them by a sixth more.

    The error of each weight is added to the next one of the same output (error diffusion), so that their sum stays
    right. Rounding each to nearest changes PSNR by up to 0.07 dB, this by up to 0.006 dB.
    """
    rows = values.reshape(len(values), -1).astype(np.float32)
    rounded = np.empty(rows.shape, np.float16)
    error = np.zeros(len(rows), np.float32)
    half = (1 << (HALF_DROPPED - 1)) - 1
    for column in range(rows.shape[1]):
        wanted = rows[:, column] + error
        bits = wanted.astype(np.float16).view(np.uint16).astype(np.uint32)
        bits += half + (bits >> HALF_DROPPED & 1)  # ties to even
        rounded[:, column] = (bits >> HALF_DROPPED << HALF_DROPPED).astype(np.uint16).view(np.float16)
        error = wanted - rounded[:, column]
    return rounded.reshape(values.shape)


def _store_as_half(graph: onnx.GraphProto) -> None:
    """Replace float32 weights by half floats and a Cast, which ONNX Runtime folds when it loads the file."""
    casts = []
    for tensor in graph.initializer:
        if tensor.data_type == onnx.TensorProto.FLOAT and np.prod(tensor.dims) >= HALF_ELEMENTS:
            name = tensor.name
            values = rounded_half(numpy_helper.to_array(tensor))
            tensor.CopyFrom(numpy_helper.from_array(values, f"{name}.half"))
            casts.append(helper.make_node("Cast", [tensor.name], [name], to=onnx.TensorProto.FLOAT))
    prepend(graph, casts)


# Checks


@torch.inference_mode()
def parity(network: Network, path: Path, denoise: MeanDenoiser | None = None) -> float:
    """Return the largest difference of an exported file's output from the network's, log-encoded.

    Args:
        denoise: the denoiser of both renders' mean, if the file's contract has one.
    """
    session, contract = load_network(path), Contract.of_file(path)
    fuse = network.fuse if isinstance(network, JointFusion) else partial(run, network)
    block = contract.alignment * -(-6 // contract.alignment)  # at least six pixels
    worst = 0.0
    for height, width in ((4 * block, 4 * block), (3 * block, 5 * block)):
        inputs = example(contract, height, width, seed=height)
        (fused,) = session.run(["fused"], {name: values.numpy() for name, values in inputs.items()})
        expected = run_in_torch(contract, inputs, fuse, denoise)
        worst = max(worst, float((log_encode(torch.from_numpy(fused)) - log_encode(expected)).abs().max()))
    return worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--scale", type=int, nargs="+", help="scales to export, of a network for several")
    parser.add_argument("--name", required=True, help="short name of the model, e.g. paper-x4")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--half", action="store_true", help="store weights as half floats")
    parser.add_argument("--int8", type=Path, metavar="VIEWS", help="convolutions in 8 bits, calibrated on these views")
    overlap = "LRHS pixels that tiles share on each side, for each scale"
    parser.add_argument("--overlap", type=int, nargs="+", default=[24], help=overlap)
    parser.add_argument("--denoiser", type=Path, help="quantised denoiser of both renders' mean (default: the shipped)")
    args = parser.parse_args()

    network, state = load(args.checkpoint)
    scales = args.scale or ([network.scale] if isinstance(network, MultiResolutionFusion) else [])
    if not scales:
        raise SystemExit("this network serves several scales; choose some with --scale")
    names = {scale: f"-x{scale}" if len(scales) > 1 else "" for scale in scales}
    if len(args.overlap) not in (1, len(scales)):
        raise SystemExit("--overlap: give one number, or one for each scale")
    overlaps = args.overlap * (len(scales) // len(args.overlap))
    contracts = [
        contract_of(network, scale, args.name + end, overlap, state)
        for (scale, end), overlap in zip(names.items(), overlaps, strict=True)
    ]
    files = [args.output.with_name(f"{args.output.name}{end}.onnx") if end else args.output for end in names.values()]
    denoiser: MeanDenoiser | None = None
    if isinstance(network, JointFusion):
        if not args.int8:
            raise SystemExit("a joint network can only be exported with --int8")
        if len({contract.denoiser for contract in contracts}) > 1:
            raise SystemExit("--scale: these scales have other denoisers of both renders' mean; export each alone")
        denoiser = denoiser_for(network, contracts[0].denoiser)
        pairs = joint.calibration_pairs(args.int8, scales, partial(with_denoised_mean, denoiser), spread=network.spread)
        graphs = joint_to_onnx(network, contracts, pairs)
    else:
        graphs = [to_onnx(network, contract, half=args.half) for contract in contracts]
    for file, graph, contract in zip(files, graphs, contracts, strict=True):
        onnx.save(whole_model(graph, contract, quantised_denoiser(contract.denoiser, args.denoiser)), file)
        difference = parity(network, file, denoiser)
        print(f"{file}: {file.stat().st_size / 1e6:.1f} MB, largest difference from PyTorch {difference:.2g}")


if __name__ == "__main__":
    main()
