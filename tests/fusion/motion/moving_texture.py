# SPDX-License-Identifier: Apache-2.0
"""A picture that moves from frame to frame, and the hops to its neighbours, for the tests of averaging."""

import numpy as np

from oiio_msspl.fusion.motion.shot import ROUND_TRIP, Motion
from oiio_msspl.fusion.motion.vectors import near_borders
from oiio_msspl.fusion.neighbours.path import Hop

HEIGHT, WIDTH, SCALE = 96, 128, 4


def texture(shift=0.0):
    """A smooth picture (h, w, 3), moved to the right by ``shift`` pixels."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    x = x - shift
    grey = 0.5 + 0.2 * np.sin(x / 5) * np.cos(y / 7) + 0.1 * np.sin((x + y) / 11)
    return (grey[..., None] * (1.0, 0.8, 0.6)).astype(np.float32)


def rms(image, truth, part=slice(None)):
    return float(np.sqrt(np.mean(np.square(image - truth)[part])))


def hop(frame, vectors=None, back=None, known=None, **more):
    """A hop to a frame along vectors, and the way back."""
    borders, borders_back = (None if ways is None else near_borders(ways, ROUND_TRIP) for ways in (vectors, back))
    return Hop(frame, Motion(vectors, known, borders=borders, **more), Motion(back, borders=borders_back, **more))


def still(frame):
    return hop(frame)


def moved(frame, x, y=0.0):
    there = np.broadcast_to(np.float32([x, y]), (HEIGHT, WIDTH, 2))
    return hop(frame, there, -there)
