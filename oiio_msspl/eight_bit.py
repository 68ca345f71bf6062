# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's own networks in 8 bits, by ONNX Runtime: less than half of its time, and nearly its result.

Nothing of them is in this package. Their weights are read from the library that the user has installed, and are taken
only if they are, to the byte, those that :mod:`training.eight_bit` has seen; what is kept here is the graph, how its
values are scaled, and by how many steps of 8 bits a weight differs from the nearest one. Whether the processor computes
it right is tried out, against Open Image Denoise itself. Where any of that fails, Open Image Denoise does the work.

Inputs and outputs are colours of a range of 2^30, and have to go through 8 bits, too. They go in parts: of equal slices
of the range, one behind the other, each has a channel that says how far it is filled. Their sum is the value.
"""

from __future__ import annotations

import functools
import hashlib
import mmap
import struct
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oiio_msspl import bands, runtime, transforms
from oiio_msspl.render import Array

#: Networks of Open Image Denoise 2.5, with size in bytes and SHA-256 of their weights:
#: HDR colour with albedo and normal (``rt_hdr_alb_nrm``); the larger one for when both of these are free of noise
#: (``rt_hdr_calb_cnrm_large``); and an albedo alone (``rt_alb``).
NETWORKS = {
    "usual": (1841160, "e586ef2ff48d7fbb7611986405220ed8fc5c13ca79bfc40be4dc742fbf959e1a"),
    "large": (7698439, "08130cdc4f33b7a513d0073757f089ac830f900613bb5bad72ca42c52b934465"),
    "albedo": (1830792, "752c9a8d57884d660ae375a7c853cad8a44f77d559bb282f0ef39f8e758601a4"),
}
#: The layers that each needs, and ``together``, which is made of the large one.
READS = {
    "usual": {"colour", "albedo", "normal"},
    "large": {"colour", "albedo", "normal"},
    "albedo": {"albedo"},
    "together": {"colour", "albedo", "normal", "noise"},
}
#: Pixels of either side are a multiple of so many.
MULTIPLE = 16
#: Slices of the range that a colour is written in, an albedo alone, and what either is read in.
SLICES_IN, SLICES_OF_ALBEDO, SLICES_OUT = 3, 5, 10
#: Channels that a network reads: slices of three colours, albedo, normal, and noise or one that is always 0; or slices
#: of an albedo, and one that is. Others than multiples of 16 take long.
CHANNELS_IN = 16

#: The curve that Open Image Denoise sees HDR colours by: a fit to the PU encoding of Aydin et al. 2008, "Extending
#: Quality Metrics to Full Luminance Range Images", linear below the first bound, a power below the second, a logarithm
#: beyond. Its numbers are from core/color.h of Open Image Denoise.
BOUNDS = (1.57945760e-06, 3.22087631e-02)
SLOPE = 1.41283765e03
FACTOR, EXPONENT, OFFSET = 1.64593172e00, 4.31384981e-01, -2.94139609e-03
LOG_FACTOR, LOG_SHIFT, LOG_OFFSET = 1.92653254e-01, 6.26026094e-03, 9.98620152e-01

#: Entries of the table from network values to slices: as fine as the curve's slope near black asks for.
_ENTRIES = 1 << 16

Codes = NDArray[np.uint8]


def encode(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance in [0, 65504] as Open Image Denoise's networks see it, in [0, 1]."""
    curve = np.where(
        radiance <= BOUNDS[1],
        FACTOR * radiance**EXPONENT + OFFSET,
        LOG_FACTOR * np.log(radiance + LOG_SHIFT) + LOG_OFFSET,
    )
    return np.where(radiance <= BOUNDS[0], SLOPE * radiance, curve) / top()


def decode(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of :func:`encode`."""
    curve = values * top()
    low, middle = encode(np.asarray(BOUNDS)) * top()
    power = (np.maximum(curve - OFFSET, 0) / FACTOR) ** (1 / EXPONENT)
    radiance = np.where(curve <= middle, power, np.exp((curve - LOG_OFFSET) / LOG_FACTOR) - LOG_SHIFT)
    return np.where(curve <= low, curve / SLOPE, radiance)


def top() -> float:
    """What the curve ends at."""
    return LOG_FACTOR * float(np.log(transforms.MAX_RADIANCE + LOG_SHIFT)) + LOG_OFFSET


class EightBit:
    """One of the networks.

    Args:
        name: a key of ``READS``.
        weights: the network's, or that one's that it is made of, by name, see :func:`weights_of`.
        threads: 0 for all.

    Attributes:
        reads: the layers that it needs.
    """

    def __init__(self, name: str, weights: dict[str, NDArray[np.float16]], threads: int = 0) -> None:
        self.reads = READS[name]
        file = resources.files("oiio_msspl").joinpath("denoisers", f"{name}.onnx")
        with resources.as_file(file) as path:
            self._session = runtime.load(path, threads, initializers=weights)

    def __call__(
        self,
        albedo: Array,
        colour: Array | None = None,
        normal: Array | None = None,
        noise: Array | None = None,
        out: Array | None = None,
    ) -> Array:
        """Denoise the colour; without one, the albedo.

        Args:
            albedo: (h, w, 3) in [0, 1].
            colour: (h, w, 3), network values of an exposed render.
            normal: (h, w, 3) in [-1, 1].
            noise: (h, w, 1) in [0, 1], of the colour, see :func:`oiio_msspl.denoiser.merged`.
            out: where to write the result, (h, w, 3); may be part of what the others are of.

        Returns:
            Denoised network values, or an albedo.
        """
        height, width = albedo.shape[:2]
        layers = pack(albedo, colour, normal, noise)
        codes = self._session.run(["codes"], {"layers": layers[None]})[0][0, :height, :width]
        table = _albedo_by_code() if colour is None else values_by_code(SLICES_OUT)
        result = np.empty((height, width, 3), np.float32) if out is None else out

        def work(rows: slice) -> None:
            result[rows] = np.take(table, codes[rows], mode="clip")  # never beyond; four times as fast as indexing

        bands.each(work, height, 3 * width)
        return result


def pack(albedo: Array, colour: Array | None = None, normal: Array | None = None, noise: Array | None = None) -> Codes:
    """What the network reads, of all layers or of an albedo alone, (H, W, CHANNELS_IN): both sides grown to a
    ``MULTIPLE`` by repeating the edge."""
    height, width = albedo.shape[:2]
    grown = tuple(-(-side // MULTIPLE) * MULTIPLE for side in (height, width))
    result = np.zeros((*grown, CHANNELS_IN), np.uint8)

    def slices(values: Array, largest: float, table: Codes) -> Codes:
        entries = (values * np.float32((_ENTRIES - 1) / largest)).astype(np.uint16)
        return np.take(table, entries, axis=0, mode="clip").reshape(*values.shape[:2], -1)

    def work(rows: slice) -> None:
        part = result[rows, :width]
        if colour is None or normal is None:
            part[..., :-1] = slices(albedo[rows], 1.0, _slices_of_albedo())
            return
        part[..., :-7] = slices(colour[rows], largest(), _slices_of_colour())
        for i in range(3):  # as they lie in memory
            part[..., -7 + i] = albedo[rows, :, i] * np.float32(255) + np.float32(0.5)
            part[..., -4 + i] = normal[rows, :, i] * np.float32(127.5) + np.float32(128)
        if noise is not None:
            part[..., -1] = noise[rows, :, 0] * np.float32(255) + np.float32(0.5)

    bands.each(work, height, CHANNELS_IN * width)
    result[:height, width:] = result[:height, width - 1 : width]
    result[height:] = result[height - 1]
    return result


def largest() -> float:
    """The largest network value."""
    return float(np.log1p(transforms.MU * transforms.MAX_RADIANCE) / np.log1p(transforms.MU))


def seen(entries: int) -> NDArray[np.float64]:
    """What network values from 0 to the largest are to Open Image Denoise, so many equally spaced."""
    radiance = np.expm1(np.linspace(0, largest(), entries) * np.log1p(transforms.MU)) / transforms.MU
    return encode(np.minimum(radiance, transforms.MAX_RADIANCE))


def _slices(values: NDArray[np.float64], count: int) -> Codes:
    """How far each slice of the range of values in [0, 1] is filled, (n, count)."""
    return np.round(np.clip(values[:, None] * count - np.arange(count), 0, 1) * 255).astype(np.uint8)


@functools.cache
def _slices_of_colour() -> Codes:
    """By network value, from 0 to the largest."""
    return _slices(seen(_ENTRIES), SLICES_IN)


@functools.cache
def _slices_of_albedo() -> Codes:
    """By albedo, from 0 to 1; Open Image Denoise takes it for a picture, and sees it by the curve of sRGB."""
    return _slices(transforms.srgb(np.linspace(0, 1, _ENTRIES, dtype=np.float32)).astype(np.float64), SLICES_OF_ALBEDO)


def _by_code(slices: int) -> NDArray[np.float64]:
    """What the network made, by how far all slices of its range are filled together."""
    return np.linspace(0, 1, 255 * slices + 1)


@functools.cache
def values_by_code(slices: int) -> Array:
    """Network values of what the network made, by the sum of its slices' codes."""
    return transforms.compress(decode(_by_code(slices)).astype(np.float32), 1.0)


@functools.cache
def _albedo_by_code() -> Array:
    linear = np.linspace(0, 1, _ENTRIES, dtype=np.float32)
    return np.interp(_by_code(SLICES_OUT), transforms.srgb(linear), linear).astype(np.float32)


def weights_of(name: str, library: Path) -> dict[str, NDArray[np.float16]] | None:
    """A network's weights in a library of Open Image Denoise, or None if it has others.

    The format is TZA 2: a magic number, the position of a table of names, shapes and positions, the tensors.
    """
    size, digest = NETWORKS[name]
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(b"\xd7\x41\x02")
        while start >= 0:
            blob = content[start : start + size]
            if hashlib.sha256(blob).hexdigest() == digest:
                return _tensors(blob)
            start = content.find(b"\xd7\x41\x02", start + 1)
    return None


def _tensors(blob: bytes) -> dict[str, NDArray[np.float16]]:
    position = 0

    def take(form: str) -> tuple:
        nonlocal position
        values = struct.unpack_from(f"<{form}", blob, position)
        position += struct.calcsize(f"<{form}")
        return values

    *_, position = take("HBBQ")
    result = {}
    for _ in range(*take("I")):
        name = take(f"{take('H')[0]}s")[0].decode()
        dimensions = take("B")[0]
        shape = take(f"{dimensions}I")
        take(f"{dimensions + 1}s")  # their order, the type of the values
        (offset,) = take("Q")
        result[name] = np.frombuffer(blob, np.float16, int(np.prod(shape)), offset).reshape(shape)
    return result
