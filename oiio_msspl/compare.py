# SPDX-License-Identifier: Apache-2.0
"""Comparing files with a reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.arrays import Array, repair
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_target
from oiio_msspl.exr.preview import write_png
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.metrics import RELMSE_GHARBI, SSIM_WINDOW, psnr, relmse, relmse_map, ssim
from oiio_msspl.model.contract import SCALES


def scores(image: Array, reference: Array) -> dict[str, float]:
    """``psnr`` (dB), ``relmse`` (0.5, 0.01), ``relmse_gharbi`` (1, 1e-4) and ``ssim`` of two (h, w, 3) pictures."""
    return {
        "psnr": psnr(image, reference),
        "relmse": relmse(image, reference),
        "relmse_gharbi": relmse(image, reference, RELMSE_GHARBI),
        "ssim": ssim(image, reference),
    }


def compare_files(images: Sequence[Path], reference: Path) -> list[dict[str, float]]:
    """Scores of each image. One that is smaller by x2, x4 or x8 is upsampled bicubically first.

    Raises:
        InputError: a file can't be read, or its size does not fit the reference.
    """
    truth_file = map_render(open_exr(reference))
    truth = _beauty(truth_file)
    if min(truth.shape[:2]) < SSIM_WINDOW:
        size = truth_file.data_window.size
        raise InputError(f"{reference}: is {size}; SSIM needs at least {SSIM_WINDOW} pixels each way")
    return [scores(_fitted(map_render(open_exr(path)), truth, reference), truth) for path in images]


def check_error_map(path: Path, *, overwrite: bool) -> None:
    """Raise InputError if no error map could be written here."""
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: the error map is a PNG; name it .png")
    check_target(path, overwrite=overwrite)


def write_error_map(path: Path, image: Path, reference: Path, *, overwrite: bool) -> None:
    """See :func:`error_map`."""
    truth = _beauty(map_render(open_exr(reference)))
    write_png(path, error_map(_fitted(map_render(open_exr(image)), truth, reference), truth), overwrite=overwrite)


def error_map(image: Array, truth: Array) -> Array:
    """log10 RelMSE (0.5, 0.01) a pixel, from 1e-5 (black) to 1 (white) on OpenImageIO's "inferno" colours."""
    error = relmse_map(image, truth).mean(axis=-1)
    grey = ((np.log10(np.maximum(error, 1e-5)) + 5) / 5).clip(0, 1).astype(np.float32)
    mapped = oiio.ImageBufAlgo.color_map(oiio.ImageBuf(np.ascontiguousarray(grey[..., None])), 0, "inferno")
    if mapped.has_error:
        raise MssplError(f"the error map's colours: {mapped.geterror()}")
    return np.asarray(mapped.get_pixels(oiio.FLOAT), dtype=np.float32)[..., :3]


def upsample_bicubic(image: Array, width: int, height: int) -> Array:
    """Bicubic (B-spline free, OpenImageIO's "cubic") resampling; negative lobes are cut at 0."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(image))
    result = oiio.ImageBufAlgo.resize(buffer, filtername="cubic", roi=oiio.ROI(0, width, 0, height))
    return np.maximum(np.asarray(result.get_pixels(oiio.FLOAT), dtype=np.float32), 0)


def _beauty(file: MappedRender) -> Array:
    return repair(file.read(file.data_window, [RGB])[RGB])[0]


def _fitted(file: MappedRender, truth: Array, reference: Path) -> Array:
    image = _beauty(file)
    height, width = truth.shape[:2]
    if image.shape == truth.shape:
        return image
    if any(
        image.shape[0] in (height // s, -(-height // s)) and image.shape[1] in (width // s, -(-width // s))
        for s in SCALES
    ):
        return upsample_bicubic(image, width, height)
    raise InputError(
        f"{file.name} is {image.shape[1]}x{image.shape[0]}, but {reference} is {width}x{height}; "
        "compare pictures of one size"
    )
