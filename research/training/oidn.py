# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's U-Nets in PyTorch: their layout, their weights, and how to fine-tune them.

A fine-tuned network stores the difference from Open Image Denoise's weights, which are read from the installed library.
No file of this project holds the original weights.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import mmap
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from oiio_msspl.errors import InputError
from research.training.ops import upsample

#: Open Image Denoise's names of its networks for HDR colour with albedo and normal; the large one wants these clean.
SMALL_HDR, BASE_HDR, LARGE_HDR = "rt_hdr_alb_nrm_small", "rt_hdr_alb_nrm", "rt_hdr_calb_cnrm_large"
#: The small one for clean albedo and normal, and those for albedo and for normal alone.
SMALL_CLEAN_HDR = "rt_hdr_calb_cnrm_small"
ALBEDO_BASE, NORMAL_BASE = "rt_alb", "rt_nrm"

#: Networks of Open Image Denoise 2.5, with the size in bytes and the SHA-256 of their weights.
NETWORKS = {
    BASE_HDR: (1841160, "e586ef2ff48d7fbb7611986405220ed8fc5c13ca79bfc40be4dc742fbf959e1a"),
    SMALL_HDR: (641480, "980ea307e7825cae23ed8b1addf8de62ece84b61094795a5631ebf1c91b2e1a7"),
    SMALL_CLEAN_HDR: (641480, "a6c43bfdbff01bdd8a9c777e139720f9e58b872a50c8db07079bddd007482dc5"),
    LARGE_HDR: (7698439, "08130cdc4f33b7a513d0073757f089ac830f900613bb5bad72ca42c52b934465"),
    ALBEDO_BASE: (1830792, "752c9a8d57884d660ae375a7c853cad8a44f77d559bb282f0ef39f8e758601a4"),
    NORMAL_BASE: (1830792, "fb8f7f5571332b602406f88a0b570d809dd3c06aebb530f5d048828f57490bc7"),
}

_TZA_MAGIC = b"\xd7\x41\x02"

Weights = Mapping[str, Tensor]


@functools.cache
def pretrained_weights(network: str) -> dict[str, Tensor]:
    """Read the weights of a key of `NETWORKS` from the installed pyoidn, by Open Image Denoise's names.

    Every call returns the same tensors, which nobody changes.

    Raises:
        InputError: pyoidn is not installed, or has other weights.
    """
    begins, install = "the joint network begins from the weights of Open Image Denoise", "pip install pyoidn==2.5.1"
    try:
        import pyoidn
    except (ImportError, OSError) as error:
        raise InputError(f"{begins}: {install}") from error
    library = next(Path(pyoidn.__file__).parent.rglob("*OpenImageDenoise_core*"), None)
    weights = read_weights(network, library) if library else None
    if weights is None:
        raise InputError(f"{begins} 2.5, and the installed pyoidn has others: {install}")
    return {name: torch.from_numpy(values.astype(np.float32)) for name, values in weights.items()}


def read_weights(network: str, library: Path) -> dict[str, NDArray[np.float16]] | None:
    """Find a network's weights in a library file by their digest; None if they are not in it."""
    size, digest = NETWORKS[network]
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(_TZA_MAGIC)
        while start >= 0:
            blob = content[start : start + size]
            if hashlib.sha256(blob).hexdigest() == digest:
                return _read_tza(blob)
            start = content.find(_TZA_MAGIC, start + 1)
    return None


def _read_tza(blob: bytes) -> dict[str, NDArray[np.float16]]:
    """Read tensors in Open Image Denoise's TZA 2 format.

    A header with the position of a table; the table has a name, a shape, a layout, a type and a position for each
    tensor.
    """
    position = 0

    def take(form: str) -> tuple[Any, ...]:
        nonlocal position
        values = struct.unpack_from(f"<{form}", blob, position)
        position += struct.calcsize(f"<{form}")
        return values

    *_, position = take("HBBQ")
    tensors = {}
    for _ in range(*take("I")):
        name = take(f"{take('H')[0]}s")[0].decode()
        dimensions = take("B")[0]
        shape = take(f"{dimensions}I")
        take(f"{dimensions + 1}s")  # layout and type: always contiguous half floats
        (offset,) = take("Q")
        tensors[name] = np.frombuffer(blob, np.float16, int(np.prod(shape)), offset).reshape(shape)
    return tensors


def provenance(network: str) -> dict[str, str]:
    """Return what a model's file says about the weights that its training began from."""
    return {"initial_weights": f"Open Image Denoise 2.5.1, {network} (Apache-2.0)"}


def convolutions(weights: Weights) -> list[str]:
    """Return the names of the convolutions in ``weights``."""
    return [name.removesuffix(".weight") for name in weights if name.endswith(".weight")]


@dataclass(frozen=True)
class Shape:
    """Names of a U-Net's convolutions, all 3 x 3 and followed by a ReLU."""

    down: list[list[str]]
    """Of each level on the way down; max pooling follows each level."""
    bottom: list[str]
    up: list[list[str]]
    """Of each level on the way up, which reads the level below, upsampled, and the input of the same level down."""
    last: str
    """The convolution that returns the colour."""

    @property
    def order(self) -> list[str]:
        """All convolutions in the order in which they run."""
        return [*itertools.chain(*self.down), *self.bottom, *itertools.chain(*self.up), self.last]


#: Small and base networks.
BASE = Shape(
    [["enc_conv0", "enc_conv1"], ["enc_conv2"], ["enc_conv3"], ["enc_conv4"]],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv0",
)
LARGE = Shape(
    [[f"enc_conv{level}{part}" for part in "ab"] for level in (1, 2, 3, 4)],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv1c",
)

T = TypeVar("T")


def run_unet(
    shape: Shape, inputs: Sequence[T], conv: Callable[[str, T], T],
    pool: Callable[[T], T], upsample: Callable[[T], T], concat: Callable[[T, T], T],
) -> T:  # fmt: skip
    """Run a U-Net on any type of value: tensors, lists of tensors, names of a graph's tensors.

    Args:
        inputs: the input at full size, then any at half size, quarter size, ..., which are concatenated to that level.
        conv: run the convolution of a name.
    """
    values, *smaller = inputs
    skipped = []
    for level in shape.down:
        skipped.append(values)
        for name in level:
            values = conv(name, values)
        values = pool(values)
        if smaller:
            values = concat(values, smaller.pop(0))
    for name in shape.bottom:
        values = conv(name, values)
    for level in shape.up:
        values = concat(upsample(values), skipped.pop())
        for name in level:
            values = conv(name, values)
    return conv(shape.last, values)


def run_unet_on_tensors(shape: Shape, inputs: Sequence[Tensor], conv: Callable[[str, Tensor], Tensor]) -> Tensor:
    """Run a U-Net on images (N, C, H, W)."""
    pool, twice = functools.partial(F.max_pool2d, kernel_size=2), functools.partial(upsample, factor=2)
    return run_unet(shape, inputs, conv, pool, twice, lambda above, skipped: torch.cat([above, skipped], dim=1))


class FineTunedConv(nn.Module):
    """A 3 x 3 convolution whose parameters are the difference from pretrained ones.

    Args:
        weight, bias: the pretrained parameters.
        extra: input channels after the others that the pretrained convolution lacks; their weights start at 0.
        frozen: keep the pretrained parameters.
    """

    pretrained_weight: Tensor
    pretrained_bias: Tensor

    def __init__(self, weight: Tensor, bias: Tensor, extra: int = 0, *, frozen: bool = False) -> None:
        super().__init__()
        self.register_buffer("pretrained_weight", weight, persistent=False)
        self.register_buffer("pretrained_bias", bias, persistent=False)
        self.weight = None if frozen else nn.Parameter(torch.zeros_like(weight))
        self.bias = None if frozen else nn.Parameter(torch.zeros_like(bias))
        self.extra = nn.Parameter(weight.new_zeros(len(weight), extra, 3, 3)) if extra else None

    def total(self) -> tuple[Tensor, Tensor]:
        """Return weight and bias of the convolution: pretrained parameters plus differences."""
        weight, bias = self.pretrained_weight, self.pretrained_bias
        if self.weight is not None and self.bias is not None:
            weight, bias = weight + self.weight, bias + self.bias
        if self.extra is not None:
            weight = torch.cat([weight, self.extra], dim=1)
        return weight, bias

    def forward(self, image: Tensor) -> Tensor:
        """Convolve an image (N, C, H, W)."""
        return F.conv2d(image, *self.total(), padding=1)

    def merged(self) -> nn.Conv2d:
        """Return a plain convolution with the same result, for the exporter."""
        weight, bias = self.total()
        result = nn.Conv2d(weight.shape[1], len(weight), 3, padding=1)
        result.load_state_dict({"weight": weight, "bias": bias})
        return result


class FineTunedUNet(nn.Module):
    """A network of Open Image Denoise, fine-tuned to read further channels after its own.

    Args:
        network: a key of ``NETWORKS``.
        shape: its layout.
        extra: input channels that the pretrained network lacks.
        frozen: convolutions that keep the pretrained weights; by default all of them.
    """

    def __init__(self, network: str, shape: Shape, extra: int = 0, frozen: Sequence[str] | None = None) -> None:
        super().__init__()
        self.network, self.shape = network, shape
        pretrained = pretrained_weights(network)
        readers = shape.down[0][0], shape.up[-1][0]  # of the input
        self.convs: Any = nn.ModuleDict()  # of FineTunedConv
        for name in convolutions(pretrained):
            weight, bias = pretrained[f"{name}.weight"], pretrained[f"{name}.bias"]
            keeps = frozen is None or name in frozen
            self.convs[name] = FineTunedConv(weight, bias, extra if name in readers else 0, frozen=keeps)

    def run(self, image: Tensor) -> Tensor:
        """Run the network on an image (N, C, H, W); H and W are multiples of 16."""

        def conv(name: str, values: Tensor) -> Tensor:
            return F.relu(self.convs[name](values))

        dtype = next(itertools.chain(self.convs.parameters(), self.convs.buffers())).dtype
        return run_unet_on_tensors(self.shape, [image.to(dtype)], conv).float()

    def weights(self) -> dict[str, Tensor]:
        """Return the weights and biases of all convolutions, by Open Image Denoise's names."""
        pairs = {name: conv.total() for name, conv in self.convs.items()}
        return {
            f"{name}.{kind}": values.detach()
            for name, pair in pairs.items()
            for kind, values in zip(("weight", "bias"), pair, strict=True)
        }
