# SPDX-License-Identifier: Apache-2.0
"""Guides: the albedo, normals and positions of two frames, which show how surfaces have moved between them.

Unlike the beauty, these layers have little noise and do not depend on the light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import Array, Mask, finite, in_planes
from oiio_msspl.image.filters import box_downsample, sum_3x3
from oiio_msspl.image.parallel import in_parallel

POSITION = "position"
#: Larger frames are averaged down to fewer pixels, which bounds memory.
MAX_PIXELS = 1 << 22
#: Rows that are read at a time.
ROWS = 256
#: Side of the tiles in which movement is measured, in pixels.
TILE = 32
#: How far apart pixels of one frame are compared, in pixels.
NEAR = 3
#: A tile has moved if its content did by more than this, in pixels.
MOVED = 0.15


@dataclass(frozen=True)
class Guide:
    """One feature of both frames, over the same window."""

    name: str
    images: tuple[Array, Array]
    """(h, w, c) of the first and the second frame."""

    @cached_property
    def steepness(self) -> tuple[Array, Array]:
        """How steeply each image rises or falls at a pixel, (h, w) each."""
        return in_parallel(*(partial(_steepness, image) for image in self.images))


@dataclass(frozen=True)
class TwoFrames:
    """Two frames of a shot, over the window that both have."""

    renders: tuple[MappedRender, MappedRender]
    window: Window
    reduction: int
    """Every pixel here is the mean of ``reduction`` x ``reduction`` pixels of the frames."""
    guides: tuple[Guide, ...]

    def read(self, frame: int, channels: Sequence[Channel]) -> Array:
        """Read channels of a frame (0 or 1), reduced as the guides are."""
        return reduced(partial(self.renders[frame].file.read, channels), self.window, self.reduction)


def open_frames(first: MappedRender, second: MappedRender, rows: int | None = None) -> TwoFrames:
    """Read the guides of two frames.

    Normals in camera space are left out, because they change with the camera.

    Args:
        first, second: the frames. If their data windows have nothing in common, the window is empty and no guide read.
        rows: read only this many rows in the middle.

    Raises:
        InputError: pixels can't be decoded.
    """
    renders, window = (first, second), first.data_window.intersect(second.data_window)
    if not window.width or not window.height:
        return TwoFrames(renders, window, 1, ())
    if rows is not None and window.height > rows:
        top = window.y0 + (window.height - rows) // 2
        window = Window(window.x0, top, window.x1, top + rows)
    reduction = 1
    while window.width * window.height > MAX_PIXELS * reduction**2:
        reduction += 1
    names = [name for name in (ALBEDO, NORMAL) if all(has_guide(render, name) for render in renders)]
    with_position = all(render.motion.position for render in renders)

    def images(render: MappedRender) -> dict[str, Array]:
        def read(part: Window) -> Array:  # one read, because layers of a part are decoded together
            pixels = render.read(part, names)
            return np.concatenate([pixels[name] for name in names], axis=-1)

        features = {}
        if names:  # averaged over 3 x 3 pixels, which lowers the noise of few samples
            values = sum_3x3(reduced(read, window, reduction)) / np.float32(9)
            parts = np.split(values, len(names), axis=-1)
            features = dict(zip(names, parts, strict=True))
        if with_position and render.motion.position:
            features[POSITION] = reduced(partial(render.file.read, render.motion.position), window, reduction)
        return {name: in_planes(image) for name, image in features.items()}

    of_first, of_second = in_parallel(*(partial(images, render) for render in renders))
    guides = tuple(Guide(name, (image, of_second[name])) for name, image in of_first.items())
    return TwoFrames(renders, window, reduction, guides)


def has_guide(render: MappedRender, name: str, *, moves: bool = True) -> bool:
    """Return whether a frame has a feature that a surface keeps: a moving camera changes normals in camera space."""
    formula = render.features.get(name)
    return formula is not None and not (moves and ("camera" in formula.note or "screen" in formula.note))


def reduced(read: Callable[[Window], Array], window: Window, reduction: int) -> Array:
    """Read a window in strips of rows and average it down. NaN and infinities become 0."""
    strips = []
    for part in window.bands(ROWS * reduction):
        strip = finite(read(part))
        strips.append(box_downsample(strip, reduction) if reduction > 1 else strip)
    return np.concatenate(strips)


def _steepness(image: Array) -> Array:
    total = np.zeros(image.shape[:2], np.float32)
    for plane in np.moveaxis(image, -1, 0):
        for axis in (0, 1):
            if plane.shape[axis] > 1:
                total += np.abs(np.gradient(plane, axis=axis))
    return total / np.float32(image.shape[-1])


def still_and_moved(frames: TwoFrames) -> tuple[Mask, Mask]:
    """Find the tiles of ``TILE`` x ``TILE`` pixels that are alike in both frames, and those whose content has moved.

    A tile is still if some guide differs less between the frames than between pixels that are ``NEAR`` pixels apart in
    one frame. It has moved if a guide differs much more than that, or if the movement that best explains its
    differences by its gradients (Lucas and Kanade, 1981) is larger than its own uncertainty. Tiles without texture are
    neither.

    Returns:
        Two masks (rows of tiles, columns of tiles).
    """
    shape = tuple(max(side // frames.reduction // TILE, 1) for side in (frames.window.height, frames.window.width))
    still, moved = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    for guide in frames.guides:
        first, second = guide.images
        if min(first.shape[:2]) < 2 * NEAR:
            continue
        mean = (first + second) / 2
        down, right = np.gradient(mean, axis=0), np.gradient(mean, axis=1)
        change = second - first
        near = [np.roll(first, NEAR, axis) - first for axis in (0, 1)]
        xx, xy, yy, xt, yt, tt, apart = (
            _tile_sums(sum(np.einsum("hwc,hwc->hw", a, b) for a, b in pairs), shape)
            for pairs in (
                [(right, right)], [(right, down)], [(down, down)], [(right, change)], [(down, change)],
                [(change, change)], [(v, v) for v in near],
            )
        )  # fmt: skip
        apart = apart / 2
        floor = 1e-6 * float(np.mean(apart)) + 1e-30
        ridge = 0.02 * (xx + yy) + floor  # along an edge nothing can be measured
        a, d = xx + ridge, yy + ridge
        determinant = a * d - xy * xy
        x, y = (xy * yt - d * xt) / determinant, (xy * xt - a * yt) / determinant
        # Smoothing has correlated the noise over 9 pixels, so there are that many fewer independent ones.
        noise = 9 * np.maximum(tt + x * xt + y * yt, 0) / TILE**2
        length = np.hypot(x, y)
        uncertainty = np.sqrt(noise * (a + d) / determinant)
        textured = apart > floor
        moved |= textured & ((tt > 1.5 * apart) | ((length * frames.reduction > MOVED) & (length > 3 * uncertainty)))
        still |= textured & (tt < 0.7 * apart)
    return still & ~moved, moved


def _tile_sums(values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Sum up tiles. Pixels that are left over at the right and at the bottom belong to the last tile."""
    rows, columns = (np.arange(count) * TILE for count in shape)
    return np.asarray(np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, axis=0), columns, axis=1))
