# SPDX-License-Identifier: Apache-2.0
"""Make what :mod:`oiio_msspl.eight_bit` runs Open Image Denoise's networks by.

    python -m training.eight_bit VIEWS

For each network, ``oiio_msspl/denoisers/NAME.onnx``: a graph of 8-bit convolutions that leaves its weights open, how
its values are scaled, and by how many steps each weight differs from the nearest one.

Rounded to the nearest step, weights cost 0.7 dB. So layer after layer they are chosen on pictures of training
views: first the weights by which the rounded values of the layer before come closest to what the layer made of the
exact ones; then, weight after weight, the nearest step, the rest of the row making good for the error (Frantar et al.
2023, "GPTQ", after Hassibi and Stork 1993).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from datagen.views import Folder
from oiio_msspl import eight_bit, transforms
from oiio_msspl.denoiser import Denoiser, Layers, installed_weights, layers_of, merged
from oiio_msspl.schema import SCALES
from training import batches, data
from training.together import Together
from training.unet import LARGER, SMALLER, Shape, convolutions, given_weights, walk

FOLDER = Path(__file__).parent.parent / "oiio_msspl" / "denoisers"
CHECKPOINT = Path(__file__).parent / "checkpoints" / "joint.pt"
#: Pictures that are learnt from, and the pixels of each that a layer's weights are fitted to.
PICTURES, PIXELS, PATCH = 96, 4000, 256
#: Pictures without the layers that are needed, one after the other, until it is given up.
PATIENCE = 200
#: Share of a layer's values, in every picture, that its 8 bits reach beyond.
REACH = 0.9995
#: How far the channels of a layer have ranges of their own: 1, each its own; 0, all the largest. Between them, neither
#: the values of a weak channel nor the weights that read it have too few steps.
OWN_RANGE = 0.75
#: Strength of what keeps fitted weights near the original ones, against the power of their input, where there are as
#: many weights to an output as pixels to fit them to.
DAMPING = 1.0
STEPS = 127
#: Channels of codes that each layer of the last level has beyond those of its values, for slices of a few: what is
#: rounded there is seen as it is, and most of what is seen comes from a few channels. And of the larger network, which
#: works where pixels are fewer.
FURTHER, FURTHER_OF_LARGER = 16, 32
#: Names of convolutions that read a layer of a U-Net beside it; and, of their outputs and of those that the last layer
#: makes behind its colours, the range and the code of zero: logits, and logarithms.
SIDE = ("head1", "head2", "head3")
COLOURS, SIGNED_RANGE, SIGNED_ZERO = 3, 10.0, 128


SHAPES = {"usual": SMALLER, "albedo": SMALLER, "large": LARGER, "together": LARGER}


Weights = Mapping[str, Tensor]

# Choosing the weights


@dataclass
class Codes:
    """How values are written in 8 bits: each channel of codes is ``worth`` so much a code, and a part of the channel
    ``of`` the values. Several channels of codes are slices of one value's range, which they are the sum of."""

    worth: Tensor
    of: Tensor

    def values(self, codes: Tensor) -> Tensor:
        """What codes (C, H, W) are worth: (max(of) + 1, H, W)."""
        result = torch.zeros(int(self.of.max()) + 1, *codes.shape[1:])
        return result.index_add_(0, self.of, codes * self.worth[:, None, None])


@dataclass
class Values:
    """A layer's values of all pictures, (1, C, H, W): ``exact`` ones, and the ``codes`` of those that the layers in 8
    bits make, written as ``how`` says."""

    exact: list[Tensor]
    codes: list[Tensor]
    how: Codes


@dataclass
class Layer:
    """A convolution in 8 bits.

    Attributes:
        weights: (O, I, 3, 3), in whole ``step`` (O), of codes.
        bias: (O), in values.
        inputs: how what it reads is written.
        outputs: how what it makes is.
        begins: where the slice of each channel of codes begins, in values.
    """

    weights: Tensor
    step: Tensor
    bias: Tensor
    inputs: Codes
    outputs: Codes
    begins: Tensor

    def __call__(self, codes: Tensor) -> Tensor:
        weights = self.weights * self.step[:, None, None, None]
        values = F.conv2d(codes, weights, self.bias, padding=1)[:, self.outputs.of]
        in_codes = (values - self.begins[:, None, None]) / self.outputs.worth[:, None, None]
        return in_codes.round_().clamp_(0, 255)


def picture(layers: Layers) -> tuple[Tensor, Tensor]:
    """What the network reads: planes of values, which are what their codes are worth; and the codes."""
    how = codes_of_pictures(set(layers))
    codes = torch.from_numpy(eight_bit.pack(**layers)).permute(2, 0, 1).float()
    return how.values(codes)[None], codes[None]


def codes_of_pictures(layers: Set[str]) -> Codes:
    """As :func:`oiio_msspl.eight_bit.pack` writes them: of an albedo alone, or of more layers."""
    slices, whole = (eight_bit.SLICES_IN, 6) if "colour" in layers else (eight_bit.SLICES_OF_ALBEDO, 0)
    last = (1 / 255, 3 + whole) if "noise" in layers else (0.0, 0)
    worth = [1 / slices / 255] * (3 * slices) + [1 / 255] * whole + [last[0]]
    return Codes(torch.tensor(worth), torch.tensor([*np.repeat(range(3), slices), *range(3, 3 + whole), last[1]]))


@dataclass
class Given:
    """A convolution that whoever runs a network has already.

    Attributes:
        weight, bias: as they are found.
        rows, columns: its outputs and inputs that the network's first ones stand for.
    """

    weight: Tensor
    bias: Tensor
    rows: Sequence[int]
    columns: Sequence[int]

    @classmethod
    def of(cls, weights: Weights) -> dict[str, Given]:
        """All of a network's own convolutions, whole."""
        pairs = {name: (weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in convolutions(weights)}
        return {
            name: cls(weight, bias, *(list(range(count)) for count in weight.shape[:2]))
            for name, (weight, bias) in pairs.items()
        }


@dataclass
class Fit:
    """Layer after layer in 8 bits.

    Attributes:
        shape: of the U-Net.
        weights: of its convolutions, and of any that read a layer beside it.
        given: convolutions of the same names that they are written as differences from; not all need to have one.
        slices_out: slices that colour is written in.
    """

    shape: Shape
    weights: Weights
    given: Mapping[str, Given]
    slices_out: int = eight_bit.SLICES_OUT
    layers: dict[str, Layer] = field(default_factory=dict)
    _random: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))

    def conv(self, name: str, values: Values) -> Values:
        weights, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        signed = self._signed(name, len(bias))
        inputs, outputs, exact = [], [], []
        for image, codes in zip(values.exact, values.codes, strict=True):
            result = F.conv2d(image, weights, bias, padding=1)
            pixels = torch.randperm(result[0, 0].numel(), generator=self._random)[:PIXELS]
            inputs.append(_around(codes, pixels))
            outputs.append(result[0].flatten(1)[:, pixels].T)
            result[:, :signed].relu_()
            exact.append(result)
        of_codes, given = (
            w[:, values.how.of] * values.how.worth[:, None, None] for w in (weights, self.given_as(name, weights))
        )
        near = torch.cat([of_codes.flatten(1), bias[:, None]], dim=1)
        chosen, step, bias = nearest_steps(torch.cat(inputs), torch.cat(outputs), near, given.flatten(1))
        how, begins = self._written(name, exact, signed)
        layer = self.layers[name] = Layer(chosen.reshape(of_codes.shape), step, bias, values.how, how, begins)
        return Values(exact, [layer(codes) for codes in values.codes], how)

    def given_as(self, name: str, weights: Tensor) -> Tensor:
        """A convolution's given weights with zeros where there are none, as many as there are weights."""
        result = torch.zeros_like(weights)
        if given := self.given.get(name):
            result[: len(given.rows), : len(given.columns)] = given.weight[given.rows][:, given.columns]
        return result

    def _signed(self, name: str, count: int) -> int:
        """The first of a layer's outputs that no ReLU follows: those beside the U-Net's own."""
        if name in SIDE:
            return 0
        return COLOURS if name == self.shape.last else count

    def _seen_of(self, name: str) -> Tensor:
        """Power that the colours get of noise of power 1 in each channel of a layer of the last level, as if no ReLU
        followed."""
        level = self.shape.up[-1]
        result = torch.zeros(len(self.weights[f"{self.shape.last}.bias"]))
        result[:COLOURS] = 1
        for reader in (self.shape.last, *level[: level.index(name) : -1]):
            result = result @ self.weights[f"{reader}.weight"].square().sum(dim=(2, 3))
        return result

    def _written(self, name: str, exact: list[Tensor], signed: int) -> tuple[Codes, Tensor]:
        """How a layer's values are written, and where the slices begin."""
        count = len(exact[0][0])
        if name == self.shape.last or signed < count:
            tops, slices = torch.ones(signed), torch.full((signed,), self.slices_out)
        else:
            tops = torch.stack([_quantile(image[0].flatten(1), REACH) for image in exact]).amax(dim=0)
            tops = tops.clamp_min(1e-3 * tops.max())
            tops = tops**OWN_RANGE * tops.max() ** (1 - OWN_RANGE)
            slices = torch.ones(signed, dtype=torch.long)
            if name in self.shape.up[-1]:
                further = FURTHER_OF_LARGER if self.shape is LARGER else FURTHER
                slices = least_noise(self._seen_of(name) * tops**2, further)
        # The first slice of all, the second of those that have one ...
        nth, of = (torch.arange(int(slices.sum()))[:, None] < slices).nonzero(as_tuple=True)
        width = (tops / slices)[of]
        begins, worth = nth * width, width / 255
        beside = torch.arange(signed, count)
        of = torch.cat([of, beside])
        worth = torch.cat([worth, torch.full(beside.shape, 2 * SIGNED_RANGE / 255)])
        begins = torch.cat([begins, torch.full(beside.shape, -SIGNED_ZERO * 2 * SIGNED_RANGE / 255)])
        if name == self.shape.last or signed < count:
            of, worth, begins = (F.pad(x, (0, -len(x) % 16), value=x[0]) for x in (of, worth, begins))
        return Codes(worth, of), begins


def least_noise(noise: Tensor, further: int) -> Tensor:
    """Of how many slices each channel should be made, so many more than there are channels, where one slice has some
    noise and n have a share of 1 / n² of it."""
    slices = torch.ones(len(noise), dtype=torch.long)
    for _ in range(further):
        slices[(noise * (1 / slices**2 - 1 / (slices + 1) ** 2)).argmax()] += 1
    return slices


def _quantile(values: Tensor, share: float) -> Tensor:
    """Of each row."""
    return values.kthvalue(max(round(share * values.shape[1]), 1), dim=1).values


def _around(image: Tensor, pixels: Tensor) -> Tensor:
    """The 3 x 3 pixels around some of an image (1, C, H, W): (P, 9 C), ordered as a convolution's weights."""
    width = image.shape[3]
    padded, rows, columns = F.pad(image[0], (1, 1, 1, 1)), pixels // width, pixels % width
    parts = [padded[:, rows + y, columns + x] for y in range(3) for x in range(3)]
    return torch.stack(parts, dim=1).flatten(0, 1).T


def nearest_steps(inputs: Tensor, outputs: Tensor, weights: Tensor, given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of -STEPS to STEPS whole steps that make the outputs of the inputs.

    Args:
        inputs: (P, K).
        outputs: (P, O).
        weights: (O, K + 1) that nearly do; bias last.
        given: (O, K), from which no weight may be more than STEPS away.

    Returns:
        Whole numbers (O, K), the size of a step (O), bias (O).
    """
    count = inputs.shape[1]
    x = torch.cat([inputs, torch.ones(len(inputs), 1)], dim=1).double()
    power = x.T @ x / len(x)
    damping = torch.diag(DAMPING * count / len(x) * power.diagonal() + 1e-6 * power.diagonal().mean())
    damping[count, count] = 1e-9
    original = weights.double()
    weights = torch.linalg.solve(power + damping, x.T @ outputs.double() / len(x) + damping @ original.T).T
    # Not so small that biases in steps would not fit into 32 bits
    step = (weights[:, :count].abs().amax(dim=1) / STEPS).clamp_min(1e-8)
    # Strong inputs first, while there are others to make good for their error; the bias last, which is not rounded
    order = torch.cat([power.diagonal()[:count].argsort(descending=True), torch.tensor([count])])
    inverse = torch.cholesky_inverse(torch.linalg.cholesky((power + damping)[order][:, order]))
    upper = torch.linalg.cholesky(inverse, upper=True)
    rest, chosen = weights[:, order].clone(), torch.zeros(len(weights), count, dtype=torch.double)
    for i in range(count):
        nearest = (given[:, order[i]].double() / step).round()
        steps = torch.clamp((rest[:, i] / step).round(), nearest - STEPS, nearest + STEPS)  # the rest is kept in 8 bits
        chosen[:, order[i]] = steps.clamp(-STEPS, STEPS)
        error = (rest[:, i] - chosen[:, order[i]] * step) / upper[i, i]
        rest[:, i:] -= error[:, None] * upper[i, i:]
    return chosen.float(), step.float(), rest[:, count].float()


def walk_values(shape: Shape, pictures: Sequence[Values], conv: Callable[[str, Values], Values]) -> Values:
    """A U-Net on values and their codes."""

    def each(change: Callable[[Tensor], Tensor], values: Values) -> Values:
        return Values([change(i) for i in values.exact], [change(i) for i in values.codes], values.how)

    def join(one: Values, other: Values) -> Values:
        exact, codes = (
            [torch.cat(pair, dim=1) for pair in zip(*images, strict=True)]
            for images in ((one.exact, other.exact), (one.codes, other.codes))
        )
        of = torch.cat([one.how.of, other.how.of + one.exact[0].shape[1]])
        return Values(exact, codes, Codes(torch.cat([one.how.worth, other.how.worth]), of))

    with torch.no_grad():
        return walk(
            shape,
            pictures,
            conv,
            halve=lambda values: each(lambda image: F.max_pool2d(image, 2), values),
            double=lambda values: each(lambda image: F.interpolate(image, scale_factor=2), values),
            join=join,
        )


def quantise(name: str, weights: Weights, given: Weights, pictures: Sequence[Layers]) -> Fit:
    """A network in 8 bits.

    Args:
        name: a key of ``SHAPES``.
        weights: in full precision.
        given: Open Image Denoise's own, which it is written as a difference from.
        pictures: what it reads.
    """
    fit = Fit(SHAPES[name], weights, Given.of(given))
    exact, codes = (list(images) for images in zip(*map(picture, pictures), strict=True))
    walk_values(fit.shape, [Values(exact, codes, codes_of_pictures(set(pictures[0])))], fit.conv)
    return fit


# The graph


class Graph:
    """What ONNX Runtime runs: height, width and channels in this order, codes from the first layer to the last."""

    def __init__(self, fit: Fit) -> None:
        self.fit = fit
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: dict[str, np.ndarray] = {
            "one": np.float32(1), "zero": np.uint8(0), "no_offset": np.int8(0)
        }  # fmt: skip
        self.open: list[onnx.TensorProto] = []

    def model(self) -> onnx.ModelProto:
        """Of one of Open Image Denoise's own."""
        self.colours(["layers"], "codes")
        return self.finished(
            "oidn",
            [helper.make_tensor_value_info("layers", TensorProto.UINT8, [1, "h", "w", eight_bit.CHANNELS_IN])],
            [helper.make_tensor_value_info("codes", TensorProto.INT32, [1, "h", "w", 3])],
        )

    def finished(
        self, name: str, inputs: list[onnx.ValueInfoProto], outputs: list[onnx.ValueInfoProto]
    ) -> onnx.ModelProto:
        values = (numpy_helper.from_array(np.asarray(v), k) for k, v in self.initializers.items())
        graph = helper.make_graph(self.nodes, name, inputs, outputs, [*self.open, *values])
        opsets = [helper.make_opsetid("", 18), helper.make_opsetid("com.microsoft", 1)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=9)

    def colours(self, pictures: list[str], output: str) -> str:
        """The U-Net, and the sum of the slices that its last layer makes; what it makes of pictures by level."""
        last = walk(self.fit.shape, pictures, self.conv, self._halved, self._doubled, self._joined)
        outputs = self.fit.layers[last].outputs
        all_slices = np.zeros((len(outputs.of), COLOURS), np.int8)
        rows = np.arange(COLOURS * self.fit.slices_out)
        all_slices[rows, rows % COLOURS] = 1
        self.initializers["all_slices"] = all_slices
        return self._add("MatMulInteger", [last, "all_slices", "zero", "no_offset"], output)

    def _add(self, kind: str, inputs: list[str], output: str, **attributes: object) -> str:
        domain = "com.microsoft" if kind in ("QLinearConv", "NhwcMaxPool") else ""
        self.nodes.append(helper.make_node(kind, inputs, [output], domain=domain, name=output, **attributes))
        return output

    def _constant(self, name: str, values: np.ndarray) -> str:
        self.initializers[name] = values
        return name

    def _left_open(self, name: str, values: np.ndarray, rows: np.ndarray) -> str:
        """Some rows of a tensor that whoever loads the graph has."""
        tensor = TensorProto(name=name, data_type=TensorProto.FLOAT16, dims=values.shape)
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="oidn")
        self.open.append(tensor)
        if len(rows) < len(values):
            name = self._add("Gather", [name, self._constant(f"{name}.kept", rows)], f"{name}.rows", axis=0)
        return self._add("Cast", [name], f"{name}.float", to=TensorProto.FLOAT)

    def conv(self, name: str, values: str) -> str:
        """A convolution. Its weights are computed when the graph is loaded: in steps, rounded, and what is added."""
        layer, given = self.fit.layers[name], self.fit.given.get(name)
        steps, outputs = layer.step.numpy(), layer.outputs
        whole, bias = layer.weights.numpy().astype(np.int8), np.round(layer.bias.numpy() / steps).astype(np.int32)
        if given is None:
            weights, biases = self._constant(f"{name}.weight", whole), self._constant(f"{name}.bias", bias)
        else:
            rows, columns = np.array(given.rows), np.array(given.columns)
            known = layer.inputs.of.numpy() < len(columns)  # of the others, nothing is given
            of = columns[np.where(known, layer.inputs.of.numpy(), 0)]
            worth = np.where(known, layer.inputs.worth.numpy(), 0).astype(np.float32)
            original = self._left_open(f"{name}.weight", given.weight.numpy(), rows)
            original = self._add("Gather", [original, self._constant(f"{name}.of", of)], f"{name}.weight.of", axis=1)
            worths = self._constant(f"{name}.worth", worth[None, :, None, None])
            original = self._add("Mul", [original, worths], f"{name}.weight.in_codes")
            near = given.weight.numpy()[rows][:, of] * worth[:, None, None]
            weights = self._whole(original, near, whole, steps[:, None, None, None])
            original = self._left_open(f"{name}.bias", given.bias.numpy(), rows)
            biases = self._whole(original, given.bias.numpy()[rows], bias, steps)
        if len(outputs.of) > len(steps):  # slices, one behind the other: biases are less by where a slice begins
            of, steps = self._constant(f"{name}.slices", outputs.of.numpy()), steps[outputs.of.numpy()]
            begins = self._constant(f"{name}.begins", np.round(layer.begins.numpy() / steps).astype(np.int32))
            weights = self._add("Gather", [weights, of], f"{name}.weight.sliced")
            biases = self._add(
                "Sub", [self._add("Gather", [biases, of], f"{name}.bias.sliced"), begins], f"{name}.bias.begun"
            )
        scales = self._constant(f"{name}.scale", steps / outputs.worth.numpy())
        offsets = self._constant(f"{name}.offset", np.zeros(len(steps), np.int8))
        return self._add(
            "QLinearConv",
            [values, "one", "zero", weights, scales, offsets, "one", "zero", biases],
            name,
            channels_last=1,
            kernel_shape=[3, 3],
            pads=[1, 1, 1, 1],
        )

    def _whole(self, name: str, near: np.ndarray, chosen: np.ndarray, steps: np.ndarray) -> str:
        """What was chosen, kept as how much more that is than the original in the nearest whole steps; where there are
        fewer originals than were chosen, the rest as it is."""
        count = len(near)
        in_steps = self._add("Div", [name, self._constant(f"{name}.step", steps[:count])], f"{name}.in_steps")
        nearest = self._add("Round", [in_steps], f"{name}.nearest")
        more = self._constant(f"{name}.more", (chosen[:count] - np.round(near / steps[:count])).astype(chosen.dtype))
        added = self._add("Cast", [more], f"{name}.added", to=TensorProto.FLOAT)
        kind = TensorProto.INT8 if chosen.dtype == np.int8 else TensorProto.INT32
        whole = self._add("Cast", [self._add("Add", [nearest, added], f"{name}.chosen")], f"{name}.whole", to=kind)
        if count == len(chosen):
            return whole
        rest = self._constant(f"{name}.rest", chosen[count:])
        return self._add("Concat", [whole, rest], f"{name}.all", axis=0)

    def _halved(self, values: str) -> str:
        return self._add("NhwcMaxPool", [values], f"{values}.halved", kernel_shape=[2, 2], strides=[2, 2])

    def _doubled(self, values: str) -> str:
        """Every pixel four times; of a layer."""
        return self.enlarged(values, len(self.fit.layers[values].outputs.of), 2)

    def enlarged(self, values: str, channels: int, factor: int) -> str:
        """Every pixel as a square of so many across."""
        height_width = self._add("Shape", [values], f"{values}.small", start=1, end=3)
        factors, one = self._constant(f"by{factor}", np.array([factor, factor])), self._constant("only", np.array([1]))
        count = self._constant(f"{values}.channels", np.array([channels]))
        large = self._add(
            "Concat",
            [one, self._add("Mul", [height_width, factors], f"{values}.times"), count],
            f"{values}.shape",
            axis=0,
        )
        apart = self._add("Unsqueeze", [values, self._constant("apart", np.array([2, 4]))], f"{values}.apart")
        squares = self._constant(f"squares{factor}", np.array([1, 1, factor, 1, factor, 1]))
        return self._add(
            "Reshape", [self._add("Expand", [apart, squares], f"{values}.squares"), large], f"{values}.large"
        )

    def _joined(self, one: str, other: str) -> str:
        return self._add("Concat", [one, other], f"{one}+{other}", axis=3)


def pictures(views: Path, split: str, name: str, count: int) -> Iterator[Layers]:
    """What a network reads of views, drawn as training draws them."""
    denoiser = Denoiser(exact=True)
    rng = np.random.default_rng(0)
    folder = [batches.Pixels.of(view, torch.device("cpu")) for view in Folder(views).split(split)]
    left_out = 0
    while count:
        with torch.no_grad():
            scale = 2 if name == "albedo" else int(rng.choice(SCALES))
            batch = batches.draw(folder, scale, PATCH, 1, rng, data.Sampling())
        lrhs, hrls = (batch[key][0].permute(1, 2, 0).numpy() for key in ("lrhs", "hrls"))
        layers = layers_of(hrls)
        if name == "together":
            layers = merged(lrhs, layers_of(hrls, complete=True))
        elif name == "large":
            layers = denoiser.merged(lrhs, layers)
        elif name == "albedo" and "albedo" in layers:
            albedo = transforms.box_downsample(layers["albedo"], scale)
            # Depth of field, hair and glass make it noisier than these views are
            noise = rng.normal(0, rng.choice([0, 0, 0.1, 0.3]), albedo.shape)
            layers = {"albedo": (albedo + noise).clip(0, 1).astype(np.float32)}
        if layers.keys() == eight_bit.READS[name]:
            count, left_out = count - 1, 0
            yield layers
        elif (left_out := left_out + 1) > PATIENCE:
            raise SystemExit(f"{views}: hardly any view for {split} has what {name} reads, albedo and normal above all")


def compare(name: str, network: eight_bit.EightBit, views: Path, together: Together) -> None:
    """Print how near it comes on views for validation to the same in 32 bits: Open Image Denoise, or ours."""
    exact = Denoiser(exact=True)
    peers = {"usual": exact.hrls, "large": exact.both, "albedo": exact.albedo, "together": together.denoised}
    peer = peers[name]
    seen = pictures(views, "validation", name, 24)
    differences = [np.abs(network(**layers) - peer(layers)).mean() for layers in seen]
    print(f"{name}: mean difference in network values {np.mean(differences):.4f}, at most {np.max(differences):.4f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--networks", nargs="+", choices=SHAPES, default=list(SHAPES))
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="of a joint network, for together")
    args = parser.parse_args()
    together = Together.of(args.checkpoint)
    for name in args.networks:
        original = "large" if name == "together" else name
        given = given_weights(original)
        weights = together.weights() if name == "together" else given
        images = list(pictures(args.views, "train", name, PICTURES))
        onnx.save(Graph(quantise(name, weights, given, images)).model(), FOLDER / f"{name}.onnx")
        compare(name, eight_bit.EightBit(name, installed_weights(original)), args.views, together)


if __name__ == "__main__":
    main()
