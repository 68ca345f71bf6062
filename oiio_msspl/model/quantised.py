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
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.arrays import Array
from oiio_msspl.colour import srgb
from oiio_msspl.model.encoding import MAX_RADIANCE, MU, encode_radiance
from oiio_msspl.model.pu_curve import pu_decode, pu_encode
from oiio_msspl.model.runtime import load_network
from oiio_msspl.parallel import for_row_blocks

#: The layers that each needs, and ``together``, which is made of the large one.
READS = {
    "rt_hdr_alb_nrm": {"colour", "albedo", "normal"},
    "rt_hdr_calb_cnrm_large": {"colour", "albedo", "normal"},
    "rt_alb": {"albedo"},
    "mean_denoiser": {"colour", "albedo", "normal", "noise"},
}
#: Pixels of either side are a multiple of so many.
SIDE_MULTIPLE = 16
#: Slices of the range that a colour is written in, an albedo alone, and what either is read in.
COLOUR_SLICES, ALBEDO_SLICES, OUTPUT_SLICES = 3, 5, 10
#: Channels that a network reads: slices of three colours, albedo, normal, and noise or one that is always 0; or slices
#: of an albedo, and one that is. Others than multiples of 16 take long.
CHANNELS_IN = 16

#: Entries of the table from network values to slices: as fine as the curve's slope near black asks for.
_ENTRIES = 1 << 16

Codes = NDArray[np.uint8]


class QuantisedDenoiser:
    """One of the networks.

    Args:
        name: a key of ``READS``.
        weights: the network's, or that one's that it is made of, by name, see :func:`read_weights`.
        threads: 0 for all.

    Attributes:
        reads: the layers that it needs.
    """

    def __init__(self, name: str, weights: dict[str, NDArray[np.float16]], threads: int = 0) -> None:
        self.reads = READS[name]
        file = resources.files("oiio_msspl.model").joinpath("weights", "denoisers", f"{name}.onnx")
        with resources.as_file(file) as path:
            self._session = load_network(path, threads, initializers=weights)

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
            noise: (h, w, 1) in [0, 1], of the colour, see :func:`oiio_msspl.model.render_mean.mean_of_renders`.
            out: where to write the result, (h, w, 3); may be part of what the others are of.

        Returns:
            Denoised network values, or an albedo.
        """
        height, width = albedo.shape[:2]
        layers = pack_codes(albedo, colour, normal, noise)
        codes = self._session.run(["codes"], {"layers": layers[None]})[0][0, :height, :width]
        table = _albedo_by_code() if colour is None else log_encoded_by_code(OUTPUT_SLICES)
        result = np.empty((height, width, 3), np.float32) if out is None else out

        def work(rows: slice) -> None:
            result[rows] = np.take(table, codes[rows], mode="clip")  # never beyond; four times as fast as indexing

        for_row_blocks(work, height, 3 * width)
        return result


def pack_codes(
    albedo: Array, colour: Array | None = None, normal: Array | None = None, noise: Array | None = None
) -> Codes:
    """What the network reads, of all layers or of an albedo alone, (H, W, CHANNELS_IN): both sides grown to a
    ``MULTIPLE`` by repeating the edge."""
    height, width = albedo.shape[:2]
    grown = tuple(-(-side // SIDE_MULTIPLE) * SIDE_MULTIPLE for side in (height, width))
    result = np.zeros((*grown, CHANNELS_IN), np.uint8)

    def slices(values: Array, largest_encoded: float, table: Codes) -> Codes:
        entries = (values * np.float32((_ENTRIES - 1) / largest_encoded)).astype(np.uint16)
        return np.take(table, entries, axis=0, mode="clip").reshape(*values.shape[:2], -1)

    def work(rows: slice) -> None:
        part = result[rows, :width]
        if colour is None or normal is None:
            part[..., :-1] = slices(albedo[rows], 1.0, _slices_of_albedo())
            return
        part[..., :-7] = slices(colour[rows], largest_encoded(), _slices_of_colour())
        for i in range(3):  # as they lie in memory
            part[..., -7 + i] = albedo[rows, :, i] * np.float32(255) + np.float32(0.5)
            part[..., -4 + i] = normal[rows, :, i] * np.float32(127.5) + np.float32(128)
        if noise is not None:
            part[..., -1] = noise[rows, :, 0] * np.float32(255) + np.float32(0.5)

    for_row_blocks(work, height, CHANNELS_IN * width)
    result[:height, width:] = result[:height, width - 1 : width]
    result[height:] = result[height - 1]
    return result


def largest_encoded() -> float:
    """The largest network value."""
    return float(np.log1p(MU * MAX_RADIANCE) / np.log1p(MU))


def pu_encoded_inputs(entries: int) -> NDArray[np.float64]:
    """What network values from 0 to the largest are to Open Image Denoise, so many equally spaced."""
    radiance = np.expm1(np.linspace(0, largest_encoded(), entries) * np.log1p(MU)) / MU
    return pu_encode(np.minimum(radiance, MAX_RADIANCE))


def _slices(values: NDArray[np.float64], count: int) -> Codes:
    """How far each slice of the range of values in [0, 1] is filled, (n, count)."""
    return np.round(np.clip(values[:, None] * count - np.arange(count), 0, 1) * 255).astype(np.uint8)


@functools.cache
def _slices_of_colour() -> Codes:
    """By network value, from 0 to the largest."""
    return _slices(pu_encoded_inputs(_ENTRIES), COLOUR_SLICES)


@functools.cache
def _slices_of_albedo() -> Codes:
    """By albedo, from 0 to 1; Open Image Denoise takes it for a picture, and sees it by the curve of sRGB."""
    return _slices(srgb(np.linspace(0, 1, _ENTRIES, dtype=np.float32)).astype(np.float64), ALBEDO_SLICES)


def _by_code(slices: int) -> NDArray[np.float64]:
    """What the network made, by how far all slices of its range are filled together."""
    return np.linspace(0, 1, 255 * slices + 1)


@functools.cache
def log_encoded_by_code(slices: int) -> Array:
    """Network values of what the network made, by the sum of its slices' codes."""
    return encode_radiance(pu_decode(_by_code(slices)).astype(np.float32), 1.0)


@functools.cache
def _albedo_by_code() -> Array:
    linear = np.linspace(0, 1, _ENTRIES, dtype=np.float32)
    return np.interp(_by_code(OUTPUT_SLICES), srgb(linear), linear).astype(np.float32)
