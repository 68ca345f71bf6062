# SPDX-License-Identifier: Apache-2.0
"""Computes the motion that the camera causes, from its matrices in the headers and from positions.

Renderers disagree on the meaning of their matrices, and some write a matrix under the wrong name. So all are tried: the
right one projects the positions of a frame onto the pixels that hold them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.fusion.motion.vectors import no_vectors
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.parallel import for_row_blocks

#: Header attributes that hold such a matrix, in lower case: by Arnold, Karma, Mantra and RenderMan.
MATRICES = ("worldtoscreen", "worldtondc", "np", "worldtocamera", "nl")
#: Pixels by which a matrix is judged.
SAMPLES = 4096
#: A matrix is right if positions land this close to their pixel, in pixels. A single sample lies anywhere in it.
CLOSE = 0.75


@dataclass(frozen=True)
class Projection:
    """How a matrix is to be read, as the pixels of a frame have shown."""

    attribute: str
    """Name of the header attribute."""
    divisor: int
    """Column by which the first two are divided: 3 of a matrix to the screen, 2 of one to the camera."""
    scale: tuple[float, float]
    shift: tuple[float, float]
    """pixel = projected * scale + shift, in x and y."""

    def project(self, positions: Array, matrix: NDArray[np.float32]) -> Array:
        """Project positions (..., 3) to pixels of the frame, x and y (..., 2); NaN behind the camera."""
        seen = positions @ matrix[:3] + matrix[3]
        with np.errstate(divide="ignore", invalid="ignore"):
            result: Array = seen[..., :2] / seen[..., self.divisor : self.divisor + 1]
        return result * np.array(self.scale, np.float32) + np.array(self.shift, np.float32)


def find_projection(render: MappedRender) -> Projection | None:
    """Find out how the matrices of a shot are to be read: one of the header projects positions onto their pixels.

    None if there are none, or none fits.
    """
    names = [name for known in MATRICES for name in render.metadata if name.lower() == known]
    matrices = {name: matrix for name in names if (matrix := _matrix(render, name)) is not None}
    if not render.motion.position or not matrices:
        return None
    window = render.data_window
    positions = render.file.read(render.motion.position, window)
    good = np.isfinite(positions).all(axis=-1) & (positions != 0).any(axis=-1)
    y, x = np.nonzero(good)
    if len(x) < 64:
        return None
    chosen = np.linspace(0, len(x) - 1, min(len(x), SAMPLES)).astype(np.int64)
    points = positions[y[chosen], x[chosen]]
    pixels = np.stack([x[chosen] + window.x0, y[chosen] + window.y0], axis=-1).astype(np.float32)
    return next(filter(None, (_fit(name, matrix, points, pixels) for name, matrix in matrices.items())), None)


def camera_vectors(render: MappedRender, neighbour: MappedRender, projection: Projection) -> tuple[Array, Mask]:
    """Compute vectors to a neighbour (h, w, 2) as if all surfaces stood still, and where there are any (h, w)."""
    window = render.data_window
    vectors, known = no_vectors(render)
    here, there = (_matrix(frame, projection.attribute) for frame in (render, neighbour))
    if here is None or there is None or not render.motion.position:
        return vectors, known
    positions = render.file.read(render.motion.position, window)
    distances = np.empty(known.shape, np.float32)

    def work(rows: slice) -> None:
        points = positions[rows]
        y, x = np.mgrid[rows.start : rows.stop, 0 : window.width].astype(np.float32)
        limit = np.hypot(render.display_window.width, render.display_window.height)
        with np.errstate(invalid="ignore"):  # NumPy's settings for errors belong to the thread
            now = projection.project(points, here)
            way = projection.project(points, there) - now
            distances[rows] = np.hypot(now[..., 0] - x - window.x0, now[..., 1] - y - window.y0)
            known[rows] = (np.hypot(way[..., 0], way[..., 1]) < limit) & (points != 0).any(axis=-1)
        vectors[rows] = np.where(known[rows, :, None], way, 0)

    for_row_blocks(work, window.height, window.width * 12)
    # A lens that zooms changes the scale, which a matrix to the camera alone does not say.
    if not known.any() or np.median(distances[known]) > CLOSE:
        return no_vectors(render)
    return vectors, known


def _matrix(render: MappedRender, attribute: str) -> NDArray[np.float32] | None:
    """Read a matrix of the header. OpenEXR and OpenImageIO store it for row vectors."""
    try:
        values = np.array(render.metadata.get(attribute), np.float32).reshape(4, 4)
    except (TypeError, ValueError):
        return None
    return values if np.isfinite(values).all() else None


def _fit(attribute: str, matrix: NDArray[np.float32], points: Array, pixels: Array) -> Projection | None:
    """Fit the scale and shift with which a matrix projects points (n, 3) onto pixels (n, 2); None if it does not."""
    seen = points @ matrix[:3] + matrix[3]
    divisor = 2 if np.allclose(matrix[:, 3], (0, 0, 0, 1)) else 3
    if np.abs(seen[:, divisor]).min() < 1e-9:
        return None
    projected = (seen[:, :2] / seen[:, divisor : divisor + 1]).astype(np.float64)
    use = np.ones(len(points), np.bool_)
    for _ in range(4):  # edges of surfaces, where positions are mixtures, drop out
        fits = [np.polyfit(projected[use, axis], pixels[use, axis], 1) for axis in (0, 1)]
        wrong = np.hypot(*(projected[:, axis] * fits[axis][0] + fits[axis][1] - pixels[:, axis] for axis in (0, 1)))
        use = wrong <= max(2 * float(np.median(wrong)), 1e-3)
    if np.median(wrong) > CLOSE:
        return None
    (scale_x, shift_x), (scale_y, shift_y) = fits
    return Projection(attribute, divisor, (float(scale_x), float(scale_y)), (float(shift_x), float(shift_y)))
