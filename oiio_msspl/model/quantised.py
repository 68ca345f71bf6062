# SPDX-License-Identifier: Apache-2.0
"""Denoising networks with 8-bit convolutions, run by ONNX Runtime.

Input and output colours have a range of 2^30, which 8 bits cannot hold. So the PU-encoded range is cut into equal
slices, and each slice has a channel that says how much of it is filled, from 0 to 255. The sum over the slices is the
value.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.arrays import Array
from oiio_msspl.colour import srgb
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.oidn_weights import Weights
from oiio_msspl.model.pu_curve import largest_log_encoded, pu_decode, pu_encode_log
from oiio_msspl.model.runtime import load_network
from oiio_msspl.parallel import for_row_blocks

#: Images that each network reads, see :data:`oiio_msspl.model.render_mean.Images`. The first three are Open Image
#: Denoise's own; ``mean_denoiser`` was trained from its large one and also reads the noise.
NETWORK_IMAGES = {
    "rt_hdr_alb_nrm": {"colour", "albedo", "normal"},
    "rt_hdr_calb_cnrm_large": {"colour", "albedo", "normal"},
    "rt_alb": {"albedo"},
    "mean_denoiser": {"colour", "albedo", "normal", "noise"},
}
#: Folder of the networks: ``NAME.onnx`` for each.
WEIGHTS = Path(__file__).parent / "weights" / "denoisers"
#: Height and width of a network's input are multiples of this.
ALIGNMENT = 16
#: Slices of a colour channel and of an albedo channel at the input, and of any channel at the output.
COLOUR_SLICES, ALBEDO_SLICES, OUTPUT_SLICES = 3, 5, 10
#: Input channels: three colours in slices, albedo, normal and noise (or zeros); or three albedos in slices, and zeros.
#: Convolutions are slow if this is no multiple of 16.
INPUT_CHANNELS = 16

#: Entries of the lookup tables. The curve is steep near black, so they are many.
_ENTRIES = 1 << 16

Codes = NDArray[np.uint8]


class QuantisedDenoiser:
    """A denoising network in 8 bits.

    Args:
        name: a key of ``NETWORK_IMAGES``.
        weights: the weights that the network's file stores the difference to.
        threads: CPU threads; 0 for one a core.

    Attributes:
        images: names of the images that the network reads.

    Raises:
        InputError: this onnxruntime cannot run the network.
    """

    def __init__(self, name: str, weights: Weights, threads: int = 0) -> None:
        self.images = NETWORK_IMAGES[name]
        self._session = load_network(WEIGHTS / f"{name}.onnx", threads, initializers=weights)

    def __call__(
        self,
        albedo: Array,
        colour: Array | None = None,
        normal: Array | None = None,
        noise: Array | None = None,
        out: Array | None = None,
    ) -> Array:
        """Denoise the colour, or the albedo if there is no colour.

        Args:
            albedo, colour, normal, noise: see :data:`oiio_msspl.model.render_mean.Images`.
            out: where to put the result, (h, w, 3); may share memory with an input.

        Returns:
            (h, w, 3): log-encoded colour, or albedo.
        """
        height, width = albedo.shape[:2]
        codes = self._session.run(["codes"], {"layers": quantise(albedo, colour, normal, noise)[None]})[0][0]
        codes = codes[:height, :width]
        table = _albedo_of_code() if colour is None else log_encoded_of_code(OUTPUT_SLICES)
        result = np.empty((height, width, 3), np.float32) if out is None else out

        def dequantise(rows: slice) -> None:
            # Codes never exceed the table; mode="clip" makes np.take four times as fast as indexing.
            result[rows] = np.take(table, codes[rows], mode="clip")

        for_row_blocks(dequantise, height, 3 * width)
        return result


def quantise(
    albedo: Array, colour: Array | None = None, normal: Array | None = None, noise: Array | None = None
) -> Codes:
    """Quantise and stack the images that a network reads.

    Returns:
        (H, W, INPUT_CHANNELS): height and width grow to multiples of ``ALIGNMENT``; the edge pixels are repeated.
    """
    height, width = albedo.shape[:2]
    padded = tuple(-(-side // ALIGNMENT) * ALIGNMENT for side in (height, width))
    result = np.zeros((*padded, INPUT_CHANNELS), np.uint8)

    def look_up(values: Array, largest: float, table: Codes) -> Codes:
        entries = (values * np.float32((_ENTRIES - 1) / largest)).astype(np.uint16)
        return np.take(table, entries, axis=0, mode="clip").reshape(*values.shape[:2], -1)

    def work(rows: slice) -> None:
        target = result[rows, :width]
        if colour is None or normal is None:
            target[..., :-1] = look_up(albedo[rows], 1.0, _albedo_slices())
            return
        target[..., :-7] = look_up(colour[rows], largest_log_encoded(), _colour_slices())
        for i in range(3):  # channel by channel, as they are in memory
            target[..., -7 + i] = albedo[rows, :, i] * np.float32(255) + np.float32(0.5)
            target[..., -4 + i] = normal[rows, :, i] * np.float32(127.5) + np.float32(128)
        if noise is not None:
            target[..., -1] = noise[rows, :, 0] * np.float32(255) + np.float32(0.5)

    for_row_blocks(work, height, INPUT_CHANNELS * width)
    result[:height, width:] = result[:height, width - 1 : width]
    result[height:] = result[height - 1]
    return result


def _to_slices(values: NDArray[np.float64], count: int) -> Codes:
    """How much of each of ``count`` slices of [0, 1] the values (n,) fill: (n, count)."""
    return np.round(np.clip(values[:, None] * count - np.arange(count), 0, 1) * 255).astype(np.uint8)


@functools.cache
def _colour_slices() -> Codes:
    """Slices of evenly spaced log-encoded colours, from 0 to the largest."""
    return _to_slices(pu_encode_log(_ENTRIES), COLOUR_SLICES)


@functools.cache
def _albedo_slices() -> Codes:
    """Slices of evenly spaced albedos, from 0 to 1. Open Image Denoise encodes an albedo by the sRGB curve."""
    return _to_slices(srgb(np.linspace(0, 1, _ENTRIES, dtype=np.float32)).astype(np.float64), ALBEDO_SLICES)


@functools.cache
def log_encoded_of_code(slices: int) -> Array:
    """Log-encoded colours by the sum of the codes of all their slices: (255 * slices + 1,)."""
    return encode_radiance(pu_decode(_encoded_of_code(slices)).astype(np.float32), 1.0)


@functools.cache
def _albedo_of_code() -> Array:
    """Albedos by the sum of the codes of all their slices."""
    linear = np.linspace(0, 1, _ENTRIES, dtype=np.float32)
    return np.interp(_encoded_of_code(OUTPUT_SLICES), srgb(linear), linear).astype(np.float32)


def _encoded_of_code(slices: int) -> NDArray[np.float64]:
    return np.linspace(0, 1, 255 * slices + 1)
