# SPDX-License-Identifier: Apache-2.0
"""Make the models for one render, and for two renders of one size, out of exported `joint` models at x2.

    python -m research.training.same_size oiio_msspl/model/weights/joint-x2.onnx
    python -m research.training.same_size oiio_msspl/model/weights/joint-large-x2.onnx --first-stage

This writes ``joint-x1.onnx`` beside the file for CPUs and, in the folder `gpu`, beside that for GPUs. Nothing is
trained: the networks and their weights are those of the model at x2, and only what comes before them changes. The mean
of both renders takes the place of the HRLS, and the mean at half of the size that of the LRHS.

With ``--first-stage`` the model is the denoiser of both renders' mean alone, at full size, after the networks for
albedo and normal.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from onnx.external_data_helper import set_external_data
from torch import Tensor
from torch.nn import functional as F

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.model.contract import METADATA_KEY, ONE_SIZE, Contract
from oiio_msspl.model.devices import gpu_file
from research.training.encoding import log_encode
from research.training.ops import box_downsample
from research.training.quantise.graph import Nodes
from research.training.render_mean import NOISE_GAIN, Images, mean_of_renders
from research.training.tracing import traced
from research.training.whole_model import ENTER, SMALL, Enter, encoded, example

#: What comes out of :class:`EnterHalves` and :class:`EnterWhole`; ``encoded.`` precedes these names in the graph.
ENTERED = ("lrhs", "hrls", "colour", "noise", "albedo", "normal")
#: Height and width at x2 of a pixel of the LRHS.
SCALE = 2


class EnterHalves(Enter):
    """What comes before the networks of a model at x2, if both renders have the size of its HRLS.

    For one render, which is given as both with shares of 0, its pixels at even and at odd places are the two renders
    whose difference tells the noise.
    """

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the values of ``ENTERED``."""
        lrhs, hrls, shares = self.exposed(inputs)
        mean = _mean(lrhs, hrls, shares)
        low, high = ({name: box_downsample(image, SCALE) for name, image in x.items()} for x in (lrhs, hrls))
        one, colour = shares[RGB] == 0, hrls[RGB]
        even, odd = ((colour[..., ::2, i::2] + colour[..., 1::2, 1 - i :: 2]) / 2 for i in (0, 1))
        low[RGB], high[RGB] = torch.where(one, even, low[RGB]), torch.where(one, odd, high[RGB])
        half = torch.full_like(shares[RGB], 0.5)
        low_mean, *others = mean_of_renders(low, high, shares | {RGB: torch.where(one, half, shares[RGB])})
        return low_mean, encoded(mean), low_mean, *others


class EnterWhole(Enter):
    """What comes before the denoiser of both renders' mean, if both renders have the size of the result.

    For one render, which is given as both with shares of 0, the difference of each pixel from those around tells the
    noise.
    """

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the values of ``ENTERED``."""
        lrhs, hrls, shares = self.exposed(inputs)
        mean = _mean(lrhs, hrls, shares)
        colour, noise, albedo, normal = mean_of_renders(lrhs, hrls, shares)
        around = F.pad(colour, (1, 1, 1, 1), mode="reflect")
        beside = around[..., 1:-1, :-2] + around[..., 1:-1, 2:] + around[..., :-2, 1:-1] + around[..., 2:, 1:-1]
        difference = (colour - beside / 4).abs().mean(dim=1, keepdim=True)
        # Its variance is 5/4 of the noise's, where that of two renders is 4 times that of their mean's.
        single = (NOISE_GAIN / 1.25**0.5 * difference).clamp_max(1.0)
        noise = torch.where(shares[RGB] == 0, single, noise)
        return log_encode(lrhs[RGB]), encoded(mean), colour, noise, albedo, normal


def _mean(lrhs: Images, hrls: Images, shares: Images) -> Images:
    return {name: hrls[name] + shares[name] * (lrhs[name] - hrls[name]) for name in hrls}


def same_size_model(path: Path, *, first_stage: bool = False) -> onnx.ModelProto:
    """Return the model for renders of one size, given the file of a `joint` model at x2."""
    model, contract = onnx.load(path, load_external_data=False), Contract.of_file(path)
    factor = 1 if first_stage else SCALE
    contract = replace(
        contract, name=f"{contract.name.rpartition('-x')[0]}-x1", scale=ONE_SIZE, training_spp={},
        alignment=factor * contract.alignment, overlap=SCALE * contract.overlap,
        provenance=contract.provenance | {"made_from": contract.name},
    )  # fmt: skip
    inputs = example(contract, 4 * contract.alignment, 6 * contract.alignment)
    module = (EnterWhole if first_stage else EnterHalves)(contract)
    enter = Nodes()
    enter.embed(
        traced(module, (list(inputs.values()),), list(inputs), list(ENTERED), contract.alignment),
        ENTER, {name: f"encoded.{name}" for name in ENTERED},
    )  # fmt: skip
    made = {f"encoded.{name}" for name in ENTERED}
    nodes = [n for n in model.graph.node if not n.output[0].startswith(ENTER) and n.output[0] not in made]
    outputs = list(model.graph.output)
    if first_stage:
        nodes, outputs = _first_stage(nodes, outputs, enter)
    tensors = [*model.graph.initializer, *enter.embedded, *enter.constants()]
    nodes, tensors = _needed([*enter.nodes, *nodes], tensors, [value.name for value in outputs])
    values = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, count, "H", "W"] if count else [])
        for name, count in contract.inputs.items()
    ]
    model.graph.CopyFrom(helper.make_graph(nodes, contract.name, values, outputs, tensors))
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    refer_to_weights(model, path)
    return model


def refer_to_weights(model: onnx.ModelProto, path: Path) -> None:
    """Let a model read the 8-bit weights that lie in the file of another model from there."""
    content = path.read_bytes()
    for tensor in model.graph.initializer:
        # Numbers of several bytes may lie at any place in the file, and not all processors can read them there.
        is_kept = len(tensor.raw_data) < SMALL or tensor.data_type not in (TensorProto.INT8, TensorProto.UINT8)
        place = -1 if is_kept else content.find(tensor.raw_data)
        if place >= 0:
            set_external_data(tensor, path.name, place, len(tensor.raw_data))
            tensor.ClearField("raw_data")


def _first_stage(
    nodes: list[onnx.NodeProto], outputs: list[onnx.ValueInfoProto], enter: Nodes
) -> tuple[list[onnx.NodeProto], list[onnx.ValueInfoProto]]:
    """Let the denoiser of the mean read the denoised albedo and normal, and its result be that of the model."""
    one, two = enter.constant("enter.one", np.float32(1)), enter.constant("enter.two", np.float32(2))
    doubled = Nodes()
    doubled.add("Sub", [doubled.add("Mul", [NORMAL, two], "normal.doubled"), one], "normal.signed")
    names = {"encoded.albedo": ALBEDO, "encoded.normal": "normal.signed", "encoded.fused": "mean.denoised"}
    for node in nodes:
        node.input[:] = [names.get(name, name) for name in node.input]
    return [*nodes, *doubled.nodes], [value for value in outputs if value.name in ("fused", ALBEDO, NORMAL)]


def _needed(
    nodes: list[onnx.NodeProto], tensors: list[onnx.TensorProto], outputs: list[str]
) -> tuple[list[onnx.NodeProto], list[onnx.TensorProto]]:
    """Return the nodes and tensors that outputs need, the nodes in an order in which they can be computed."""
    makers = {name: node for node in nodes for name in node.output}
    constants = {tensor.name: tensor for tensor in tensors}
    ordered: dict[str, onnx.NodeProto] = {}
    used: dict[str, onnx.TensorProto] = {}
    waiting = outputs[::-1]
    while waiting:
        name = waiting[-1]
        if name in constants:
            used[name] = constants[name]
        missing = [n for n in makers[name].input if n in makers and n not in ordered] if name in makers else []
        if missing:
            waiting += missing
            continue
        waiting.pop()
        if name in makers and name not in ordered:
            node = makers[name]
            ordered |= dict.fromkeys(node.output, node)
            used |= {n: constants[n] for n in node.input if n in constants}
    return list({id(node): node for node in ordered.values()}.values()), list(used.values())


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="file for CPUs of a joint model at x2")
    parser.add_argument("--first-stage", action="store_true", help="only denoise the mean of both renders")
    args = parser.parse_args()
    for source in filter(None, (args.model, gpu_file(args.model))):
        model = same_size_model(source, first_stage=args.first_stage)
        file = source.with_name(f"{model.graph.name}.onnx")
        onnx.save(model, file)
        onnx.checker.check_model(file, full_check=True)
        print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
