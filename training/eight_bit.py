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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from oiio_msspl import eight_bit
from oiio_msspl.denoiser import Denoiser, Layers, installed_library, layers_of
from oiio_msspl.schema import SCALES
from training import batches, data

FOLDER = Path(__file__).parent.parent / "oiio_msspl" / "denoisers"
#: Pictures that are learnt from, and the pixels of each that a layer's weights are fitted to.
PICTURES, PIXELS, PATCH = 64, 4000, 256
#: Share of a layer's values, in every picture, that its 8 bits reach beyond.
REACH = 0.9995
#: How far the channels of a layer have ranges of their own: 1, each its own; 0, all the largest. Between them, neither
#: the values of a weak channel nor the weights that read it have too few steps.
OWN_RANGE = 0.5
#: Strength of what keeps fitted weights near the original ones, against the power of their input.
DAMPING = 0.01
STEPS = 127
#: Bounds of the slices that the last layer but one is written in, as shares of its range: what is rounded there is seen
#: as it is.
FINE_BOUNDS = (0.0, 0.5, 1.0)


@dataclass(frozen=True)
class Shape:
    """Names of a U-Net's convolutions, all 3 x 3 and followed by a ReLU: of each level down, at the bottom, of each
    level up (which reads the level below, enlarged, and what went into the level down), and the one that makes colour.
    """

    down: list[list[str]]
    bottom: list[str]
    up: list[list[str]]
    last: str


_SMALLER = Shape(
    [["enc_conv0", "enc_conv1"], ["enc_conv2"], ["enc_conv3"], ["enc_conv4"]],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv0",
)
SHAPES = {
    "usual": _SMALLER,
    "albedo": _SMALLER,
    "large": Shape(
        [[f"enc_conv{level}{part}" for part in "ab"] for level in (1, 2, 3, 4)],
        ["enc_conv5a", "enc_conv5b"],
        [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
        "dec_conv1c",
    ),
}


T = TypeVar("T")


def walk(
    shape: Shape, picture: T, conv: Callable[[str, T], T], halve: Callable[[T], T], join: Callable[[T, T], T]
) -> T:
    """A U-Net on anything: tensors, lists of them, names of a graph. ``join`` enlarges its first argument."""
    values, skipped = picture, []
    for level in shape.down:
        skipped.append(values)
        for name in level:
            values = conv(name, values)
        values = halve(values)
    for name in shape.bottom:
        values = conv(name, values)
    for level in shape.up:
        values = join(values, skipped.pop())
        for name in level:
            values = conv(name, values)
    return conv(shape.last, values)


# Choosing the weights


@dataclass
class Codes:
    """How values are written in 8 bits: each channel of codes is ``worth`` so much a code, and a part of the channel
    ``of`` the values. Several channels of codes are slices of one value's range, which they are the sum of."""

    worth: Tensor
    of: Tensor


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
    how = codes_of_pictures(alone="colour" not in layers)
    codes = torch.from_numpy(eight_bit.pack(**layers)).permute(2, 0, 1).float()
    values = torch.zeros(int(how.of.max()) + 1, *codes.shape[1:])
    return values.index_add_(0, how.of, codes * how.worth[:, None, None])[None], codes[None]


def codes_of_pictures(*, alone: bool) -> Codes:
    """As :func:`oiio_msspl.eight_bit.pack` writes them: of an albedo alone, or of three layers."""
    slices, whole = (eight_bit.SLICES_OF_ALBEDO, 0) if alone else (eight_bit.SLICES_IN, 6)
    worth = [1 / slices / 255] * (3 * slices) + [1 / 255] * whole + [0.0]
    return Codes(torch.tensor(worth), torch.tensor([*np.repeat(range(3), slices), *range(3, 3 + whole), 0]))


@dataclass
class Fit:
    """Layer after layer in 8 bits."""

    shape: Shape
    weights: dict[str, Tensor]
    layers: dict[str, Layer] = field(default_factory=dict)
    _random: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))

    def conv(self, name: str, values: Values) -> Values:
        weights, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        inputs, outputs, exact = [], [], []
        for image, codes in zip(values.exact, values.codes, strict=True):
            result = F.conv2d(image, weights, bias, padding=1)
            pixels = torch.randperm(result[0, 0].numel(), generator=self._random)[:PIXELS]
            inputs.append(_around(codes, pixels))
            outputs.append(result[0].flatten(1)[:, pixels].T)
            exact.append(result.relu_())
        of_codes = weights[:, values.how.of] * values.how.worth[:, None, None]
        near = torch.cat([of_codes.flatten(1), bias[:, None]], dim=1)
        chosen, step, bias = nearest_steps(torch.cat(inputs), torch.cat(outputs), near)
        how, begins = self._written(name, exact)
        layer = self.layers[name] = Layer(chosen.reshape(of_codes.shape), step, bias, values.how, how, begins)
        return Values(exact, [layer(codes) for codes in values.codes], how)

    def _written(self, name: str, exact: list[Tensor]) -> tuple[Codes, Tensor]:
        """How a layer's values are written, and where the slices begin."""
        count = len(exact[0][0])
        if name == self.shape.last:
            tops, bounds = torch.ones(count), torch.linspace(0, 1, eight_bit.SLICES_OUT + 1)
        else:
            tops = torch.stack([_quantile(image[0].flatten(1), REACH) for image in exact]).amax(dim=0)
            tops = tops.clamp_min(1e-3 * tops.max())
            tops = tops**OWN_RANGE * tops.max() ** (1 - OWN_RANGE)
            bounds = torch.tensor(FINE_BOUNDS if name == self.shape.up[-1][-1] else (0.0, 1.0))
        of = torch.arange(count).repeat(len(bounds) - 1)
        worth, begins = ((share[:, None] * tops).flatten() for share in (bounds.diff() / 255, bounds[:-1]))
        if name == self.shape.last:
            of, worth, begins = (
                F.pad(x, (0, eight_bit.CHANNELS_OUT - len(x)), value=x[0]) for x in (of, worth, begins)
            )
        return Codes(worth, of), begins


def _quantile(values: Tensor, share: float) -> Tensor:
    """Of each row."""
    return values.kthvalue(max(round(share * values.shape[1]), 1), dim=1).values


def _around(image: Tensor, pixels: Tensor) -> Tensor:
    """The 3 x 3 pixels around some of an image (1, C, H, W): (P, 9 C), ordered as a convolution's weights."""
    width = image.shape[3]
    padded, rows, columns = F.pad(image[0], (1, 1, 1, 1)), pixels // width, pixels % width
    parts = [padded[:, rows + y, columns + x] for y in range(3) for x in range(3)]
    return torch.stack(parts, dim=1).flatten(0, 1).T


def nearest_steps(inputs: Tensor, outputs: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of -STEPS to STEPS whole steps that make the outputs of the inputs.

    Args:
        inputs: (P, K).
        outputs: (P, O).
        weights: (O, K + 1) that nearly do; bias last.

    Returns:
        Whole numbers (O, K), the size of a step (O), bias (O).
    """
    count = inputs.shape[1]
    x = torch.cat([inputs, torch.ones(len(inputs), 1)], dim=1).double()
    power = x.T @ x / len(x)
    damping = torch.diag(DAMPING * power.diagonal() + 1e-6 * power.diagonal().mean())
    damping[count, count] = 1e-9
    original = weights.double()
    weights = torch.linalg.solve(power + damping, x.T @ outputs.double() / len(x) + damping @ original.T).T
    step = weights[:, :count].abs().amax(dim=1).clamp_min(1e-12) / STEPS
    # Strong inputs first, while there are others to make good for their error; the bias last, which is not rounded
    order = torch.cat([power.diagonal()[:count].argsort(descending=True), torch.tensor([count])])
    inverse = torch.cholesky_inverse(torch.linalg.cholesky((power + damping)[order][:, order]))
    upper = torch.linalg.cholesky(inverse, upper=True)
    rest, chosen = weights[:, order].clone(), torch.zeros(len(weights), count, dtype=torch.double)
    for i in range(count):
        nearest = (original[:, order[i]] / step).round()
        steps = torch.clamp((rest[:, i] / step).round(), nearest - STEPS, nearest + STEPS)  # the rest is kept in 8 bits
        chosen[:, order[i]] = steps.clamp(-STEPS, STEPS)
        error = (rest[:, i] - chosen[:, order[i]] * step) / upper[i, i]
        rest[:, i:] -= error[:, None] * upper[i, i:]
    return chosen.float(), step.float(), rest[:, count].float()


def quantise(name: str, weights: dict[str, Tensor], pictures: Sequence[tuple[Tensor, Tensor]]) -> Fit:
    """A network in 8 bits.

    Args:
        name: a key of ``SHAPES``.
        weights: in full precision.
        pictures: see :func:`picture`.
    """
    fit = Fit(SHAPES[name], weights)

    def halve(values: Values) -> Values:
        exact, codes = ([F.max_pool2d(i, 2) for i in images] for images in (values.exact, values.codes))
        return Values(exact, codes, values.how)

    def join(below: Values, skipped: Values) -> Values:
        exact, codes = (
            [torch.cat([F.interpolate(b, scale_factor=2), s], dim=1) for b, s in zip(*both, strict=True)]
            for both in ((below.exact, skipped.exact), (below.codes, skipped.codes))
        )
        of = torch.cat([below.how.of, skipped.how.of + below.exact[0].shape[1]])
        return Values(exact, codes, Codes(torch.cat([below.how.worth, skipped.how.worth]), of))

    exact, codes = (list(images) for images in zip(*pictures, strict=True))
    how = codes_of_pictures(alone=name == "albedo")
    with torch.no_grad():
        walk(SHAPES[name], Values(exact, codes, how), fit.conv, halve, join)
    return fit


# The graph


class Graph:
    """What ONNX Runtime runs: height, width and channels in this order, codes from the first layer to the last."""

    def __init__(self, name: str, fit: Fit) -> None:
        self._shape, self._fit = SHAPES[name], fit
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: dict[str, np.ndarray] = {
            "one": np.float32(1), "zero": np.uint8(0), "no_offset": np.int8(0),
            "all_slices": np.eye(3, dtype=np.int8)[np.arange(eight_bit.CHANNELS_OUT) % 3],
        }  # fmt: skip
        self.initializers["all_slices"][3 * eight_bit.SLICES_OUT :] = 0
        self.open: list[onnx.TensorProto] = []

    def model(self) -> onnx.ModelProto:
        colour = walk(self._shape, "layers", self._conv, self._halved, self._joined)
        self._add("MatMulInteger", [colour, "all_slices", "zero", "no_offset"], "codes")
        graph = helper.make_graph(
            self.nodes,
            "oidn",
            [helper.make_tensor_value_info("layers", TensorProto.UINT8, [1, "h", "w", eight_bit.CHANNELS_IN])],
            [helper.make_tensor_value_info("codes", TensorProto.INT32, [1, "h", "w", 3])],
            [*self.open, *(numpy_helper.from_array(np.asarray(v), k) for k, v in self.initializers.items())],
        )
        opsets = [helper.make_opsetid("", 18), helper.make_opsetid("com.microsoft", 1)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=9)

    def _add(self, kind: str, inputs: list[str], output: str, **attributes: object) -> str:
        domain = "com.microsoft" if kind in ("QLinearConv", "NhwcMaxPool") else ""
        self.nodes.append(helper.make_node(kind, inputs, [output], domain=domain, name=output, **attributes))
        return output

    def _constant(self, name: str, values: np.ndarray) -> str:
        self.initializers[name] = values
        return name

    def _left_open(self, name: str, shape: tuple[int, ...]) -> str:
        tensor = TensorProto(name=name, data_type=TensorProto.FLOAT16, dims=shape)
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="oidn")
        self.open.append(tensor)
        return self._add("Cast", [name], f"{name}.float", to=TensorProto.FLOAT)

    def _conv(self, name: str, values: str) -> str:
        """A convolution. Its weights are computed when the graph is loaded: in steps, rounded, and what is added."""
        layer, shape = self._fit.layers[name], self._fit.weights[f"{name}.weight"].shape
        steps, inputs, outputs = layer.step.numpy(), layer.inputs, layer.outputs
        original = self._left_open(f"{name}.weight", shape)
        of = self._constant(f"{name}.of", inputs.of.numpy())
        worth = self._constant(f"{name}.worth", inputs.worth[None, :, None, None].numpy())
        original = self._add("Gather", [original, of], f"{name}.weight.of", axis=1)
        original = self._add("Mul", [original, worth], f"{name}.weight.in_codes")
        near = self._fit.weights[f"{name}.weight"][:, inputs.of].numpy() * inputs.worth[:, None, None].numpy()
        weights = self._whole(original, near, layer.weights.numpy().astype(np.int8), steps[:, None, None, None])
        bias = np.round(layer.bias.numpy() / steps).astype(np.int32)
        original = self._left_open(f"{name}.bias", bias.shape)
        biases = self._whole(original, self._fit.weights[f"{name}.bias"].numpy(), bias, steps)
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
        """What was chosen, kept as how much more that is than the original in the nearest whole steps."""
        in_steps = self._add("Div", [name, self._constant(f"{name}.step", steps)], f"{name}.in_steps")
        nearest = self._add("Round", [in_steps], f"{name}.nearest")
        more = self._constant(f"{name}.more", (chosen - np.round(near / steps)).astype(chosen.dtype))
        added = self._add("Cast", [more], f"{name}.added", to=TensorProto.FLOAT)
        kind = TensorProto.INT8 if chosen.dtype == np.int8 else TensorProto.INT32
        return self._add("Cast", [self._add("Add", [nearest, added], f"{name}.chosen")], f"{name}.whole", to=kind)

    def _halved(self, values: str) -> str:
        return self._add("NhwcMaxPool", [values], f"{values}.halved", kernel_shape=[2, 2], strides=[2, 2])

    def _joined(self, below: str, skipped: str) -> str:
        """What lies below, every pixel four times, and what was skipped, by channels."""
        name = f"{below}+{skipped}"
        height_width = self._add("Shape", [below], f"{name}.small", start=1, end=3)
        two, one = self._constant("two", np.array([2, 2])), self._constant("only", np.array([1]))
        channels = self._constant(f"{name}.channels", np.array([len(self._fit.layers[below].outputs.of)]))
        large = self._add(
            "Concat", [one, self._add("Mul", [height_width, two], f"{name}.twice"), channels], f"{name}.shape", axis=0
        )
        apart = self._add("Unsqueeze", [below, self._constant("apart", np.array([2, 4]))], f"{name}.apart")
        four = self._add("Expand", [apart, self._constant("four", np.array([1, 1, 2, 1, 2, 1]))], f"{name}.four")
        return self._add("Concat", [self._add("Reshape", [four, large], f"{name}.large"), skipped], name, axis=3)


def pictures(views: Path, split: str, name: str, count: int) -> Iterator[Layers]:
    """What a network reads of views, drawn as training draws them."""
    ways = {mode: Denoiser(mode=mode, exact=True) for mode in ("high", "low")}
    rng = np.random.default_rng(0)
    folder = [batches.Pixels.of(view, torch.device("cpu")) for view in data.Folder(views).split(split)]
    while count:
        with torch.no_grad():
            scale = 2 if name == "albedo" else int(rng.choice(SCALES))
            batch = batches.draw(folder, scale, PATCH, 1, rng, data.Sampling())
        lrhs, hrls = (batch[key][0].permute(1, 2, 0).numpy() for key in ("lrhs", "hrls"))
        layers = layers_of(hrls)
        if name == "large":
            layers = ways["high"].merged(lrhs, layers)
        elif name == "albedo" or count % 4 == 0:  # the usual one denoises both together, too
            layers = ways["low"].merged(lrhs, layers)
        if name == "albedo":
            layers = {key: image for key, image in layers.items() if key == "albedo"}
            # Depth of field, hair and glass make it noisier than these views are
            noise = rng.normal(0, rng.choice([0, 0, 0.1, 0.3]), next(iter(layers.values()), np.zeros(1)).shape)
            layers = {key: (image + noise).clip(0, 1).astype(np.float32) for key, image in layers.items()}
        if len(layers) == (1 if name == "albedo" else 3):
            count -= 1
            yield layers


def compare(name: str, network: eight_bit.EightBit, views: Path) -> None:
    """Print how near it comes to Open Image Denoise on views for validation."""
    exact = Denoiser(exact=True)
    peer = {"usual": exact.hrls, "large": exact.both, "albedo": exact.albedo}[name]
    seen = pictures(views, "validation", name, 24)
    differences = [np.abs(network(**layers) - peer(layers)).mean() for layers in seen]
    print(f"{name}: mean difference in network values {np.mean(differences):.4f}, at most {np.max(differences):.4f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("--networks", nargs="+", choices=SHAPES, default=list(SHAPES))
    args = parser.parse_args()
    library = installed_library()
    for name in args.networks:
        halves = eight_bit.weights_of(name, library) if library else None
        if halves is None:
            raise SystemExit(f"{library}: has not the weights that oiio_msspl.eight_bit names; install pyoidn 2.5.1")
        weights = {key: torch.from_numpy(values.astype(np.float32)) for key, values in halves.items()}
        images = [picture(layers) for layers in pictures(args.views, "train", name, PICTURES)]
        onnx.save(Graph(name, quantise(name, weights, images)).model(), FOLDER / f"{name}.onnx")
        compare(name, eight_bit.EightBit(name, halves), args.views)


if __name__ == "__main__":
    main()
