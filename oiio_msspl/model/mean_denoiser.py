# SPDX-License-Identifier: Apache-2.0
"""The low-resolution denoiser of the `joint` models, run by ONNX Runtime.

The file for GPUs reads and returns float32 images, the file for CPUs 8-bit codes. Colours have a range of 2^30, which
8 bits cannot hold. So the PU-encoded range is cut into equal slices, and each slice has a channel that says how much of
it is filled, from 0 to 255. The sum over the slices is the value.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import LRHS_FEATURES
from oiio_msspl.arrays import Array
from oiio_msspl.model.contract import MEAN_DENOISER, SMALL_MEAN_DENOISER
from oiio_msspl.model.devices import file_for, providers
from oiio_msspl.model.encoding import encode_radiance
from oiio_msspl.model.pu_curve import largest_log_encoded, pu_decode, pu_encode_log
from oiio_msspl.model.render_mean import NO_IMAGES, Images, MeanSettings, denoiser_images, mean_of_renders
from oiio_msspl.model.runtime import convolutions, load_network
from oiio_msspl.parallel import for_row_blocks

_FOLDER = Path(__file__).parent / "weights" / "denoisers"
#: The file for CPUs by the value of ``Contract.denoiser``.
WEIGHTS = {
    MEAN_DENOISER: _FOLDER / "mean_denoiser.onnx",
    SMALL_MEAN_DENOISER: _FOLDER / "mean_denoiser_small.onnx",
}
#: Height and width of its input are multiples of this.
ALIGNMENT = 16
#: Slices of a colour channel at the input and at the output.
INPUT_SLICES, OUTPUT_SLICES = 3, 10
#: Input channels: three colours in slices, albedo, normal and noise.
INPUT_CHANNELS = 3 * INPUT_SLICES + 7

#: Entries of the lookup table. The curve is steep near black, so they are many.
_ENTRIES = 1 << 16
_LRHS_CHANNELS = sum(LRHS_FEATURES.values())

Codes = NDArray[np.uint8]


class MeanDenoiser:
    """Denoises the mean of both renders at the LRHS's resolution.

    The network was trained from Open Image Denoise's large one, its small version from the small one. It also reads how
    far the two renders differ, as an estimate of their noise, so the albedo needs no prefilter.

    Args:
        threads: CPU threads; 0 for one a core.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`.
        path: the network's file for CPUs. A GPU runs the one that belongs to it.
    """

    def __init__(self, threads: int = 0, device: str = "cpu", path: Path = WEIGHTS[MEAN_DENOISER]) -> None:
        self._session = load_network(file_for(path, device), threads, providers(device))
        self._reads_codes = [each.name for each in self._session.get_inputs()] == ["layers"]
        self.convolutions = convolutions(self._session)
        """See :func:`oiio_msspl.model.runtime.convolutions`."""

    def __call__(
        self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES, settings: MeanSettings | None = None
    ) -> tuple[Array, Array]:
        """Denoise an encoded pair.

        Args:
            lrhs: (h, w, 3), encoded.
            hrls: (s*h, s*w, 9 or more), encoded: colour, albedo, normal.
            lrhs_aovs, settings: see :func:`oiio_msspl.model.render_mean.mean_of_renders`.

        Returns:
            A copy of the LRHS with the denoised mean as three more channels of log-encoded colour, (h, w, 6), and the
            HRLS as it is.
        """
        height, width, channels = lrhs.shape
        # Each channel is contiguous, as the network reads it.
        both = np.empty((2 * channels, height, width), dtype=np.float32).transpose(1, 2, 0)
        both[..., :channels] = lrhs
        self.fill(both, hrls, lrhs_aovs, settings)
        return both, hrls

    def fill(
        self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES, settings: MeanSettings | None = None
    ) -> None:
        """The same in place: fill the last three channels of the LRHS, (h, w, 6)."""
        images = mean_of_renders(lrhs[..., :_LRHS_CHANNELS], denoiser_images(hrls), lrhs_aovs, settings)
        height, width = lrhs.shape[:2]
        if not self._reads_codes:
            feed = {name: _planes(image) for name, image in images.items()}
            result = self._session.run(["denoised"], feed)[0][0, :, :height, :width]
            lrhs[..., _LRHS_CHANNELS:] = result.transpose(1, 2, 0)
            return
        codes = self._session.run(["codes"], {"layers": quantise(**images)[None]})[0][0, :height, :width]
        table, denoised = log_encoded_of_code(OUTPUT_SLICES), lrhs[..., _LRHS_CHANNELS:]

        def dequantise(rows: slice) -> None:
            # Codes never exceed the table; mode="clip" makes np.take four times as fast as indexing.
            denoised[rows] = np.take(table, codes[rows], mode="clip")

        for_row_blocks(dequantise, height, 3 * width)


def _planes(image: Array) -> Array:
    """(h, w, C) as (1, C, H, W). Sides grow to multiples of ``ALIGNMENT``; the edge pixels are repeated."""
    margins = [(0, -side % ALIGNMENT) for side in image.shape[:2]]
    return np.ascontiguousarray(np.pad(image, [*margins, (0, 0)], mode="edge").transpose(2, 0, 1)[None])


def quantise(colour: Array, albedo: Array, normal: Array, noise: Array) -> Codes:
    """Quantise and stack the images that the network reads, see :data:`oiio_msspl.model.render_mean.Images`.

    Returns:
        (H, W, INPUT_CHANNELS): height and width grow to multiples of ``ALIGNMENT``; the edge pixels are repeated.
    """
    height, width = albedo.shape[:2]
    padded = tuple(-(-side // ALIGNMENT) * ALIGNMENT for side in (height, width))
    result = np.empty((*padded, INPUT_CHANNELS), np.uint8)

    def work(rows: slice) -> None:
        target = result[rows, :width]
        entries = (colour[rows] * np.float32((_ENTRIES - 1) / largest_log_encoded())).astype(np.uint16)
        sliced = np.take(_colour_slices(), entries, axis=0, mode="clip")
        target[..., :-7] = sliced.reshape(*sliced.shape[:2], -1)
        for i in range(3):  # channel by channel, as they are in memory
            target[..., -7 + i] = albedo[rows, :, i] * np.float32(255) + np.float32(0.5)
            target[..., -4 + i] = normal[rows, :, i] * np.float32(127.5) + np.float32(128)
        target[..., -1] = noise[rows, :, 0] * np.float32(255) + np.float32(0.5)

    for_row_blocks(work, height, INPUT_CHANNELS * width)
    result[:height, width:] = result[:height, width - 1 : width]
    result[height:] = result[height - 1]
    return result


@functools.cache
def _colour_slices() -> Codes:
    """How much of each slice evenly spaced log-encoded colours fill, from 0 to the largest: (_ENTRIES, slices)."""
    values = pu_encode_log(_ENTRIES)[:, None] * INPUT_SLICES - np.arange(INPUT_SLICES)
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


@functools.cache
def log_encoded_of_code(slices: int) -> Array:
    """Log-encoded colours by the sum of the codes of all their slices: (255 * slices + 1,)."""
    return encode_radiance(pu_decode(np.linspace(0, 1, 255 * slices + 1)).astype(np.float32), 1.0)
