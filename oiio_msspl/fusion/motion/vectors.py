# SPDX-License-Identifier: Apache-2.0
"""Motion vectors as this package uses them: decoded, judged pixel by pixel, and inverted.

The convention: a vector (x, y) in HRLS pixels, x to the right and y down, leads from a pixel to the place of its
surface in another frame. Pixels count in the display window, so frames may have different data windows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender, ReadableRender
from oiio_msspl.aovs.motion import MotionFormat
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import Array, Mask, in_planes
from oiio_msspl.image.filters import max_around
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.image.sampling import nearest_indices, sample_linear

#: Shorter vectors are no movement, in pixels.
NO_MOTION = 1e-3
#: Vectors that change by more than this from pixel to pixel can't be followed, in pixels: whether the way there and
#: back ends at its pixel would depend on how places are rounded to pixels.
UNEVEN = 0.25
#: Rounds of the inversion, and how far from its pixel a round trip may end, in pixels.
INVERSION_ROUNDS, INVERSION_ERROR = 3, 0.5


def no_vectors(render: MappedRender) -> tuple[Array, Mask]:
    """Return vectors (h, w, 2) over a data window that are all 0 and can't be believed, and where they can (h, w)."""
    size = render.data_window.height, render.data_window.width
    return np.zeros((*size, 2), np.float32), np.zeros(size, np.bool_)


def judged_vectors(
    render: MappedRender, stored: Array, channels: tuple[Channel, Channel], form: MotionFormat, pixels: ReadableRender
) -> tuple[Array, Mask]:
    """Decode motion vectors over the data window, and find where they can be believed.

    Args:
        render: the frame.
        stored: these channels over its data window, and its alpha if it has one, (h, w, 2 or 3).
        channels: the two that hold the vectors.
        form: how they are stored.
        pixels: the frame's features.

    Returns:
        Vectors (h, w, 2), 0 where they can't be believed; and where they can (h, w): they are finite, shorter than the
        frame and not clamped, alpha is not 0, they do not change too fast (:func:`_uneven`), and they are not zeros of
        a background (:func:`_doubtful_zeros`).
    """
    window = render.data_window
    vectors, known = _decoded(render, stored, form)
    inside = window.intersect(render.file.parts[channels[0].part].data_window)
    if inside != window:  # beyond the part's data window nothing is stored
        rendered = np.zeros_like(known)
        rendered[inside.slices(window)] = True
        known &= rendered
    known &= ~_doubtful_zeros(pixels, vectors, known)
    known &= ~_uneven(vectors)
    vectors[~known] = 0
    return vectors, known


def _decoded(render: MappedRender, stored: Array, form: MotionFormat) -> tuple[Array, Mask]:
    """Decode vectors as :func:`judged_vectors` does, and find where their stored values can be believed."""
    width, height = render.display_window.width, render.display_window.height
    alpha = stored[..., 2] if render.alpha else None
    vectors = np.empty((*stored.shape[:2], 2), np.float32)
    known = np.empty(stored.shape[:2], np.bool_)

    def work(rows: slice) -> None:
        good = np.ones(known[rows].shape, np.bool_) if alpha is None else alpha[rows] > 0
        squares = np.zeros(good.shape, np.float32)
        with np.errstate(all="ignore"):
            for i, factor in enumerate(form.pixels_per_unit(width, height)):
                values = stored[rows, :, i]
                if form.offset:  # encoded as a colour, so the ends of its range may stand for anything beyond
                    good &= (values > 0) & (values < 2 * form.offset)
                if form.premultiplied and alpha is not None:
                    values = values / alpha[rows]
                values = (values - np.float32(form.offset)) * np.float32(factor)
                vectors[rows, :, i] = values
                squares += np.square(values)
            known[rows] = good & (squares < width**2 + height**2)  # false for NaN and infinities, too

    for_row_blocks(work, len(vectors), vectors[0].size)
    return vectors, known


def _doubtful_zeros(pixels: ReadableRender, vectors: Array, known: Mask) -> Mask:
    """Find where a vector of 0 may mean that the renderer knows none."""
    # Cycles writes 0 for the sky, which moves with the camera like everything else. So zeros are believed if most of
    # the surfaces do not move either.
    still = known & (np.abs(vectors[..., 0]) < NO_MOTION) & (np.abs(vectors[..., 1]) < NO_MOTION)
    normal = pixels.read(pixels.data_window, [NORMAL]).get(NORMAL) if still.any() else None
    surface = known if normal is None else known & (normal != 0).any(axis=-1)
    count = np.count_nonzero(surface)
    camera_stands = count > 0 and np.count_nonzero(still & surface) * 2 >= count
    return np.zeros_like(known) if camera_stands else still


def _uneven(vectors: Array) -> Mask:
    """Find where vectors change by more than ``UNEVEN`` on both sides of a pixel, in one direction: turning things."""
    # At the border of two surfaces, vectors change on one side. On one as thin as a pixel, they change and change back.
    motion = as_complex(vectors)
    result = np.zeros(motion.shape, np.bool_)
    for turned, uneven in ((motion, result), (motion.T, result.T)):
        with np.errstate(all="ignore"):  # vectors that are not believed may have any values
            changes = np.diff(turned, axis=0)
            fast = np.square(changes.real) + np.square(changes.imag) > UNEVEN**2
            places = np.nonzero(fast[1:] & fast[:-1])
            uneven[1:-1][places] |= (changes[1:][places] * changes[:-1][places].conj()).real > 0
    return result


def invert(own: Array, other: Array, other_known: Mask, window: Window, other_window: Window) -> tuple[Array, Mask]:
    """Compute the vectors to a neighbour from those that lead from the neighbour to this frame.

    The surface of pixel p is at the place q of the neighbour where q + other(q) = p. The iteration q <- p - other(q)
    finds it (Chen et al. 2008, "A simple fixed-point approach to invert a deformation field").

    Args:
        own: this frame's vectors to its other neighbour (h, w, 2). The iteration starts at their opposite, which is
            right where the movement is even.
        other, other_known: vectors of the neighbour, and where they are known.
        window, other_window: data windows of this frame and of the neighbour.

    Returns:
        Vectors (h, w, 2), and where the way there and back ends at its pixel.
    """
    height, width = own.shape[:2]
    vectors = np.zeros_like(own)
    known = np.zeros((height, width), np.bool_)
    shift_x, shift_y = window.x0 - other_window.x0, window.y0 - other_window.y0

    field = in_planes(other)  # is read in every block

    def work(rows: slice) -> None:
        y, x = np.mgrid[rows.start : rows.stop, 0:width].astype(np.float32)
        way = -in_planes(own[rows])
        for _ in range(INVERSION_ROUNDS):
            way = -sample_linear(field, x + way[..., 0] + shift_x, y + way[..., 1] + shift_y)
        at_x, at_y = x + way[..., 0] + shift_x, y + way[..., 1] + shift_y
        back = sample_linear(field, at_x, at_y) + way
        vectors[rows] = way
        inside = (at_x >= -0.5) & (at_y >= -0.5) & (at_x <= other.shape[1] - 0.5) & (at_y <= other.shape[0] - 0.5)
        returns = np.hypot(back[..., 0], back[..., 1]) < INVERSION_ERROR
        known[rows] = inside & returns & other_known.take(nearest_indices(at_x, at_y, other_known.shape))

    for_row_blocks(work, height, width * 8)
    vectors[~known] = 0
    return vectors, known


def near_borders(vectors: Array, tolerance: float) -> Mask:
    """Find the pixels (h, w) within one pixel of a border of two surfaces: vectors change there by > ``tolerance``.

    ``vectors``: (h, w, 2), in pixels. NaN counts as another surface.
    """
    result = np.empty(vectors.shape[:2], np.bool_)

    def work(rows: slice) -> None:
        top, bottom = max(rows.start - 2, 0), min(rows.stop + 2, len(result))
        motion = as_complex(vectors[top:bottom])
        borders = np.zeros(motion.shape, np.bool_)
        for turned, pixels in ((motion, borders), (motion.T, borders.T)):
            change = turned[1:] - turned[:-1]
            differs = ~(np.square(change.real) + np.square(change.imag) < tolerance**2)
            pixels[1:] |= differs
            pixels[:-1] |= differs
        result[rows] = max_around(borders)[rows.start - top : rows.stop - top]

    for_row_blocks(work, len(result), vectors[:1].size)
    return result


def as_complex(vectors: Array) -> NDArray[np.complex64]:
    """Return vectors (h, w, 2) as complex numbers (h, w), which NumPy gathers and subtracts in half the time."""
    return np.ascontiguousarray(vectors, np.float32).view(np.complex64)[..., 0]
