# SPDX-License-Identifier: Apache-2.0
"""Compare EXR files with a reference: scores, and the error of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_separate, check_target
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import Array, repair
from oiio_msspl.image.colour import converted, same_space, space_of
from oiio_msspl.image.metrics import RELMSE_GHARBI, SSIM_WINDOW, psnr, relmse, relmse_map, ssim
from oiio_msspl.jobs.report import WEIGHTS_ATTRIBUTE
from oiio_msspl.model.contract import SCALES


def scores(image: Array, reference: Array) -> dict[str, float]:
    """Measure an image, scene linear (height, width, 3), by all metrics of :mod:`oiio_msspl.image.metrics`.

    Returns:
        ``psnr`` in dB, ``relmse`` with the constants 0.5 and 0.01, ``relmse_gharbi`` with 1 and 1e-4, and ``ssim``.
    """
    return {
        "psnr": psnr(image, reference),
        "relmse": relmse(image, reference),
        "relmse_gharbi": relmse(image, reference, RELMSE_GHARBI),
        "ssim": ssim(image, reference),
    }


@dataclass(frozen=True)
class Comparison:
    """EXR files whose beauties are compared, over the part of the frame that all of them show."""

    renders: list[MappedRender]
    """The images, and then the reference if there is one."""
    has_reference: bool
    largest: int
    """Position of the render at whose size all are compared: the reference, or else the largest image."""
    windows: list[Window]
    """The compared rectangle of every render, see :func:`common_windows`."""
    broken: dict[str, int] = field(default_factory=dict)
    """Numbers of NaN and infinite values by the name of the render, for renders that were read. NaN counts as black,
    infinity as the largest half float of its sign."""

    @cached_property
    def truth(self) -> Array:
        """The beauty of the reference, (height, width, 3)."""
        return self._read(-1)

    def image(self, position: int) -> Array:
        """Return the beauty of an image, upsampled to the size of the reference if it is smaller."""
        return upsampled_like(self._read(position), self.truth)

    def _read(self, position: int) -> Array:
        """Read a beauty without NaN and infinities, in the linear RGB space of the largest render."""
        render = self.renders[position]
        rgb, broken = repair(render.read(self.windows[position], [RGB])[RGB], signed=True)
        if broken is not None:
            self.broken[render.name] = int(np.count_nonzero(broken))
        return in_space_of(rgb, render, self.renders[self.largest])


def open_comparison(images: Sequence[Path], reference: Path | None = None, layer: str | None = None) -> Comparison:
    """Read the headers of the files to compare.

    Args:
        images: EXR files. One may be smaller than the largest by x2, x4 or x8.
        reference: EXR file of the converged frame.
        layer: layer of all files to compare in place of their beauty.

    Returns:
        The files with the first view, or view layer, of the first image. A file that lacks it takes part with its own
        first one, see :func:`notes`.

    Raises:
        InputError: a file can't be read, lacks the beauty or the layer, or see :func:`common_windows`.
    """
    mapping = {RGB: layer} if layer else {}
    renders: list[MappedRender] = []
    for path in [*images, *([reference] if reference else [])]:
        render = map_render(open_exr(path), mapping, features=())
        view = renders[0].view if renders else ""
        if view != render.view and any(view in (label, *label.split("/")) for label in render.other_views):
            render = map_render(render.file, mapping, view=view, features=())
        renders.append(render)
    sizes = [render.data_window.width * render.data_window.height for render in renders]
    largest = len(renders) - 1 if reference else sizes.index(max(sizes))
    return Comparison(renders, reference is not None, largest, common_windows(renders, renders[largest]))


def score_images(comparison: Comparison) -> list[dict[str, float]]:
    """Return the :func:`scores` of all images. Those smaller than the reference are upsampled bicubically first."""
    render, window = comparison.renders[-1], comparison.windows[-1]
    if min(window.height, window.width) < SSIM_WINDOW:
        part = "is" if window == render.data_window else "the part that all files show is"
        raise InputError(f"{render.name}: {part} {window.size}; SSIM needs at least {SSIM_WINDOW} pixels each way")
    return [scores(comparison.image(i), comparison.truth) for i in range(len(comparison.renders) - 1)]


def in_space_of(rgb: Array, render: MappedRender, target: MappedRender) -> Array:
    """Convert colours (h, w, 3) of a render to the linear RGB space of another one if their headers declare both."""
    source_space, target_space = space_of(render.metadata), space_of(target.metadata)
    return rgb if source_space is None or target_space is None else converted(rgb, source_space, target_space)


def notes(comparison: Comparison) -> list[str]:
    """Say by the headers which files differ in view, window, colour space, or the weights that fused them."""
    renders, largest, said = comparison.renders, comparison.renders[comparison.largest], []
    view_is_in_all = all(renders[0].view in (render.view, *render.view.split("/")) for render in renders)
    if not view_is_in_all and any(render.other_views for render in renders):
        said.append(f"Different views are compared: {', '.join(f'{name_of(r.view)} of {r.name}' for r in renders)}")
    if comparison.windows != [render.data_window for render in renders]:
        part = comparison.windows[comparison.largest]
        said.append(f"The data windows differ; only the part that all pictures show is compared: {part}")
    if target := space_of(largest.metadata):
        spaces = {render.name: space_of(render.metadata) for render in renders}
        others = [f"{name} ({space.name})" for name, space in spaces.items() if space and not same_space(space, target)]
        if others:
            said.append(f"Converted to {target.name}, the colour space of {largest.name}: {', '.join(others)}")
    names = ("msspl/version", WEIGHTS_ATTRIBUTE)
    makers = {r.name: ", ".join(r.metadata[name] for name in names if name in r.metadata) for r in renders}
    fused = {name: maker for name, maker in makers.items() if maker}
    if len(set(fused.values())) > 1:
        said.append(f"Different versions or weights made these: {'; '.join(f'{k} ({v})' for k, v in fused.items())}")
    return said


@dataclass(frozen=True)
class _Place:
    """Position of a render in the pixels of the largest one.

    Its pixel x covers the ``scale`` pixels from ``x0 + scale * x`` on; y likewise.
    """

    scale: int
    x0: int
    y0: int
    shown: Window
    """The pixels of the largest render that this one shows."""


def common_windows(renders: Sequence[MappedRender], largest: MappedRender) -> list[Window]:
    """Return the rectangles, in the pixels of every render, over which all of them are compared.

    Renders are laid over each other by their display windows if these are equal, or if one is cropped and the sizes of
    their display windows differ by a scale of ``SCALES``. Otherwise a render shows the data window of ``largest``, at
    its size or smaller by such a scale.
    """
    whole = common = largest.data_window
    places = [_place(render, largest) for render in renders]
    for place in places:
        common = common.intersect(place.shown)
    if common == whole and all(place.scale == 1 or place.shown == whole for place in places):
        # An odd side may have been rounded, so smaller renders may show a little more or less.
        return [
            whole.shift(-place.x0, -place.y0) if place.scale == 1 and place.shown != whole else render.data_window
            for render, place in zip(renders, places, strict=True)
        ]
    # Smaller renders are cut between whole pixels.
    columns = [x for x in range(common.x0, common.x1 + 1) if all((x - p.x0) % p.scale == 0 for p in places)]
    rows = [y for y in range(common.y0, common.y1 + 1) if all((y - p.y0) % p.scale == 0 for p in places)]
    if len(columns) < 2 or len(rows) < 2:
        names = ", ".join(f"{render.name} ({render.data_window})" for render in renders)
        raise InputError(f"these pictures have no part of the frame in common: {names}; compare those of one part")
    shared = Window(columns[0], rows[0], columns[-1], rows[-1])
    return [Window(*(side // p.scale for side in astuple(shared.shift(-p.x0, -p.y0)))) for p in places]


def _place(render: MappedRender, largest: MappedRender) -> _Place:
    """Place a render in the pixels of the largest one, or refuse its size."""
    data, display, whole, frame = render.data_window, render.display_window, largest.data_window, largest.display_window
    if (scale := _scale(display, frame)) and (display == frame or data != display or whole != frame):
        x0, y0 = frame.x0 - scale * display.x0, frame.y0 - scale * display.y0
        return _Place(scale, x0, y0, Window(*(scale * side for side in astuple(data))).shift(x0, y0))
    if scale := _scale(data, whole):
        return _Place(scale, whole.x0 - scale * data.x0, whole.y0 - scale * data.y0, whole)
    raise InputError(f"{render.name} is {data.size}, but {largest.name} is {whole.size}; compare pictures of one size")


def _scale(window: Window, larger: Window) -> int | None:
    """Return how many times smaller a window is: 1 or one of ``SCALES``; None if it is no such scale."""
    sides = ((window.height, larger.height), (window.width, larger.width))
    # An odd side may have been rounded up or down.
    return next((scale for scale in (1, *SCALES) if all(a in (b // scale, -(-b // scale)) for a, b in sides)), None)


def check_page(path: Path, compared: Sequence[Path], *, overwrite: bool) -> None:
    """Raise InputError if ``path`` is not named as a page, or can't be written beside the files ``compared``."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: the page is HTML; name it .html")
    check_target(path, overwrite=overwrite)
    check_separate(compared, [path])


def error_levels(image: Array, truth: Array) -> Array:
    """Return log10 of every pixel's RelMSE (0.5, 0.01), scaled to [0, 1]: 0 for 1e-5 or less, 1 for 1 or more.

    ``image`` and ``truth`` are scene linear, (height, width, 3).
    """
    error = relmse_map(image, truth).mean(axis=-1)
    return ((np.log10(np.maximum(error, 1e-5)) + 5) / 5).clip(0, 1).astype(np.float32)


def error_colours(levels: Array) -> Array:
    """Colour levels (height, width) with OpenImageIO's "inferno": (height, width, 3) in [0, 1]."""
    mapped = oiio.ImageBufAlgo.color_map(oiio.ImageBuf(np.ascontiguousarray(levels[..., None])), 0, "inferno")
    if mapped.has_error:
        raise MssplError(f"the error map's colours: {mapped.geterror()}")
    return np.asarray(mapped.get_pixels(oiio.FLOAT), dtype=np.float32)[..., :3]


def upsampled_like(image: Array, truth: Array) -> Array:
    """Return an image at the size of its reference, upsampled bicubically if it is smaller."""
    height, width = truth.shape[:2]
    return image if image.shape == truth.shape else upsample_bicubic(image, width, height)


def upsample_bicubic(image: Array, width: int, height: int) -> Array:
    """Resample (h, w, 3) to (height, width, 3) with OpenImageIO's "cubic"; negative values become 0."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(image))
    result = oiio.ImageBufAlgo.resize(buffer, filtername="cubic", roi=oiio.ROI(0, width, 0, height))
    return np.maximum(np.asarray(result.get_pixels(oiio.FLOAT), dtype=np.float32), 0)
