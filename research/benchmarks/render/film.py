# SPDX-License-Identifier: Apache-2.0
"""Set which part of a frame is rendered, and store it: what the renders of benchmarks share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from oiio_msspl.errors import MssplError
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


def write_exr(path: Path, image: NDArray[Any], channels: Sequence[str], pixel_type: str = "half") -> None:
    """Write (h, w, c) as half or float; the channels get the first c names.

    Raises:
        MssplError: the file can't be written.
    """
    height, width, count = image.shape
    spec = oiio.ImageSpec(width, height, count, pixel_type)
    spec.channelnames = tuple(channels[:count])
    spec.attribute("compression", "zip")
    spec.attribute("Software", "Mitsuba 3")
    largest = 65000 if pixel_type == "half" else np.inf
    with replacing(path, overwrite=True) as temporary:
        writer: Any = oiio.ImageOutput.create(str(temporary))
        ok = writer.open(str(temporary), spec)
        ok = ok and writer.write_image(np.ascontiguousarray(np.clip(image, -largest, largest), dtype=np.float32))
        if not (writer.close() and ok):
            raise MssplError(f"{path}: can't be written ({writer.geterror()})")
