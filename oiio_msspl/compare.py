# SPDX-License-Identifier: Apache-2.0
"""Comparing EXR files with a reference: scores, and a picture of the error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.arrays import Array, repair
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_separate, check_target
from oiio_msspl.exr.preview import write_png
from oiio_msspl.exr.reader import open_exr
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
    """Score the beauty of each image against that of the reference.

    Args:
        images: EXR files. One that is smaller by x2, x4 or x8 is upsampled bicubically first.
        reference: EXR file of what the images should be.

    Returns:
        :func:`scores` of each image.

    Raises:
        InputError: a file can't be read, an image's size does not fit the reference, or the reference is too small.
    """
    truth = _read_beauty(reference)
    height, width = truth.shape[:2]
    if min(height, width) < SSIM_WINDOW:
        raise InputError(f"{reference}: is {width}x{height}; SSIM needs at least {SSIM_WINDOW} pixels each way")
    return [scores(_read_at_size_of(truth, path, reference), truth) for path in images]


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
        InputError: a file can't be read, the image's size does not fit the reference, or ``path`` exists.
        MssplError: the PNG can't be written.
    """
    truth = _read_beauty(reference)
    write_png(path, error_map(_read_at_size_of(truth, image, reference), truth), overwrite=overwrite)


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


def _read_beauty(path: Path) -> Array:
    """The beauty of an EXR over its data window, without NaN and infinities: (height, width, 3)."""
    render = map_render(open_exr(path), features=())
    return repair(render.read(render.data_window, [RGB])[RGB])[0]


def _read_at_size_of(truth: Array, path: Path, reference: Path) -> Array:
    """The beauty of an EXR, upsampled to the size of the reference if it is smaller by a scale of ``SCALES``."""
    image = _read_beauty(path)
    check_size(path, image.shape[:2], reference, truth.shape[:2])
    return image if image.shape == truth.shape else upsample_bicubic(image, truth.shape[1], truth.shape[0])


def check_size(path: Path, size: Sequence[int], reference: Path, wanted: Sequence[int]) -> None:
    """Check that an image has the size of the reference, or is smaller by a scale of ``SCALES``.

    Args:
        path, reference: their files.
        size, wanted: their height and width.

    Raises:
        InputError: the sizes do not fit.
    """
    # An odd side may have been rounded up or down.
    if tuple(size) != tuple(wanted) and not any(
        all(a in (b // scale, -(-b // scale)) for a, b in zip(size, wanted, strict=True)) for scale in SCALES
    ):
        raise InputError(
            f"{path} is {size[1]}x{size[0]}, but {reference} is {wanted[1]}x{wanted[0]}; compare pictures of one size"
        )
