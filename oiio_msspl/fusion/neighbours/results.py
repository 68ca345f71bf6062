# SPDX-License-Identifier: Apache-2.0
"""What the average of fused frames fetches of a neighbour, and how much a pixel of it counts.

``docs/design/temporal.md`` says why neighbours count less at the borders of surfaces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.exr.render import Window
from oiio_msspl.fusion.fuse import FusedFrame
from oiio_msspl.fusion.motion.shot import Motion
from oiio_msspl.fusion.neighbours.bands import from_grid, to_grid
from oiio_msspl.fusion.neighbours.path import Hop, Path
from oiio_msspl.fusion.neighbours.trust import Judge, Light, likeness
from oiio_msspl.fusion.neighbours.weights import WeightedSum
from oiio_msspl.image.arrays import Array, Mask
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import max_around
from oiio_msspl.image.sampling import sample_cubic

#: At the border of two surfaces, a neighbour counts half if it is brighter or darker by this share.
DIFFERENT_MIX = 0.3
#: Neighbours may count fully where the average of renders counts this many frames.
COMPANY = 1.25

Images = dict[str, Array]


class ResultBand:
    """Some rows of a fused frame, to which those of neighbours are added.

    Args:
        frame, light: the frame and its light.
        images: gets colour and alpha over the rows of ``core`` of its data window.
        core, area: see :func:`oiio_msspl.fusion.neighbours.bands.for_bands`.
    """

    def __init__(self, frame: FusedFrame, light: Light, images: Images, core: Window, area: Window) -> None:
        self._light, self._area, self._window = light, area, frame.alignment.hr_data_window
        self._own = images_of(frame, area)
        self._rows = slice(core.y0 - area.y0, core.y1 - area.y0)
        target = {name: image[core.slices(self._window)] for name, image in images.items()}
        for name, image in target.items():
            image[:] = self._own[name][self._rows]
        self._sum = WeightedSum(target)
        #: How much neighbours may count, 0 to 1: not at all where none counts in the average of renders.
        self._company: Array | None = None
        if frame.frames is not None:
            counts = frame.frames[area.slices(self._window)][..., 0]
            self._company = np.clip((counts - 1) / np.float32(COMPANY - 1), 0, 1)
        #: Where the frame may show two surfaces, by the motion to the nearest neighbour on a side.
        self._borders: Mask

    def add(self, hop: Hop[FusedFrame], path: Path, judge: Judge) -> None:
        """Add a fused neighbour that a path leads to."""
        alignment, area = self._light.alignment, self._area
        if path.hops == 1:
            self._borders = _borders(hop.there, self._window, area)
            if path.moved_objects is not None:
                self._borders = self._borders | max_around(path.moved_objects, 2)
        warped = _warp(hop.frame, path)
        picture = to_grid(alignment, np.where(path.valid[..., None], warped[RGB], self._own[RGB]), area)
        weight = from_grid(alignment, judge(picture), area) * path.valid
        if path.nearest is not None:
            weight *= self._light.moved_weight
        if self._company is not None:
            weight *= self._company
        mixed = self._borders | _borders(hop.back, hop.frame.alignment.hr_data_window, area, path.nearest)
        here, there = (luminance(images[RGB][mixed]) for images in (self._own, warped))
        weight[mixed] *= likeness(here, there, self._light.darkest, DIFFERENT_MIX)
        # A neighbour may have no alpha.
        inside = {name: warped.get(name, image)[self._rows] for name, image in self._own.items()}
        self._sum.add(lambda name, rows: inside[name][rows], weight[self._rows])

    def finish(self) -> Array:
        """Turn the sums into means, and return the number of frames."""
        return self._sum.divide()


def _borders(motion: Motion, window: Window, area: Window, nearest: NDArray[np.intp] | None = None) -> Mask:
    """Return the borders of surfaces (h, w) in an area of a frame, or at flat indices (h, w) of its pixels."""
    if motion.borders is None:
        return np.zeros((area.height, area.width), np.bool_)
    return motion.borders[area.slices(window)] if nearest is None else motion.borders.take(nearest, mode="clip")


def _warp(frame: FusedFrame, path: Path) -> Images:
    """Interpolate colour and alpha of a neighbour at the valid positions of a path, (h, w, c) each."""
    place = path.place_in(frame.alignment.hr_data_window)
    images = images_of(frame, place)
    if path.nearest is None:
        return images
    values, shape = list(images.values()), path.valid.shape
    warped = sample_cubic(values, lambda rows: (path.x[rows] - place.x0, path.y[rows] - place.y0), shape, path.valid)
    return dict(zip(images, warped, strict=True))


def images_of(frame: FusedFrame, area: Window) -> Images:
    """Return colour and alpha, if there is one, over an area of the data window, (h, w, c) each."""
    part = area.slices(frame.alignment.hr_data_window)
    return {RGB: frame.rgb[part]} | ({} if frame.alpha is None else {"alpha": frame.alpha[part]})
