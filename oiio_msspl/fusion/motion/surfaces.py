# SPDX-License-Identifier: Apache-2.0
"""Verifies where motion leads to, by the albedo and the normals of both frames.

Pixels that show another surface in the neighbour are found: nothing else says that an object has moved which has no
vectors, or wrong ones. And vectors that mislead all pixels are.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from oiio_msspl.aovs.features import NORMAL
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import Array, Mask, finite, planes_of
from oiio_msspl.image.filters import max_around, means_around, sum_3x3
from oiio_msspl.image.parallel import for_row_blocks
from oiio_msspl.image.sampling import nearest_indices

#: A pixel differs between two frames if a layer has changed by more than a constant and a multiple of the difference of
#: two pixels of one surface, which is its texture and noise.
DIFFERENCE, MULTIPLE = 0.03, 3.0
#: The constant for normals, if vectors follow things that turn: these change by up to 6 degrees.
TURN = 0.1
#: The surface is another one if this many of 3 x 3 pixels differ. Single ones are noise.
PIXELS = 4
#: It is also another one where most pixels differ, up to this number of rows and columns away: a texture that has moved
#: has the same colour here and there by chance.
AROUND, MOST = 8, 0.5
#: Pixels are tested one by one if a smaller share of them differs.
FEW = 0.05
#: Rows and columns around a pixel that decide on it.
REACH = 4 + AROUND
#: Pixels by which vectors are judged, at most, and at least.
MOST_SAMPLES, FEWEST_SAMPLES = 4096, 64
#: Vectors are judged where they are longer than this, in pixels.
MOVES = 0.5
#: Vectors mislead if a vote of the pixels is this many standard deviations from a tie.
SURE = 4.0
#: Pixels that are compared at a time, which bounds memory.
PIXELS_AT_ONCE = 1 << 22


def other_surfaces(
    here: ReadableRender,
    there: ReadableRender,
    names: Sequence[str],
    vectors: Array,
    known: Mask,
    *,
    turns: bool = True,
) -> Mask:
    """Find the pixels (h, w) of a frame where its neighbour shows another surface, and those beside them.

    Args:
        here, there: the frame and its neighbour.
        names: layers of both frames that have no light, such as the albedo. Without any, no surface is another one.
        vectors: to the places of the surfaces in the neighbour, (h, w, 2) in HRLS pixels.
        known: which vectors can be believed, (h, w). Other pixels are not compared.
        turns: vectors follow things that turn, so their normals may change.
    """
    window, height = here.data_window, here.data_window.height
    result = np.zeros(known.shape, np.bool_)
    rows = max(PIXELS_AT_ONCE // max(window.width, 1), 8 * REACH)
    for top in range(0, height if names else 0, rows):
        last = min(top + rows, height)
        around = slice(max(top - REACH, 0), min(last + REACH, height))
        area = Window(window.x0, window.y0 + around.start, window.x1, window.y0 + around.stop)
        layers = {name: planes_of(image) for name, image in here.read(area, names).items()}
        differs = _differ(layers, there, area, vectors[around], known[around], TURN if turns else DIFFERENCE)
        result[top:last] = differs[top - around.start :][: last - top]
        for render in (here, there):
            render.unload()
    return result


def misleads(here: ReadableRender, there: ReadableRender, names: Sequence[str], vectors: Array, known: Mask) -> bool:
    """Return whether no motion, or the opposite vectors, lead to more alike pixels of a neighbour than the vectors.

    The arguments are those of :func:`other_surfaces`. A sample of the pixels votes (sign test).
    """
    window, other = here.data_window, there.data_window
    step = max(3, int(np.sqrt(vectors[..., 0].size / MOST_SAMPLES)))  # apart, so that their noise is independent
    part = slice(step // 2, None, step), slice(step // 2, None, step)
    ways = vectors[part]
    y, x = np.nonzero(known[part] & (np.hypot(ways[..., 0], ways[..., 1]) > MOVES))
    ways, x, y = ways[y, x], x * step + step // 2, y * step + step // 2
    signs = np.array([[1], [0], [-1]], np.float32)  # the vectors, no motion, the opposite
    at_x, at_y = x + window.x0 + signs * ways[:, 0], y + window.y0 + signs * ways[:, 1]
    inside = (at_x >= other.x0) & (at_x <= other.x1 - 1) & (at_y >= other.y0) & (at_y <= other.y1 - 1)
    at_x, at_y = (places[:, inside.all(axis=0)] for places in (at_x, at_y))
    if not names or at_x.shape[1] < FEWEST_SAMPLES:
        return False
    votes = np.zeros((2, at_x.shape[1]))
    images, of_other = here.read(window, names), there.read(other, names)
    for name in names:
        target = _means_at(images[name], at_x[1] - window.x0, at_y[1] - window.y0)
        errors = [
            np.abs(_means_at(of_other[name], *place) - target).sum(axis=-1)
            for place in zip(at_x - other.x0, at_y - other.y0, strict=True)
        ]
        votes += [np.sign(errors[0] - errors[rival]) for rival in (1, 2)]
    for render in (here, there):
        render.unload()
    against = np.sign(votes)
    counts = np.maximum(np.count_nonzero(against, axis=1), 1)
    return bool((against.sum(axis=1) > SURE * np.sqrt(counts)).any())


def _means_at(image: Array, x: Array, y: Array) -> Array:
    """Return the means (n, c) of the 3 x 3 pixels around positions (n); NaN and infinities count as 0."""
    steps = itertools.product((-1, 0, 1), repeat=2)
    around = np.stack([nearest_indices(x + column, y + row, image.shape[:2]) for row, column in steps])
    # An image may be stored in planes, and reshaping it would copy all of it.
    return np.stack([finite(plane.ravel().take(around)).mean(axis=0) for plane in planes_of(image)], axis=-1)


def _differ(
    here: Mapping[str, Array], there: ReadableRender, area: Window, vectors: Array, known: Mask, turn: float
) -> Mask:
    """Find the pixels (h, w) of an area where layers (c, h, w) show another surface, and those beside them.

    Normals may change by ``turn``.
    """
    window = there.data_window
    ends = (np.arange(area.y0, area.y1, dtype=np.float32)[:, None] + vectors[..., 1])[known]
    first, last = (np.floor(ends.min()), np.ceil(ends.max())) if len(ends) else (window.y0, window.y0)
    first, last = (min(max(int(end), window.y0), window.y1 - 1) for end in (first, last))
    place = Window(window.x0, first, window.x1, last + 1)
    others = {name: planes_of(image) for name, image in there.read(place, list(here)).items()}
    result = np.empty(known.shape, np.bool_)

    def work(rows: slice) -> None:
        around = slice(max(rows.start - REACH, 0), min(rows.stop + REACH, area.height))
        x = np.arange(area.x0, area.x1, dtype=np.float32) + vectors[around, :, 0]
        y = np.arange(area.y0, area.y1, dtype=np.float32)[around, None] + vectors[around, :, 1]
        inside = (x > window.x0 - 0.5) & (x < window.x1 - 0.5) & (y > window.y0 - 0.5) & (y < window.y1 - 0.5)
        compared = inside & known[around]
        nearest = nearest_indices(x - place.x0, y - place.y0, (place.height, place.width))
        other = np.zeros(compared.shape, np.bool_)
        for name, planes in here.items():
            moved = np.stack([plane.ravel().take(nearest, mode="clip") for plane in others[name]])
            least = turn if name == NORMAL else DIFFERENCE
            differs = _differing(finite(planes[:, around]), finite(moved), least, compared)
            if differs.any():
                other |= sum_3x3(differs.astype(np.float32)) >= PIXELS
        if other.any():
            other |= means_around(other.astype(np.float32), AROUND) > MOST
            other = max_around(other)
        result[rows] = other[rows.start - around.start :][: rows.stop - rows.start]

    for_row_blocks(work, area.height, area.width)
    return result


def _differing(one: Array, two: Array, least: float, compared: Mask) -> Mask:
    """Find the pixels (h, w) where planes (c, h, w) differ by more than ``least`` and by more than their roughness."""
    distance = _distance(one, two)
    differs = (distance > least) & compared
    # The roughness takes long, so it is found only where pixels may show another surface, whatever it is.
    if np.count_nonzero(differs) < FEW * differs.size:
        differs = _show_another(one, two, np.float32(least), differs)
    if np.count_nonzero(differs) >= PIXELS:
        limit = np.maximum(_roughness(one), _roughness(two)) * np.float32(MULTIPLE) + np.float32(least)
        differs = _show_another(one, two, limit, differs & (distance > limit))
    return differs


def _show_another(one: Array, two: Array, limit: Array | np.float32, differs: Mask) -> Mask:
    """Find which pixels that differ (h, w) show what is in neither of the 3 x 3 pixels around them in the other frame.

    At the edge of two surfaces a pixel with few samples shows the one or the other by chance.
    """
    y, x = np.nonzero(differs)
    height, width = differs.shape
    places = [
        (np.clip(y + row, 0, height - 1), np.clip(x + column, 0, width - 1))
        for row, column in itertools.product((-1, 0, 1), repeat=2)
    ]
    outside = np.zeros((2, len(y)), np.float32)
    for a, b in zip(one, two, strict=True):
        for total, pixel, other in ((outside[0], a, b), (outside[1], b, a)):
            around = np.stack([other[place] for place in places])
            total += np.square(pixel[y, x] - np.clip(pixel[y, x], around.min(axis=0), around.max(axis=0)))
    result = np.zeros_like(differs)
    result[y, x] = np.sqrt(outside.max(axis=0)) > np.broadcast_to(limit, differs.shape)[y, x]
    return result


def _roughness(planes: Array) -> Array:
    """Return the usual difference of neighbouring pixels of one surface, mean of 3 x 3 pixels (h, w)."""
    # Of two neighbours on opposite sides, at least one lies on the surface of the pixel.
    total = np.zeros(planes.shape[1:], np.float32)
    for turned, sums in ((planes, total), (planes.swapaxes(1, 2), total.T)):
        changes = _distance(turned[:, 1:], turned[:, :-1])
        if len(changes):
            sums[1:-1] += np.minimum(changes[1:], changes[:-1])
            sums[0] += changes[0]
            sums[-1] += changes[-1]
    return sum_3x3(total) / np.float32(9)


def _distance(one: Array, two: Array) -> Array:
    """Return the length (h, w) of the difference of planes (c, h, w)."""
    squares: Array = sum(np.square(a - b) for a, b in zip(one, two, strict=True))
    return np.sqrt(squares)
