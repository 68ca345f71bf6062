# SPDX-License-Identifier: Apache-2.0
"""Optical flow: motion computed from the fused pictures, by OpenCV's DIS.

Kroeger et al. 2016, "Fast optical flow using dense inverse search". OpenCV is optional and imported where it is used.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.sampling import sample_linear

#: A vector is believed if the way there and back ends this close to its pixel, in pixels.
FLOW_ERROR = 0.75
#: Stops below and above the mean brightness that DIS sees, which reads 8 bits.
STOPS_BELOW, STOPS_ABOVE = 6.0, 4.0
#: Pixels on each side that DIS needs. It halves smaller pictures too often, and OpenCV may crash.
SMALLEST = 16


def has_optical_flow() -> bool:
    """Return whether OpenCV is installed."""
    return find_spec("cv2") is not None


def flow_vectors(frame: Array, neighbour: Array, window: Window, other_window: Window) -> tuple[Array, Mask]:
    """Compute vectors to a neighbour (h, w, 2), and where they can be believed (h, w): nowhere in tiny frames.

    Args:
        frame, neighbour: fused beauties (h, w, 3), which have little noise.
        window, other_window: their data windows.
    """
    import cv2

    if min(frame.shape[:2]) < SMALLEST:
        return np.zeros((*frame.shape[:2], 2), np.float32), np.zeros(frame.shape[:2], np.bool_)
    brightness = luminance(frame)
    lit = brightness[np.isfinite(brightness) & (brightness > 0)]
    key = float(np.exp(np.mean(np.log(lit)))) if lit.size else 1.0
    first, second = _eight_bit(frame, key), np.zeros(frame.shape[:2], np.uint8)
    shared = window.intersect(other_window)
    second[shared.slices(window)] = _eight_bit(neighbour, key)[shared.slices(other_window)]
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there = np.asarray(dis.calc(first, second, None), np.float32)
    back = np.asarray(dis.calc(second, first, None), np.float32)
    y, x = np.mgrid[0 : window.height, 0 : window.width].astype(np.float32)
    at_x, at_y = x + there[..., 0], y + there[..., 1]
    trip = there + sample_linear(back, at_x, at_y)
    rows, columns = shared.slices(window)
    inside = (at_x >= columns.start) & (at_x <= columns.stop - 1) & (at_y >= rows.start) & (at_y <= rows.stop - 1)
    known = inside & (np.hypot(trip[..., 0], trip[..., 1]) < FLOW_ERROR)
    there[~known] = 0
    return there, known


def _eight_bit(image: Array, key: float) -> NDArray[np.uint8]:
    """Encode the logarithm of the luminance, in which texture is as strong in shade as in light."""
    values = np.maximum(np.nan_to_num(luminance(image), posinf=key), 0) / np.float32(key)
    stops = np.log2(values + np.float32(2**-STOPS_BELOW)) + np.float32(STOPS_BELOW)
    return np.clip(stops * np.float32(255 / (STOPS_BELOW + STOPS_ABOVE)), 0, 255).astype(np.uint8)
