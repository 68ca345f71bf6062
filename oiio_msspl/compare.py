# SPDX-License-Identifier: Apache-2.0
"""Comparing EXR files with a reference: scores, and a picture of the error."""

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
from oiio_msspl.exr.preview import SOFTWARE, write_png
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import HALF_MAX, Array, repair
from oiio_msspl.image.colour import converted, same_space, space_of
from oiio_msspl.image.metrics import RELMSE_GHARBI, SSIM_WINDOW, psnr, relmse, relmse_map, ssim
from oiio_msspl.model.contract import SCALES

#: The "Software" entry of error maps. It differs from that of previews, because fusing deletes old previews.
ERROR_MAP_SOFTWARE = f"{SOFTWARE} compare"


def scores(image: Array, reference: Array) -> dict[str, float]:
    """All measures of :mod:`oiio_msspl.image.metrics`.

    Args:
        image, reference: scene linear, (height, width, 3).

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
    """The images, and behind them the reference if there is one."""
    has_reference: bool
    largest: int
    """Position of the render at whose size all are compared: the reference, or else the largest image."""
    windows: list[Window]
    """What is compared of each render, see :func:`common_windows`."""
    broken: dict[str, int] = field(default_factory=dict)
    """Numbers of values that were NaN or infinite, by the name of the render, as far as it was read. NaN counts as
    black, infinity as the largest half float of its sign."""

    @cached_property
    def truth(self) -> Array:
        """The beauty of the reference, (height, width, 3)."""
        return self._read(-1)

    def image(self, position: int) -> Array:
        """The beauty of an image, upsampled to the size of the reference if it is smaller."""
        image, (height, width) = self._read(position), self.truth.shape[:2]
        return image if image.shape == self.truth.shape else upsample_bicubic(image, width, height)

    def _read(self, position: int) -> Array:
        """The beauty of a render without NaN and infinities, in the linear RGB space of the largest one."""
        render = self.renders[position]
        rgb, broken = repair(render.read(self.windows[position], [RGB])[RGB], signed=True)
        if broken is not None:
            self.broken[render.name] = int(np.count_nonzero(broken))
        return in_space_of(rgb, render, self.renders[self.largest])


def open_comparison(images: Sequence[Path], reference: Path | None = None, layer: str | None = None) -> Comparison:
    """Read the headers of the files to compare.

    Args:
        images: EXR files. One may be smaller than the largest by x2, x4 or x8.
        reference: EXR file of what the images should be.
        layer: of all files, in place of their beauty.

    Returns:
        The files with the view, or view layer, that the first image has in front. A file that lacks it takes part with
        its own first one, see :func:`note_on_views`.

    Raises:
        InputError: a file can't be read or lacks what is compared, or see :func:`common_windows`.
    """
    paths = [*images, *([reference] if reference else [])]
    renders = _renders_of_one_view(paths, {RGB: layer} if layer else {})
    sizes = [each.data_window.width * each.data_window.height for each in renders]
    largest = len(renders) - 1 if reference else sizes.index(max(sizes))
    return Comparison(renders, reference is not None, largest, common_windows(renders, renders[largest]))


def _renders_of_one_view(paths: Sequence[Path], mapping: dict[str, str]) -> list[MappedRender]:
    """Files with the view, or view layer, that the first one has in front; those that lack it with their own first."""
    renders: list[MappedRender] = []
    for path in paths:
        file = open_exr(path)
        render = map_render(file, mapping, features=())
        wanted = renders[0].view if renders else ""
        if wanted != render.view and any(wanted in (label, *label.split("/")) for label in render.other_views):
            render = map_render(file, mapping, view=wanted, features=())
        renders.append(render)
    return renders


def score_images(comparison: Comparison) -> list[dict[str, float]]:
    """The :func:`scores` of each image. One that is smaller than the reference is upsampled bicubically first.

    Raises:
        InputError: pixels can't be read, or what is compared is too small.
    """
    render, window = comparison.renders[-1], comparison.windows[-1]
    if min(window.height, window.width) < SSIM_WINDOW:
        what = "is" if window == render.data_window else "the part that all files show is"
        raise InputError(f"{render.name}: {what} {window.size}; SSIM needs at least {SSIM_WINDOW} pixels each way")
    return [scores(comparison.image(i), comparison.truth) for i in range(len(comparison.renders) - 1)]


def in_space_of(rgb: Array, render: MappedRender, other: MappedRender) -> Array:
    """Colours (h, w, 3) of a render in the linear RGB space of another one. They stay as they are unless both headers
    declare a space."""
    source, target = space_of(render.metadata), space_of(other.metadata)
    return rgb if source is None or target is None else converted(rgb, source, target)


def note_on_spaces(comparison: Comparison) -> str:
    """A sentence for the user if pictures are converted to another linear RGB space; empty if none is."""
    largest = comparison.renders[comparison.largest]
    target = space_of(largest.metadata)
    spaces = {each.name: space_of(each.metadata) for each in comparison.renders}
    if target is None:
        return ""
    others = [f"{name} ({space.name})" for name, space in spaces.items() if space and not same_space(space, target)]
    if not others:
        return ""
    return f"Converted to {target.name}, the colour space of {largest.name}: {', '.join(others)}"


def note_on_views(comparison: Comparison) -> str:
    """A sentence for the user if a file lacks the view, or view layer, of the first image; empty if all have it, and
    if no file has several."""
    renders = comparison.renders
    wanted = renders[0].view
    same = all(wanted in (each.view, *each.view.split("/")) for each in renders)
    if same or not any(each.other_views for each in renders):
        return ""
    return f"Different views are compared: {', '.join(f'{name_of(each.view)} of {each.name}' for each in renders)}"


def notes_on_broken(comparison: Comparison) -> list[str]:
    """A sentence for the user for each render that was read and has values that are NaN or infinite."""
    return [
        f"{name}: {count} values are NaN or infinite; NaN counts as black here, infinity as {HALF_MAX:.0f}"
        for name, count in comparison.broken.items()
    ]


def note_on_windows(comparison: Comparison) -> str:
    """A sentence for the user if not all files show the whole frame, so that only a part can be compared.

    Returns:
        An empty text if all that the files show is compared.
    """
    if comparison.windows == [render.data_window for render in comparison.renders]:
        return ""
    part = comparison.windows[comparison.largest]
    return f"The data windows differ; only the part that all pictures show is compared: {part}"


@dataclass(frozen=True)
class _Place:
    """Where a render lies in the pixels of the one at whose size all are compared.

    Its pixel x covers those from ``x0 + scale * x`` on, ``scale`` of them; y likewise.
    """

    scale: int
    x0: int
    y0: int
    shown: Window
    """What it shows."""


def common_windows(renders: Sequence[MappedRender], largest: MappedRender) -> list[Window]:
    """The rectangle of each render, in its own pixels, over which all of them are compared.

    Renders are laid over each other by their places in their display windows, if these are equal, or one of them is
    cropped and the sizes of their display windows differ by a scale of ``SCALES``. Each other one shows what the data
    window of ``largest`` shows, at its size or smaller by such a scale.

    Args:
        renders: what is compared.
        largest: the one of these at whose size all are compared.

    Raises:
        InputError: a size does not fit, or renders have no part in common.
    """
    whole = common = largest.data_window
    places = [_place(each, largest) for each in renders]
    for place in places:
        common = common.intersect(place.shown)
    if common == whole and all(place.scale == 1 or place.shown == whole for place in places):
        # An odd side may have been rounded, so smaller renders may show a little more or less.
        return [
            whole.shift(-place.x0, -place.y0) if place.scale == 1 and place.shown != whole else each.data_window
            for each, place in zip(renders, places, strict=True)
        ]
    # Smaller renders are cut between whole pixels.
    columns = [x for x in range(common.x0, common.x1 + 1) if all((x - each.x0) % each.scale == 0 for each in places)]
    rows = [y for y in range(common.y0, common.y1 + 1) if all((y - each.y0) % each.scale == 0 for each in places)]
    if len(columns) < 2 or len(rows) < 2:
        names = ", ".join(f"{each.name} ({each.data_window})" for each in renders)
        raise InputError(f"these pictures have no part of the frame in common: {names}; compare those of one part")
    return [
        Window(
            (columns[0] - each.x0) // each.scale,
            (rows[0] - each.y0) // each.scale,
            (columns[-1] - each.x0) // each.scale,
            (rows[-1] - each.y0) // each.scale,
        )
        for each in places
    ]


def _place(render: MappedRender, largest: MappedRender) -> _Place:
    """Where a render lies in the pixels of another one.

    Raises:
        InputError: its size does not fit.
    """
    data, display, whole, frame = render.data_window, render.display_window, largest.data_window, largest.display_window
    if display == frame:
        return _Place(1, 0, 0, data)
    scale = _scale(display, frame)
    if scale and (data != display or whole != frame):
        x0, y0 = frame.x0 - scale * display.x0, frame.y0 - scale * display.y0
        return _Place(scale, x0, y0, Window(*(scale * side for side in astuple(data))).shift(x0, y0))
    scale = _scale(data, whole)
    if scale:
        return _Place(scale, whole.x0 - scale * data.x0, whole.y0 - scale * data.y0, whole)
    raise InputError(f"{render.name} is {data.size}, but {largest.name} is {whole.size}; compare pictures of one size")


def _scale(window: Window, other: Window) -> int | None:
    """How much smaller a window is than another one; None if its size is neither the same nor smaller by a scale of
    ``SCALES``."""
    sides = ((window.height, other.height), (window.width, other.width))
    # An odd side may have been rounded up or down.
    return next((scale for scale in (1, *SCALES) if all(a in (b // scale, -(-b // scale)) for a, b in sides)), None)


def check_error_map(path: Path, compared: Sequence[Path], *, overwrite: bool) -> None:
    """Check that an error map of the files ``compared`` can be written at ``path``.

    Raises:
        InputError: it is not named .png, it is one of the files compared, it exists and may not be overwritten, or its
            folder is missing or read-only.
    """
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: the error map is a PNG; name it .png")
    check_target(path, overwrite=overwrite)
    check_separate(compared, [path])


def write_error_map(path: Path, comparison: Comparison, *, overwrite: bool) -> None:
    """Write the :func:`error_map` of the first image as a PNG.

    Args:
        path: the PNG to write.
        comparison: the image and its reference.
        overwrite: replace an existing file.

    Raises:
        InputError: pixels can't be read, or ``path`` exists.
        MssplError: the PNG can't be written.
    """
    picture = error_map(comparison.image(0), comparison.truth)
    write_png(path, picture, software=ERROR_MAP_SOFTWARE, overwrite=overwrite)


def error_map(image: Array, truth: Array) -> Array:
    """The :func:`error_levels` of an image in the :func:`error_colours`: display values, (height, width, 3)."""
    return error_colours(error_levels(image, truth))


def error_levels(image: Array, truth: Array) -> Array:
    """log10 of each pixel's RelMSE (0.5, 0.01).

    Args:
        image, truth: scene linear, (height, width, 3).

    Returns:
        (height, width) in [0, 1]: 0 is an error of 1e-5 or less, 1 an error of 1 or more.
    """
    error = relmse_map(image, truth).mean(axis=-1)
    return ((np.log10(np.maximum(error, 1e-5)) + 5) / 5).clip(0, 1).astype(np.float32)


def error_colours(levels: Array) -> Array:
    """OpenImageIO's "inferno" colours, (height, width, 3) in [0, 1], of the levels (height, width)."""
    mapped = oiio.ImageBufAlgo.color_map(oiio.ImageBuf(np.ascontiguousarray(levels[..., None])), 0, "inferno")
    if mapped.has_error:
        raise MssplError(f"the error map's colours: {mapped.geterror()}")
    return np.asarray(mapped.get_pixels(oiio.FLOAT), dtype=np.float32)[..., :3]


def upsample_bicubic(image: Array, width: int, height: int) -> Array:
    """Bicubic resampling (OpenImageIO's "cubic"): (h, w, 3) to (height, width, 3); negative values become 0."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(image))
    result = oiio.ImageBufAlgo.resize(buffer, filtername="cubic", roi=oiio.ROI(0, width, 0, height))
    return np.maximum(np.asarray(result.get_pixels(oiio.FLOAT), dtype=np.float32), 0)
