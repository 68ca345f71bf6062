# SPDX-License-Identifier: Apache-2.0
"""Make the models for renders of one size, and those for little noise, out of exported `joint` models.

    python -m research.training.same_size oiio_msspl/model/weights/joint-x2.onnx

This writes ``joint-x1.onnx`` beside the file for CPUs and, in the folder `gpu`, beside that for GPUs. Nothing is
trained: the networks and their weights are those of the model at x2, and only what comes before them changes. The mean
of both renders takes the place of the HRLS, and the mean at half of the size that of the LRHS.

With ``--clean``, it also writes the models for renders with little noise. ``joint-clean-x1.onnx`` is Open Image
Denoise's large network, which denoises the mean at full size. That of ``joint-large`` reads albedo and normal that are
denoised before. ``joint-clean-x2.onnx`` and those at x4 and x8 denoise the HRLS by it, and the mean of both renders at
the LRHS's size as the models do that they are made of. Then they draw the first picture towards the brightness of the
second. Noise that a filter has spread needs the whole model for one render, so ``joint-spread-clean-x2.onnx`` holds it,
and there is no ``joint-spread-clean-x1.onnx``.

Run :mod:`research.training.share` afterwards, so that the weights lie once.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.model.contract import CLEAN, METADATA_KEY, ONE_SIZE, SCALES, SPREAD, Contract
from oiio_msspl.model.devices import GPU_FOLDER, gpu_file
from research.training.denoisers import FullSizeDenoiser
from research.training.encoding import log_decode, log_encode
from research.training.gpu import denoiser_graph, in_half_floats
from research.training.joint import MAX_RATIO
from research.training.ops import box_downsample, upsample
from research.training.quantise.codes import INPUT_SLICES
from research.training.quantise.graph import Nodes
from research.training.render_mean import Images, mean_of_renders
from research.training.tracing import traced
from research.training.whole_model import ENTER, FULL_SIZE_DENOISER, Enter, add_quantised, encoded, example, inputs_of

#: What comes out of :class:`EnterHalves` and of :class:`EnterMean`; ``encoded.`` precedes these names in the graph.
HALVES = ("lrhs", "hrls", "colour", "noise", "albedo", "normal")
MEAN = ("hrls", "colour", "albedo", "normal")
#: Peak memory of a tile in bytes for each of its pixels, if a large denoiser runs at full size.
BYTES_PER_PIXEL = 1160
#: Height and width at x2 of a pixel of the LRHS.
SCALE = 2
#: How far the denoised HRLS is drawn towards the brightness of both renders' denoised mean: if no sample of that mean
#: is the LRHS's, and what is added if all of them are. A wide filter blurs the LRHS more than the HRLS, so the second
#: two numbers are for it, and means of 3 x 3 pixels are compared.
DRAWN, DRAWN_SPREAD = (0.2, 0.8), (0.0, 0.3)
#: Added to both sides of the ratio of their brightness, in exposed radiance: noise in the dark is no light.
DARK = 0.02
#: Prefix of tensors of the denoiser at full size.
OWN = "own."


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
    """What comes before the denoiser of one render, or of the mean of two of one size, if it is the whole model."""

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the values of ``MEAN``. Albedo and normal are in [0, 1]."""
        mean = _mean(*self.exposed(inputs))
        return encoded(mean), log_encode(mean[RGB]), mean[ALBEDO].clamp(0, 1), 0.5 * mean[NORMAL] + 0.5


class Draw(nn.Module):
    """What comes after the denoisers of a pair with little noise.

    Args:
        scale: of the pair.
        spread: a filter has spread the noise.
    """

    def __init__(self, scale: int, spread: bool) -> None:
        super().__init__()
        self.scale, self.spread = scale, spread

    def forward(self, mean: Tensor, hrls: Tensor, share: Tensor) -> Tensor:
        """Draw the denoised HRLS (1, 3, s*h, s*w) towards the brightness of the denoised mean of both renders.

        Args:
            mean: (1, 3, h, w). All images are log-encoded.
            share: of the LRHS in the mean.
        """
        picture = log_decode(hrls)
        ratio = (self._light(log_decode(mean)) + DARK) / (self._light(box_downsample(picture, self.scale)) + DARK)
        least, by_lrhs = DRAWN_SPREAD if self.spread else DRAWN
        ratio = ratio.clamp(1 / MAX_RATIO, MAX_RATIO) ** (least + by_lrhs * share)
        return log_encode(picture * upsample(ratio, self.scale, "bilinear"))

    def _light(self, image: Tensor) -> Tensor:
        return F.avg_pool2d(image, 3, 1, 1, count_include_pad=False) if self.spread else image


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
    made = {f"encoded.{name}" for name in names}
    if clean:
        denoised = {value.name for value in outputs}
        images = [name if name in denoised else f"encoded.{name}" for name in MEAN[1:]]
        add_full_size_denoiser(graph, images, "encoded.fused", half_floats=path.parent.name == GPU_FOLDER)
        outputs, made = [value for value in outputs if value.name != "log_error"], made | {"encoded.fused"}
    nodes = [n for n in model.graph.node if not n.output[0].startswith(ENTER) and made.isdisjoint(n.output)]
    return _finished(model, contract, graph, nodes, outputs)


def add_full_size_denoiser(graph: Nodes, images: list[str], output: str, *, half_floats: bool) -> None:
    """Add the denoiser of one render to a graph, in 8 bits or in half floats.

    Args:
        images: tensors of colour, albedo and normal for :class:`research.training.denoisers.FullSizeDenoiser`.
        output: tensor of the denoised picture, log-encoded.
    """
    if half_floats:
        names = dict(zip(MEAN[1:], images, strict=True))
        graph.embed(
            denoiser_graph(in_half_floats(FullSizeDenoiser()), dict.fromkeys(MEAN[1:], 3)),
            OWN,
            names | {"denoised": output},
        )
        return
    colour, albedo, normal = images
    step = graph.constant("step", np.float32(1 / 255))
    codes = [code for image in (graph.log_to_pu(colour), albedo) for code in graph.slices(image, INPUT_SLICES)]
    codes.append(graph.add("QuantizeLinear", [normal, step, "zero"], f"{normal}.codes"))
    codes += -3 * len(codes) % 4 * [graph.zeros(normal)]
    add_quantised(graph, onnx.load(FULL_SIZE_DENOISER), OWN, graph.packed(codes, "own.layers"), output)


def clean_pair_model(path: Path, one_size: onnx.ModelProto) -> onnx.ModelProto:
    """Return the model for pairs with little noise.

    Args:
        path: of the `joint` model at the scale of the pairs.
        one_size: the model of the family for renders of one size: that for little noise, or for noise that is spread.
    """
    model, contract = onnx.load(path, load_external_data=False), Contract.of_file(path)
    family, _, scale = contract.name.rpartition("-x")
    contract = replace(
        contract, name=f"{family}{CLEAN}-x{scale}", bytes_per_pixel=BYTES_PER_PIXEL, training_spp={},
        provenance=contract.provenance | {"made_from": contract.name},
    )  # fmt: skip
    graph = Nodes()
    # One render is given as both, with shares of 0.
    none = graph.constant("no_share", np.float32(0))
    inputs = {value.name: value.name.replace("lrhs.", "hrls.") for value in one_size.graph.input}
    inputs |= {name: none for name in inputs if name.startswith("share.")}
    graph.embed(one_size, OWN, inputs | {"fused": f"{OWN}fused"})
    inputs_of_draw = example(contract, 4 * contract.alignment, 6 * contract.alignment)
    images = tuple(inputs_of_draw[name] for name in ("lrhs.rgb", "hrls.rgb", "share.rgb"))
    spread = family.endswith(SPREAD)
    draw = traced(Draw(contract.scale, spread), images, ["mean", "hrls", "share"], ["drawn"], contract.alignment)
    names = {"mean": "mean.denoised", "hrls": f"{OWN}encoded.fused", "share": "share.rgb", "drawn": "encoded.fused"}
    graph.embed(draw, "draw.", names)
    outputs = [value for value in model.graph.output if value.name != "log_error"]
    made = {name for node in graph.nodes for name in node.output}
    nodes = [node for node in model.graph.node if made.isdisjoint(node.output)]
    return _finished(model, contract, graph, nodes, outputs)


def _finished(
    model: onnx.ModelProto, contract: Contract, graph: Nodes, nodes: list[onnx.NodeProto],
    outputs: list[onnx.ValueInfoProto],
) -> onnx.ModelProto:  # fmt: skip
    """Give a model another contract, and a graph of new nodes and of some that it has: what the outputs need."""
    tensors = [*model.graph.initializer, *graph.embedded, *graph.constants()]
    nodes, tensors = _needed([*graph.nodes, *nodes], tensors, [value.name for value in outputs])
    model.graph.CopyFrom(helper.make_graph(nodes, contract.name, inputs_of(contract), outputs, tensors))
    helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    return model


def _needed(
    nodes: list[onnx.NodeProto], tensors: list[onnx.TensorProto], outputs: list[str]
) -> tuple[list[onnx.NodeProto], list[onnx.TensorProto]]:
    """Return the nodes and tensors that outputs need, the nodes in an order in which they can be computed."""
    makers = {name: node for node in nodes for name in node.output}
    ordered: dict[str, onnx.NodeProto] = {}
    waiting = outputs[::-1]
    while waiting:
        node = makers[waiting[-1]]
        missing = [name for name in node.input if name in makers and name not in ordered]
        waiting += missing
        if not missing:
            waiting.pop()
            ordered |= dict.fromkeys(node.output, node)
    constants = {tensor.name: tensor for tensor in tensors}
    kept = {id(node): node for node in ordered.values()}.values()
    used = {name: constants[name] for node in kept for name in node.input if name in constants}
    return list(kept), list(used.values())


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="file for CPUs of a joint model at x2")
    parser.add_argument("--clean", action="store_true", help="also write the model for renders with little noise")
    args = parser.parse_args()
    for source in filter(None, (args.model, gpu_file(args.model))):
        models = [same_size_model(source, clean=False)]
        if args.clean:
            if not source.stem.endswith(f"{SPREAD}-x{SCALE}"):
                models.append(same_size_model(source, clean=True))
            stem = source.stem.removesuffix(f"x{SCALE}")
            pairs = [source.with_name(f"{stem}x{scale}.onnx") for scale in SCALES]
            models += [clean_pair_model(pair, models[-1]) for pair in pairs]
        for model in models:
            file = source.with_name(f"{model.graph.name}.onnx")
            onnx.save(model, file)
            onnx.checker.check_model(file, full_check=True)
            print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
