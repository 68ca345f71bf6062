# SPDX-License-Identifier: Apache-2.0
"""Comparing EXR files with a reference: scores, and a picture of the error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.arrays import Array, repair
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_separate, check_target
from oiio_msspl.exr.preview import write_png
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.metrics import RELMSE_GHARBI, SSIM_WINDOW, psnr, relmse, relmse_map, ssim
from oiio_msspl.model.contract import SCALES


def scores(image: Array, reference: Array) -> dict[str, float]:
    """All measures of :mod:`oiio_msspl.metrics`.

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


def compare_files(images: Sequence[Path], reference: Path) -> list[dict[str, float]]:
    """Score the beauty of each image against that of the reference, over the part of the frame that all files show.

    Args:
        images: EXR files. One that is smaller by x2, x4 or x8 is upsampled bicubically first.
        reference: EXR file of what the images should be.

    Returns:
        :func:`scores` of each image.

    Raises:
        InputError: a file can't be read, an image's size does not fit the reference, the files have no part of the
            frame in common, or that part is too small.
    """
    *renders, last = [open_beauty(path) for path in (*images, reference)]
    *windows, window = common_windows([*renders, last], last)
    if min(window.height, window.width) < SSIM_WINDOW:
        what = "is" if window == last.data_window else "the part that all files show is"
        raise InputError(f"{reference}: {what} {window.size}; SSIM needs at least {SSIM_WINDOW} pixels each way")
    truth = _read(last, window)
    return [scores(_read_at_size_of(truth, each, part), truth) for each, part in zip(renders, windows, strict=True)]


def note_on_windows(images: Sequence[Path], reference: Path | None = None) -> str:
    """A sentence for the user if not all files show the whole frame, so that only a part can be compared.

    Returns:
        An empty text if all that the files show is compared.

    Raises:
        InputError: a file can't be read, or see :func:`common_windows`.
    """
    renders = [open_beauty(path) for path in (*images, *([reference] if reference else []))]
    largest = largest_of(renders, has_reference=reference is not None)
    windows = common_windows(renders, largest)
    if all(window == render.data_window for render, window in zip(renders, windows, strict=True)):
        return ""
    part = next(window for render, window in zip(renders, windows, strict=True) if render is largest)
    return f"The data windows differ; only the part that all pictures show is compared: {part}"


def largest_of(renders: Sequence[MappedRender], *, has_reference: bool) -> MappedRender:
    """The render at whose size all are compared: the last one if that is the reference, otherwise the largest."""
    return renders[-1] if has_reference else max(renders, key=lambda r: r.data_window.width * r.data_window.height)


def common_windows(renders: Sequence[MappedRender], largest: MappedRender) -> list[Window]:
    """The rectangle of each render, in its own pixels, over which all of them are compared.

    Renders of one display window are laid over each other by their places in it. Each other one shows what the data
    window of ``largest`` shows, at its size or smaller by a scale of ``SCALES``.

    Args:
        renders: what is compared.
        largest: the one of these at whose size all are compared.

    Raises:
        InputError: a size does not fit, or renders of one display window have no part in common.
    """
    whole = common = largest.data_window
    same = [each for each in renders if each.display_window == largest.display_window]
    for each in same:
        common = common.intersect(each.data_window)
    scales = [None if each.display_window == largest.display_window else _scale(each, largest) for each in renders]
    if common == whole:
        return [whole if scale is None else each.data_window for each, scale in zip(renders, scales, strict=True)]
    # Smaller renders are cut between whole pixels.
    step = max((scale for scale in scales if scale), default=1)
    left, top = (-(-offset // step) * step for offset in (common.x0 - whole.x0, common.y0 - whole.y0))
    right, bottom = (offset // step * step for offset in (common.x1 - whole.x0, common.y1 - whole.y0))
    if left >= right or top >= bottom:
        names = ", ".join(f"{each.name} ({each.data_window})" for each in same)
        raise InputError(f"these pictures have no part of the frame in common: {names}; compare those of one part")
    part = Window(left, top, right, bottom)
    windows = []
    for each, scale in zip(renders, scales, strict=True):
        home = each.data_window if scale else whole
        windows.append(Window(*(side // (scale or 1) for side in astuple(part))).shift(home.x0, home.y0))
    return windows


def _scale(render: MappedRender, largest: MappedRender) -> int:
    """How much smaller a render is than another one.

    Raises:
        InputError: it is neither of the same size, nor smaller by a scale of ``SCALES``.
    """
    size, wanted = ((window.height, window.width) for window in (render.data_window, largest.data_window))
    for scale in (1, *SCALES):
        # An odd side may have been rounded up or down.
        if all(a in (b // scale, -(-b // scale)) for a, b in zip(size, wanted, strict=True)):
            return scale
    raise InputError(
        f"{render.name} is {render.data_window.size}, but {largest.name} is {largest.data_window.size}; "
        "compare pictures of one size"
    )


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


def write_error_map(path: Path, image: Path, reference: Path, *, overwrite: bool) -> None:
    """Write the :func:`error_map` of an image as a PNG.

    Args:
        path: the PNG to write.
        image, reference: EXR files, as for :func:`compare_files`.
        overwrite: replace an existing file.

    Raises:
        InputError: a file can't be read, the image does not fit the reference, or ``path`` exists.
        MssplError: the PNG can't be written.
    """
    render, last = (open_beauty(each) for each in (image, reference))
    part, window = common_windows([render, last], last)
    truth = _read(last, window)
    write_png(path, error_map(_read_at_size_of(truth, render, part), truth), overwrite=overwrite)


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


def open_beauty(path: Path) -> MappedRender:
    """Open an EXR and find its beauty alone.

    Raises:
        InputError: it can't be read, or has no beauty.
    """
    return map_render(open_exr(path), features=())


def _read(render: MappedRender, window: Window) -> Array:
    """The beauty over a window, without NaN and infinities: (height, width, 3)."""
    return repair(render.read(window, [RGB])[RGB])[0]


def _read_at_size_of(truth: Array, render: MappedRender, window: Window) -> Array:
    """The beauty over a window, upsampled to the size of the reference if it is smaller."""
    image = _read(render, window)
    return image if image.shape == truth.shape else upsample_bicubic(image, truth.shape[1], truth.shape[0])
