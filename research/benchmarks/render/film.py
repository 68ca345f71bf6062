# SPDX-License-Identifier: Apache-2.0
"""Set which part of a frame is rendered, and store it: what the renders of benchmarks share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from oiio_msspl.exr.atomic import replacing

#: Longer side of the whole frame, and width and height of the crop that is rendered, in pixels.
LONGER, CROP = 1280, (384, 256)


def frame_size(sensor: Any, longer: int = LONGER) -> np.ndarray:
    """Return width and height of a Mitsuba sensor's frame, scaled to a longer side; both are multiples of 8."""
    original = np.array(sensor.film().size())
    return np.asarray(np.round(original * longer / original.max() / 8).astype(int) * 8)


def set_crop(mi: Any, parameters: Any, frame: Any, crop: Any, offset: Any) -> None:
    """Set which part of the frame is rendered, in pixels as (x, y). ``parameters``: those of a traversed sensor."""
    parameters["film.size"] = mi.ScalarVector2u(*frame)
    parameters["film.crop_size"] = mi.ScalarVector2u(*crop)
    parameters["film.crop_offset"] = mi.ScalarPoint2u(*offset)
    parameters.update()


def write_exr(path: Path, image: NDArray[Any], channels: Sequence[str], pixel_type: type = np.float16) -> None:
    """Write (h, w, c) as half or float; the channels get the first c names."""
    largest = 65000 if pixel_type == np.float16 else np.inf
    pixels: NDArray[Any] = image.astype(np.float32).clip(-largest, largest).astype(pixel_type)
    planes = {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(channels[: image.shape[2]])}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path, overwrite=True) as temporary, OpenEXR.File(header, planes) as file:
        file.write(str(temporary))
