# SPDX-License-Identifier: Apache-2.0
"""Make the model that ships out of a network: a graph that reads and returns scene-linear images.

A network reads and returns encoded images. Its model computes what comes before and after, too. So a GPU does all of
it, and nothing waits for NumPy:

1. expose, log-encode and stack the features of both renders,
2. for `joint`: average both renders, and denoise their mean,
3. run the network,
4. decode the fused image, and divide it by the exposure.

Inputs and outputs are those of :class:`oiio_msspl.model.contract.Contract`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper
from torch import Tensor, nn

from oiio_msspl.aovs.features import RGB
from oiio_msspl.model.contract import METADATA_KEY, ONE_SIZE, Contract
from oiio_msspl.model.encoding import MAX_ENCODED
from research.training import CHECKPOINTS
from research.training.encoding import encoded_feature, exposed_feature, log_decode, log_encode
from research.training.quantise.codes import INPUT_SLICES, OUTPUT_SLICES, log_encoded_of_code
from research.training.quantise.graph import Nodes
from research.training.render_mean import Images, mean_of_renders
from research.training.tracing import image_info, traced

#: File of the denoiser of one render at full size, in 8 bits.
FULL_SIZE_DENOISER = CHECKPOINTS / "full_size_denoiser.onnx"
#: Prefixes of tensors in the graph of a model.
ENTER, NETWORK, DENOISER = "enter.", "network.", "denoiser."
#: Tensors of fewer bytes, such as biases, are stored as they are.
SMALL = 1024


class Enter(nn.Module):
    """What comes before the network, and before the denoiser."""

    def __init__(self, contract: Contract) -> None:
        super().__init__()
        self.contract = contract

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Encode the contract's inputs, which are in its order.

        Returns:
            The LRHS and HRLS, and with a denoiser :func:`research.training.render_mean.mean_of_renders`.
        """
        lrhs, hrls, shares = self.exposed(inputs)
        renders = log_encode(lrhs[RGB]), encoded(hrls)
        return (*renders, *mean_of_renders(lrhs, hrls, shares)) if self.contract.denoiser else renders

    def exposed(self, inputs: Sequence[Tensor]) -> tuple[Images, Images, Images]:
        """Return the exposed features of the LRHS and of the HRLS, and the LRHS's shares in their mean."""
        given = dict(zip(self.contract.inputs, inputs, strict=True))
        lrhs, hrls = (
            {name: exposed_feature(name, given[f"{render}.{name}"], given["exposure"]) for name in names}
            for render, names in (("lrhs", self.contract.lrhs), ("hrls", self.contract.hrls))
        )
        shares = {name: given[f"share.{name}"] for name in self.contract.lrhs if self.contract.denoiser}
        return lrhs, hrls, shares


def encoded(features: Images) -> Tensor:
    """Encode and stack exposed features."""
    return torch.cat([encoded_feature(*item) for item in features.items()], dim=1)


class Leave(nn.Module):
    """What comes after the network."""

    def forward(self, encoded: Tensor, exposure: Tensor) -> Tensor:
        """Decode the fused image (1, 3, H, W), given its exposure, to scene-linear values, finite and >= 0."""
        return log_decode(encoded.clamp(0.0, MAX_ENCODED)) / exposure


def run_in_torch(
    contract: Contract, inputs: Mapping[str, Tensor], fuse: Callable[[Tensor, Tensor], Sequence[Tensor | None]],
    denoise: Callable[..., Tensor] | None = None,
) -> Tensor:  # fmt: skip
    """Run a whole model in PyTorch, in 32 bits; return the fused image (1, 3, s*h, s*w), scene linear.

    Args:
        contract: of the model.
        inputs: of the contract.
        fuse: the network, which reads encoded images and returns the fused one first.
        denoise: the denoiser of both renders' mean, if the contract has one.
    """
    lrhs, hrls, *mean = Enter(contract)([inputs[name] for name in contract.inputs])
    if denoise is not None:
        lrhs = torch.cat([lrhs, denoise(*mean)], dim=1)
    fused: Tensor = Leave()(fuse(lrhs, hrls)[0], inputs["exposure"])
    return fused


def whole_model(network: onnx.ModelProto, contract: Contract, denoiser: onnx.ModelProto | None) -> onnx.ModelProto:
    """Return the model of a network.

    Args:
        network: its inputs are ``lrhs`` and ``hrls``, encoded; outputs are ``fused``, log-encoded, and others, which
            the model returns as they are.
        contract: of the model.
        denoiser: of both renders' mean, if the contract has one. Its input is ``layers`` and its output ``codes``
            (:mod:`research.training.quantise.codes`), or images, with the output ``denoised``.
    """
    graph = Nodes()
    names = ["lrhs", "hrls", *(["colour", "noise", "albedo", "normal"] if denoiser is not None else [])]
    inputs = example(contract, 4 * contract.alignment, 6 * contract.alignment)
    enter = traced(Enter(contract), (list(inputs.values()),), list(inputs), names, contract.alignment)
    graph.embed(enter, ENTER, {name: f"encoded.{name}" for name in names})
    lrhs, hrls, *mean = (f"encoded.{name}" for name in names)
    if denoiser is not None:
        _denoise(graph, denoiser, mean)
        lrhs = graph.add("Concat", [lrhs, "mean.denoised"], "encoded.both", axis=1)
    graph.embed(network, NETWORK, {"lrhs": lrhs, "hrls": hrls, "fused": "encoded.fused"})
    ends = inputs["hrls.rgb"], inputs["exposure"]
    leave = traced(Leave(), ends, ["encoded", "exposure"], ["fused"], contract.scale * contract.alignment)
    graph.embed(leave, "leave.", {"encoded": "encoded.fused"})
    results = {value.name: value.type.tensor_type.shape.dim[1].dim_value for value in network.graph.output}
    outputs = [image_info(name, count) for name, count in results.items()]
    model = graph.finished(contract.name, inputs_of(contract), outputs)
    _share_equal_tensors(model.graph)
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    return model


def inputs_of(contract: Contract) -> list[onnx.ValueInfoProto]:
    """Describe the inputs of a contract. Renders of one size have the same height and width."""
    low = "HW" if contract.scale == ONE_SIZE else "hw"
    sizes = {"lrhs": low, "hrls": "HW"}
    return [image_info(name, count, sizes.get(name[:4], "")) for name, count in contract.inputs.items()]


def _denoise(graph: Nodes, denoiser: onnx.ModelProto, images: list[str]) -> None:
    """Add the denoiser of both renders' mean to a graph, in 8 bits or not."""
    names = [value.name for value in denoiser.graph.input]
    if names != ["layers"]:
        graph.embed(denoiser, DENOISER, {**dict(zip(names, images, strict=True)), "denoised": "mean.denoised"})
        return
    colour, noise, albedo, normal = images
    half, step = graph.constant("half", np.float32(0.5)), graph.constant("step", np.float32(1 / 255))
    normal = graph.add("Add", [graph.add("Mul", [normal, half], "mean.scaled"), half], "mean.shifted")
    rest = [graph.add("QuantizeLinear", [i, step, "zero"], f"{i}.codes") for i in (albedo, normal, noise)]
    slices = graph.add("Concat", graph.slices(graph.log_to_pu(colour), INPUT_SLICES), "mean.slices", axis=1)
    # The slices of each colour lie side by side.
    order = graph.constant("by_colour", np.arange(3 * INPUT_SLICES).reshape(INPUT_SLICES, 3).T.ravel())
    layers = graph.packed([graph.add("Gather", [slices, order], "mean.by_colour", axis=1), *rest], "mean.layers")
    add_quantised(graph, denoiser, DENOISER, layers, "mean.denoised")


def add_quantised(graph: Nodes, denoiser: onnx.ModelProto, prefix: str, layers: str, output: str) -> None:
    """Add a denoiser in 8 bits. Its picture ``output`` (1, 3, h, w) is log-encoded."""
    graph.embed(denoiser, prefix, {"layers": layers, "codes": f"{output}.sums"})
    graph.constant("of_code", log_encoded_of_code(OUTPUT_SLICES))
    pixels = graph.look_up("of_code", f"{output}.sums", f"{output}.pixels")
    graph.add("Transpose", [pixels], output, perm=[0, 3, 1, 2])


def _share_equal_tensors(graph: onnx.GraphProto) -> None:
    """Keep one of several equal tensors, such as tables of curves."""
    kept: dict[tuple[bytes, ...], str] = {}
    names: dict[str, str] = {}
    for tensor in list(graph.initializer):
        if len(tensor.raw_data) < SMALL:
            continue
        key = tensor.raw_data, str(tensor.data_type).encode(), str(tensor.dims).encode()
        names[tensor.name] = kept.setdefault(key, tensor.name)
        if names[tensor.name] != tensor.name:
            graph.initializer.remove(tensor)
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]


def example(contract: Contract, height: int, width: int, seed: int = 0) -> dict[str, Tensor]:
    """Return random inputs of a contract, for an LRHS of height x width pixels."""
    generator = torch.Generator().manual_seed(seed)
    inputs = {}
    for name, count in contract.inputs.items():
        factor = 1 if name.startswith("lrhs") else contract.scale
        shape = (1, count, height * factor, width * factor) if count else ()
        inputs[name] = torch.rand(shape, generator=generator)
    return inputs


def denoiser_file(mode: str) -> str:
    """Return the name, without its ending, of the file of a value of ``Contract.denoiser``."""
    return mode.replace("mean", "mean_denoiser").replace("-", "_")


def quantised_denoiser(mode: str, file: Path | None = None) -> onnx.ModelProto | None:
    """Read the denoiser in 8 bits for a value of ``Contract.denoiser``: from a file, or the shipped one."""
    return onnx.load(file or CHECKPOINTS / f"{denoiser_file(mode)}.onnx") if mode else None
