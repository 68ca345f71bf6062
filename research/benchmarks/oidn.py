# SPDX-License-Identifier: Apache-2.0
"""Denoise arrays with Open Image Denoise (OIDN): by its plain call, and by the one that its documentation recommends.

Images are (h, w, 3) and linear. All functions need pyoidn: ``pip install '.[benchmark]'``.

    python -m research.benchmarks.oidn FRAME.exr DENOISED.exr

denoises a file as the documentation recommends. The file has the beauty and the layers ``albedo`` and ``N``. This
program is timed beside ours, so it imports nothing of this project.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def denoise(color: Array, albedo: Array | None = None, normal: Array | None = None, quality: str = "high") -> Array:
    """Denoise by the plain call: one filter that gets the beauty and the noisy albedo and normal."""
    import pyoidn

    return np.asarray(pyoidn.denoise(color, albedo, normal, hdr=True, quality=quality))


def denoise_prefiltered(color: Array, albedo: Array | None = None, normal: Array | None = None) -> Array:
    """Denoise by the recommended call: the albedo and the normal are first denoised, each by a filter of its own.

    The filter of the beauty gets the results and is told by ``cleanAux`` that they have no noise. See
    https://github.com/RenderKit/oidn, "prefiltering".
    """
    auxiliary = {name: image for name, image in (("albedo", albedo), ("normal", normal)) if image is not None}
    return denoise_with_clean(color, prefiltered(auxiliary))


def prefiltered(auxiliary: Mapping[str, Array]) -> dict[str, Array]:
    """Return albedo and normal without noise, each by a filter of its own."""
    return {name: run_filter({name: image}, quality="high") for name, image in auxiliary.items()}


def denoise_with_clean(color: Array, clean: Mapping[str, Array]) -> Array:
    """Denoise a colour with an albedo and a normal of :func:`prefiltered`."""
    return run_filter({"color": color, **clean}, hdr=True, cleanAux=bool(clean))


def run_filter(
    images: dict[str, Array], *, input_scale: float = math.nan, quality: str = "high", **flags: bool
) -> Array:
    """Return the output of one OIDN filter. It denoises the color, or the only image that it gets.

    Args:
        input_scale: brings the color to OIDN's range; OIDN finds it if it is not a number.
        quality: "fast" for the small networks, "balanced" for the base ones, "high" for the largest.
        flags: parameters of OIDN's filter.
    """
    import pyoidn

    images = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
    output = np.empty_like(next(iter(images.values())))
    oidn_filter = _filter(tuple(images), quality, **flags)
    for name, image in {**images, pyoidn.OIDN_IMAGE_OUTPUT: output}.items():
        oidn_filter.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
    oidn_filter.set_float("inputScale", input_scale)
    oidn_filter.commit()
    oidn_filter.execute()
    if error := _device().get_error():
        raise RuntimeError(f"Open Image Denoise: {error}")
    return output


@functools.cache
def _filter(inputs: tuple[str, ...], quality: str, **flags: bool) -> Any:
    """Return a filter for these inputs. The next picture uses it again, as in pyoidn's plain call."""
    import pyoidn

    oidn_filter = pyoidn.Filter(_device(), pyoidn.OIDN_FILTER_TYPE_RT)
    oidn_filter.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
    for flag, value in flags.items():
        oidn_filter.set_bool(flag, value)
    return oidn_filter


@functools.cache
def _device() -> Any:
    """Return one device for all filters of the process."""
    import pyoidn

    device = pyoidn.Device()
    device.commit()
    return device


def denoise_file(source: str, target: str) -> None:
    """Denoise an EXR file by the recommended call; write the beauty as half floats."""
    import OpenEXR

    with OpenEXR.File(source, separate_channels=True) as file:
        planes = {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}

    def layer(prefix: str) -> Array:
        letters = "XYZ" if f"{prefix}X" in planes else "RGB"
        return np.stack([planes[prefix + letter] for letter in letters], axis=-1)

    beauty = denoise_prefiltered(layer(""), layer("albedo."), layer("N."))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.maximum(beauty, 0).astype(np.float16)}) as file:
        file.write(target)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    denoise_file(*sys.argv[1:])
