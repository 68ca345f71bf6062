# SPDX-License-Identifier: Apache-2.0
"""Make the models for one render, and for two renders of one size, out of exported `joint` models at x2.

    python -m research.training.same_size oiio_msspl/model/weights/joint-x2.onnx

This writes ``joint-x1.onnx`` beside the file for CPUs and, in the folder `gpu`, beside that for GPUs. Nothing is
trained: the networks and their weights are those of the model at x2, and only what comes before them changes. The mean
of both renders takes the place of the HRLS, and the mean at half of the size that of the LRHS. With ``--clean``, it
also writes ``joint-clean-x1.onnx`` for renders with little noise: the denoiser of that mean alone, at full size. That
of ``joint-large`` reads albedo and normal that are denoised before. Run :mod:`research.training.share` afterwards, so
that the weights lie once.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from torch import Tensor
from torch.nn import functional as F

from oiio_msspl.aovs.features import RGB
from oiio_msspl.model.contract import CLEAN, METADATA_KEY, ONE_SIZE, Contract
from oiio_msspl.model.devices import gpu_file
from research.training.ops import box_downsample
from research.training.quantise.graph import Nodes
from research.training.render_mean import NOISE_GAIN, Images, mean_of_renders
from research.training.tracing import traced
from research.training.whole_model import ENTER, Enter, encoded, example

#: What comes out of :class:`EnterHalves` and of :class:`EnterMean`; ``encoded.`` precedes these names in the graph.
HALVES = ("lrhs", "hrls", "colour", "noise", "albedo", "normal")
MEAN = ("hrls", "colour", "noise", "albedo", "normal")
#: Peak memory of a tile in bytes for each of its pixels, if the denoiser of the mean runs at full size.
BYTES_PER_PIXEL = 1160
#: Height and width at x2 of a pixel of the LRHS.
SCALE = 2


class EnterHalves(Enter):
    """What comes before the networks of a model at x2, if both renders have the size of its HRLS.

    For one render, which is given as both with shares of 0, its pixels at even and at odd places are the two renders
    whose difference tells the noise.
    """

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the values of ``HALVES``."""
        lrhs, hrls, shares = self.exposed(inputs)
        mean = _mean(lrhs, hrls, shares)
        low, high = ({name: box_downsample(image, SCALE) for name, image in x.items()} for x in (lrhs, hrls))
        one, colour = shares[RGB] == 0, hrls[RGB]
        even, odd = ((colour[..., ::2, i::2] + colour[..., 1::2, 1 - i :: 2]) / 2 for i in (0, 1))
        low[RGB], high[RGB] = torch.where(one, even, low[RGB]), torch.where(one, odd, high[RGB])
        half = torch.full_like(shares[RGB], 0.5)
        low_mean, *others = mean_of_renders(low, high, shares | {RGB: torch.where(one, half, shares[RGB])})
        return low_mean, encoded(mean), low_mean, *others


class EnterMean(Enter):
    """What comes before the denoiser of both renders' mean, if it is the whole model.

    The noise of one render is estimated from how far each pixel is from the mean of its four diagonal neighbours. If
    they show the same, this difference has 5/4 of the pixel's variance.
    """

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the values of ``MEAN``."""
        lrhs, hrls, shares = self.exposed(inputs)
        colour, noise, *aovs = mean_of_renders(lrhs, hrls, shares)
        around = F.pad(colour, (1, 1, 1, 1), mode="replicate")
        diagonal = (around[..., :-2, :-2] + around[..., :-2, 2:] + around[..., 2:, :-2] + around[..., 2:, 2:]) / 4
        of_one = NOISE_GAIN * math.sqrt(4 / 5) * (colour - diagonal).abs().mean(dim=1, keepdim=True)
        noise = torch.where(shares[RGB] == 0, of_one.clamp_max(1.0), noise)
        return encoded(_mean(lrhs, hrls, shares)), colour, noise, *aovs


def _mean(lrhs: Images, hrls: Images, shares: Images) -> Images:
    return {name: hrls[name] + shares[name] * (lrhs[name] - hrls[name]) for name in hrls}


def same_size_model(path: Path, clean: bool) -> onnx.ModelProto:
    """Return the model for renders of one size, or that for those with little noise, given a `joint` model at x2."""
    model, contract = onnx.load(path, load_external_data=False), Contract.of_file(path)
    family = contract.name.rpartition("-x")[0] + (CLEAN if clean else "")
    memory = BYTES_PER_PIXEL if clean else contract.bytes_per_pixel
    contract = replace(
        contract, name=f"{family}-x1", bytes_per_pixel=memory, scale=ONE_SIZE, training_spp={},
        alignment=SCALE * contract.alignment, overlap=SCALE * contract.overlap,
        provenance=contract.provenance | {"made_from": contract.name},
    )  # fmt: skip
    enter, names = (EnterMean(contract), MEAN) if clean else (EnterHalves(contract), HALVES)
    graph = Nodes()
    inputs = example(contract, 4 * contract.alignment, 6 * contract.alignment)
    graph.embed(
        traced(enter, (list(inputs.values()),), list(inputs), list(names), contract.alignment),
        ENTER, {name: f"encoded.{name}" for name in names},
    )  # fmt: skip
    outputs = list(model.graph.output)
    if clean:
        _keep_denoiser(model.graph, graph)
        outputs = [value for value in outputs if value.name != "log_error"]
    made = {f"encoded.{name}" for name in names}
    nodes = [n for n in model.graph.node if not n.output[0].startswith(ENTER) and n.output[0] not in made]
    tensors = [*model.graph.initializer, *graph.embedded, *graph.constants()]
    nodes, tensors = _needed([*graph.nodes, *nodes], tensors, [value.name for value in outputs])
    values = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, count, "H", "W"] if count else [])
        for name, count in contract.inputs.items()
    ]
    model.graph.CopyFrom(helper.make_graph(nodes, contract.name, values, outputs, tensors))
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    return model


def _keep_denoiser(model: onnx.GraphProto, graph: Nodes) -> None:
    """Let the denoiser of the mean give the result, and read the denoised albedo and normal if there are any."""
    instead = {"encoded.fused": "mean.denoised"}
    if "normal" in (value.name for value in model.output):
        two, one = graph.constant("two", np.float32(2)), graph.constant("unity", np.float32(1))
        signed = graph.add("Sub", [graph.add("Mul", ["normal", two], "normal.doubled"), one], "normal.signed")
        instead |= {"encoded.albedo": "albedo", "encoded.normal": signed}
    for node in model.node:
        node.input[:] = [instead.get(name, name) for name in node.input]


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
    parser.add_argument("--clean", action="store_true", help="also write the model for renders with little noise")
    args = parser.parse_args()
    for source in filter(None, (args.model, gpu_file(args.model))):
        for clean in (False, True)[: 1 + args.clean]:
            model = same_size_model(source, clean)
            file = source.with_name(f"{model.graph.name}.onnx")
            onnx.save(model, file)
            onnx.checker.check_model(file, full_check=True)
            print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
