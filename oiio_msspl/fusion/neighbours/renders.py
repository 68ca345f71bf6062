# SPDX-License-Identifier: Apache-2.0
"""What the average of renders fetches of a neighbour, and how much a pixel of it counts.

``docs/design/temporal.md`` says why the HRLS comes from the nearest pixels, and the light of the LRHS is interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import ALBEDO, LIGHT_OF, NORMAL, RADIANCE_FEATURES, RGB, VARIANCE, is_light_of_pass
from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.fusion.checks.averages import BRIGHTEST
from oiio_msspl.fusion.checks.noise import has_clean_aovs, is_noise_spread
from oiio_msspl.fusion.neighbours.bands import from_grid, grid_window, to_grid, whole_grid
from oiio_msspl.fusion.neighbours.path import Hop, Path, pixel_positions
from oiio_msspl.fusion.neighbours.trust import WHOLE, Judge, Light, cells, likeness
from oiio_msspl.fusion.neighbours.weights import WeightedSum
from oiio_msspl.fusion.tiles.alignment import Alignment, align
from oiio_msspl.fusion.tiles.features import read_lrhs
from oiio_msspl.image.arrays import Array, Mask, all_finite, repair, unload
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import columns_apart, even_and_odd, interpolate, max_around, means_around
from oiio_msspl.image.sampling import nearest_indices, sample_cubic
from oiio_msspl.model.contract import ONE_SIZE

#: An LRHS pixel of a neighbour counts if this share of its HRLS pixels shows the same surface.
COVERED = 0.9
#: A neighbour counts less near objects that move and are not followed: the less, the more of the HRLS pixels up to
#: ``NEAR_OBJECTS`` away on each side show them, and not at all from the share ``FEW`` on.
NEAR_OBJECTS, FEW = 8, 0.125
#: Where another surface is near, a neighbour counts half if it is brighter or darker by this: the difference, divided
#: by the root of the product. That is a factor of 5.
OTHER_BRIGHTNESS = 4 / 5**0.5
#: There, a neighbour counts less by this, too. It lacks some pixels, so the noise changes from pixel to pixel, and the
#: network takes single noisy pixels for detail.
BESIDE_HIDDEN = np.float32(0.7)
#: Renders may be clean if the variance of the noise of an HRLS pixel is less than this, relative to the light: 12 spp.
#: If albedo and normals are noisy, they gain more by the average than they lose.
CLEAN = 0.08
#: A neighbour's nearest pixel lies up to half a pixel beside the surface, where the albedo may differ. In clean renders
#: that shows, so light is corrected by the ratio of the albedos up to this factor. ``DARK_ALBEDO`` is added to both.
ANOTHER_ALBEDO, DARK_ALBEDO = np.float32(1.25), 0.01
#: Name of the mean of the squared colours of a render's frames, which becomes their variance. It is known where at
#: least this many frames count, and where they scatter by more than the squared colour times the last number.
SQUARES, ENOUGH, EQUAL = "squares of rgb", 2.5, np.float32(1e-6)
#: The usual number of channels of a pair.
USUAL_CHANNELS = 10

Features = dict[str, Array]


@dataclass(frozen=True)
class RenderPair:
    """Both renders of a frame; one render is both."""

    lr: ReadableRender
    hr: ReadableRender

    @property
    def is_one_render(self) -> bool:
        """Whether the frame has one render."""
        return self.lr is self.hr

    @cached_property
    def alignment(self) -> Alignment:
        """How the pair lies over each other."""
        return align(self.lr, self.hr)

    @cached_property
    def colours(self) -> tuple[Array, Array]:
        """Colours of the LRHS, and of the HRLS averaged over its pixels, (h, w, 3) each over the alignment's grid.

        Both show the same places: where an odd size was rounded, the LRHS is interpolated. Of one render, both are
        its :meth:`halves`. All are finite and >= 0.
        """
        high = whole_grid(self.alignment, lambda area: _bounded(repair(read(self.hr, area, [RGB])[RGB])[0]))
        if self.is_one_render:
            return self.halves(high)
        lrhs = read_lrhs(self.lr, self.alignment, self.alignment.grid, [RGB], exact=True)[RGB]
        return _bounded(lrhs), high

    @cached_property
    def cells(self) -> list[Array]:
        """Both :attr:`colours`, averaged to large cells."""
        return [cells(image, self.alignment.scale, WHOLE) for image in self.colours]

    def halves(self, colours: Array) -> tuple[Array, Array]:
        """Return two pictures of the colours (h, w, 3) of one render whose noise is independent."""
        return columns_apart(colours) if self._is_noise_spread else even_and_odd(colours)

    @cached_property
    def _is_noise_spread(self) -> bool:
        return bool(is_noise_spread(self.hr, self.hr, self.alignment))

    @cached_property
    def noise_signs(self) -> NDArray[np.int8]:
        """The signs (h, w) of the noise over the alignment's grid: of LRHS - HRLS."""
        return np.sign(np.subtract(*map(luminance, self.colours))).astype(np.int8)

    @cached_property
    def may_be_broken(self) -> bool:
        """Whether a pixel of the HRLS may be NaN or infinite; True for one that is read from a file."""
        return not isinstance(self.hr, Render) or not all(map(all_finite, self.hr.layers.values()))

    @cached_property
    def has_clean_aovs(self) -> bool:
        """Whether albedo and normal need no average: where the HRLS has moved, that would only blur them."""
        return has_clean_aovs(self.hr, self.alignment)

    def prepare(self) -> None:
        """Compute what each average with a neighbour needs."""
        _ = self.cells, self.noise_signs, self.may_be_broken

    def unload(self) -> None:
        """Give the memory of pixels that wait in temporary files back to the system."""
        self.lr.unload()
        self.hr.unload()


def shared_noise(frame: RenderPair, neighbour: RenderPair) -> float:
    """Return the correlation, from -1 to 1, of the signs of the noise of two frames: of LRHS - HRLS.

    A renderer that uses one seed for all frames gives each pixel the same noise in all of them. Only signs are
    compared: at edges the two renders differ by more than noise, in every frame if the camera stands still. 0 for
    frames whose pixels lie over different places.

    Raises:
        InputError: pixels can't be decoded.
    """
    if frame.alignment.grid != neighbour.alignment.grid:
        return 0.0
    alike = frame.noise_signs * neighbour.noise_signs
    count = np.count_nonzero(alike)
    return float(alike.sum(dtype=np.float64) / count) if count else 0.0


def lacking_passes(frame: RenderPair, neighbour: RenderPair) -> list[str]:
    """Return the names of the passes that a frame's renders have and those of a neighbour lack."""
    renders = (frame.lr, neighbour.lr), (frame.hr, neighbour.hr)
    lacking = {name for own, other in renders for name in _passes(own) - _passes(other)}
    return sorted(name.removeprefix(LIGHT_OF) for name in lacking)


def _passes(render: ReadableRender) -> set[str]:
    names = render.layers if isinstance(render, Render) else getattr(render, "features", ())
    return {name for name in names if is_light_of_pass(name)}


class RenderBand:
    """Some rows of both renders, to which those of neighbours are added.

    Args:
        pair, light: the frame and its light.
        low: the LRHS's features over its data window; the rows of ``core`` are changed. None of one render.
        high: gets the HRLS's features over the rows of ``core`` of its data window, and the variance of its colour if
            it has ``SQUARES``.
        core, area: see :func:`oiio_msspl.fusion.neighbours.bands.for_bands`.
    """

    def __init__(
        self, pair: RenderPair, light: Light, low: Features, high: Features, core: Window, area: Window
    ) -> None:
        self._pair, self._light, self._area = pair, light, area
        self._names, self._low_names = [name for name in high if name != SQUARES], list(low)
        self._alignment = alignment = pair.alignment
        self._rows = slice(core.y0 - area.y0, core.y1 - area.y0)
        self._high_images = {name: image[core.slices(alignment.hr_data_window)] for name, image in high.items()}
        for name, values in read(pair.hr, core, self._names).items():
            self._high_images[name][:] = values
        if SQUARES in high:
            self._high_images[SQUARES][:] = np.square(self._high_images[RGB])
        # Half of the noise of the mean of both renders is that of the HRLS.
        clean = 2 * light.noise * alignment.scale**2 < CLEAN and pair.has_clean_aovs
        own = (ALBEDO, NORMAL) if clean else ()
        self._albedo = repair(self._high_images[ALBEDO])[0] if clean and ALBEDO in self._names else None
        self._high = WeightedSum({name: image for name, image in self._high_images.items() if name not in own})
        #: The grid pixels of the area, and those of ``core`` that the LRHS has: it may lack a row or a column.
        self._grid = grid_window(alignment, area)
        self._colours = [colours[self._grid.slices(alignment.grid)] for colours in pair.colours]
        self._luminance = luminance(self._colours[0])
        #: What a neighbour's HRLS that is hidden is taken for: of one render, both colours are a part of it.
        self._mean_colours = sum(self._colours) / np.float32(2) if pair.is_one_render else self._colours[1]
        self._low_place = grid_window(alignment, core).intersect(alignment.lr_data_window)
        inside = self._low_place.slices(alignment.lr_data_window)
        shown = {name: image[inside] for name, image in low.items() if name not in own}
        self._low = WeightedSum(shown) if shown else None

    def add(self, hop: Hop[RenderPair], path: Path, judge: Judge) -> None:
        """Add the renders of a neighbour that a path leads to."""
        neighbour, alignment, area = hop.frame, self._alignment, self._area
        high, valid = _nearest(neighbour, path, self._names)
        shown = valid.astype(np.float32)
        share = to_grid(alignment, shown, area)
        colours = high(RGB, slice(None))
        hrls = to_grid(alignment, _bounded(colours) * shown[..., None], area)
        hrls = np.where(share[..., None] >= COVERED, hrls / np.maximum(share, 1e-6)[..., None], self._mean_colours)
        if self._low is None:
            lrhs, hrls = self._pair.halves(hrls)
        else:
            low, usable = self._fetch_low(neighbour, path, valid, share)
            usable &= _make_finite(low)
            lrhs = self._in_grid(_bounded(low[RGB]), usable, neighbour.alignment.stretch)
        counted = judge(lrhs, hrls)
        if path.nearest is not None:
            counted = counted * self._light.moved_weight
        if path.moved_objects is not None:
            counted = counted * self._far_from(path.moved_objects)
        bright = likeness(self._luminance, luminance(lrhs), self._light.darkest, OTHER_BRIGHTNESS, steep=True)
        counted = counted * np.where(max_around(share < 1, 2), BESIDE_HIDDEN * bright, np.float32(1))
        weight = from_grid(alignment, counted, area) * shown
        top = self._rows.start

        def pixels(name: str, rows: slice) -> Array:
            if name == SQUARES:
                return np.square(pixels(RGB, rows))
            inside = slice(top + rows.start, top + rows.stop)
            values = colours[inside] if name == RGB else high(name, inside)
            if name != RGB or self._albedo is None or path.nearest is None:
                return values
            return values * _ratio(self._albedo[rows], high(ALBEDO, inside))

        self._high.add(pixels, weight[self._rows])
        if self._low is not None:
            place = self._low_place.slices(self._grid)
            self._low.add(lambda name, rows: low[name][place][rows], (counted * usable)[place])
        neighbour.unload()

    def finish(self) -> Array:
        """Turn the sums into means, and return the number of frames."""
        if self._low is not None:
            self._low.divide()
        frames = self._high.divide()
        if SQUARES in self._high_images:
            squares, square = self._high_images[SQUARES], np.square(self._high_images[RGB])
            scatter = np.maximum(squares - square, 0)
            # Frames of one seed are equal, although each has noise.
            known = (frames >= ENOUGH) & (scatter > EQUAL * square)
            squares[:] = np.where(known, scatter / np.maximum(frames - 1, 1), square)
        for image in self._high_images.values():
            unload(image)
        self._pair.unload()
        return frames

    def _in_grid(self, lrhs: Array, usable: Mask, stretch: tuple[float, float]) -> Array:
        """Bring the colours (h, w, 3) of an LRHS to the grid pixels; where it is not usable, take the frame's own."""
        if stretch != (1.0, 1.0):
            grid = self._grid
            columns, rows = (
                np.arange(start + 0.5, stop) * size - 0.5 - start
                for start, stop, size in zip((grid.x0, grid.y0), (grid.x1, grid.y1), stretch, strict=True)
            )
            lrhs, share = (
                interpolate(interpolate(plane, rows, 0), columns, 1) for plane in (lrhs, usable.astype(np.float32))
            )
            usable = share > 0.999  # a sum of shares may be rounded
        return np.where(usable[..., None], lrhs, self._colours[0])

    def _far_from(self, moved_objects: Mask) -> Array:
        """Return how much a neighbour counts around objects that are not followed: 0 to 1, (h, w) over the grid."""
        share = to_grid(self._alignment, moved_objects.astype(np.float32), self._area)
        near = means_around(share, max(1, round(NEAR_OBJECTS / self._alignment.scale)))
        return np.maximum(1 - near / np.float32(FEW), 0)

    def _fetch_low(self, neighbour: RenderPair, path: Path, valid: Mask, share: Array) -> tuple[Features, Mask]:
        """Fetch a neighbour's LRHS over the grid pixels, and where it shows enough of the same surface."""
        data = neighbour.alignment.lr_data_window
        x, y = self._low_positions(path, valid, share)
        usable = (x > data.x0 - 0.5) & (x < data.x1 - 0.5) & (y > data.y0 - 0.5) & (y < data.y1 - 0.5)
        usable &= share >= COVERED
        x, y = np.clip(x, data.x0, data.x1 - 1), np.clip(y, data.y0, data.y1 - 1)
        top = max(int(np.floor(y.min())) - 1, data.y0)
        place = Window(data.x0, top, data.x1, min(int(np.floor(y.max())) + 3, data.y1))
        pixels = _with_finite_passes(read(neighbour.lr, place, self._low_names))
        x, y = x - place.x0, y - place.y0
        light = (*RADIANCE_FEATURES, VARIANCE, "alpha")
        # A render of full size has noise to remove.
        moves = path.nearest is not None and self._alignment.scale > ONE_SIZE
        smooth = [name for name in pixels if moves and (name in light or is_light_of_pass(name))]
        features = {}
        if smooth:
            images = [pixels.pop(name) for name in smooth]
            samples = sample_cubic(images, lambda rows: (x[rows], y[rows]), x.shape, usable)
            features = dict(zip(smooth, samples, strict=True))
        nearest = nearest_indices(x, y, (place.height, place.width))
        return {name: _take(_flat_planes(image), nearest) for name, image in pixels.items()} | features, usable

    def _low_positions(self, path: Path, valid: Mask, share: Array) -> tuple[Array, Array]:
        """Return where the grid pixels are in the neighbour: they move as their HRLS pixels do on average."""
        x, y = pixel_positions(self._grid)
        if path.nearest is None:
            return x, y
        pixels = np.maximum(share, 1e-6) * np.float32(self._alignment.scale)
        moved_x, moved_y = (
            to_grid(self._alignment, np.where(valid, end - start, np.float32(0)), self._area) / pixels
            for start, end in zip(pixel_positions(self._area), (path.x, path.y), strict=True)
        )
        return x + moved_x, y + moved_y


def _nearest(neighbour: RenderPair, path: Path, names: Sequence[str]) -> tuple[Callable[[str, slice], Array], Mask]:
    """Read a neighbour's HRLS at the pixels that are nearest to the positions of a path.

    Returns:
        A function of a feature and rows to its pixels (n, w, c), not to be changed: 0 where they are not finite; and
        where the path is valid and all features are finite, (h, w).
    """
    window, nearest, valid = neighbour.alignment.hr_data_window, path.nearest, path.valid
    place = path.place_in(window)
    first = (place.y0 - window.y0) * window.width
    images = read(neighbour.hr, place, names)
    if neighbour.may_be_broken:
        images = _with_finite_passes(images)
        finite = _make_finite(images)
        if not finite.all():  # copies of all indices take memory
            valid = valid & (finite if nearest is None else finite.take(nearest - first))
    if nearest is None:
        return lambda name, rows: images[name][rows], valid
    planes = {name: _flat_planes(image) for name, image in images.items()}
    return lambda name, rows: _take(planes[name], nearest[rows] - first), valid


def _ratio(own: Array, other: Array) -> Array:
    """Return what brings light of a surface of albedo ``other`` to the albedo ``own`` beside it, (h, w, 3)."""
    dark = np.float32(DARK_ALBEDO)
    return np.clip((own + dark) / (np.maximum(other, 0) + dark), 1 / ANOTHER_ALBEDO, ANOTHER_ALBEDO)


def _take(planes: Sequence[Array], indices: NDArray[np.intp]) -> Array:
    """Return the pixels (h, w, c) of flat planes at flat indices (h, w)."""
    values = np.empty((len(planes), *indices.shape), np.float32)
    for plane, out in zip(planes, values, strict=True):
        # "wrap" makes NumPy write straight into the result; no index needs it.
        plane.take(indices, out=out, mode="wrap")
    return np.moveaxis(values, 0, -1)


def _flat_planes(image: Array) -> list[Array]:
    """Return the channels of an image (h, w, c), (h * w) each, copied only if their pixels are apart in memory."""
    return [np.asarray(plane).reshape(-1) for plane in np.moveaxis(image, -1, 0)]


def _with_finite_passes(features: Features) -> Features:
    """Repair the passes, so that a broken pixel of a pass does not count against the beauty."""
    return {name: repair(v, signed=True)[0] if is_light_of_pass(name) else v for name, v in features.items()}


def _make_finite(features: Features) -> Mask:
    """Return where all features are finite, (h, w), and set other pixels to 0."""
    finite = np.ones(next(iter(features.values())).shape[:2], bool)
    for values in features.values():
        if not all_finite(values):
            finite &= np.isfinite(values).all(axis=-1)
    if not finite.all():
        for name, values in features.items():
            features[name] = np.where(finite[..., None], values, np.float32(0))
    return finite


def _bounded(rgb: Array) -> Array:
    """Return finite colours (h, w, 3) without values that are negative, or so large that sums overflow."""
    return np.clip(rgb, 0, BRIGHTEST)


def read(render: ReadableRender, window: Window, features: Sequence[str] | None = None) -> Features:
    """Read features over a window that counts from the top left of the display window."""
    return render.read(window.shift(render.display_window.x0, render.display_window.y0), features)
