# SPDX-License-Identifier: Apache-2.0
"""Write the preview of the result, an 8-bit PNG."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.exr.reader import reason_of
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.strips import ROWS_PER_STRIP
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import REC709, ColourSpace, conversion, srgb
from oiio_msspl.image.parallel import one_ahead

Pixels = NDArray[np.uint8]

#: Pinned: OpenColorIO's "-latest" configurations change their default view between releases.
OCIO_CONFIG = "ocio://cg-config-v2.2.0_aces-v1.3_ocio-v2.4"
OCIO_DISPLAY, OCIO_INPUT = "sRGB - Display", "lin_rec709"
#: The "Software" entry of previews. It tells them from unrelated pictures of the same name.
SOFTWARE = "oiio_msspl"
#: The last bytes of every PNG: its chunk IEND.
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"


def is_our_preview(path: Path) -> bool:
    """Return whether the file is a preview that this module wrote."""
    file = oiio.ImageInput.open(str(path))
    if file is None:
        oiio.geterror()  # an error that nobody reads would be printed when the process ends
        return False
    ours = file.format_name() == "png" and file.spec().get_string_attribute("Software") == SOFTWARE
    file.close()
    return bool(ours)


def old_preview(exr: Path) -> Path | None:
    """Return the preview that this module wrote beside an existing EXR, or None."""
    png = exr.with_suffix(".png")
    return png if exr.exists() and png.is_file() and not png.is_symlink() and is_our_preview(png) else None


def check_view(view: str) -> None:
    """Raise InputError if the OpenColorIO configuration has no such view."""
    views = oiio.ColorConfig(OCIO_CONFIG).getViewNames(OCIO_DISPLAY)
    if view not in views:
        raise InputError(f"--ocio-view {view!r}: {OCIO_CONFIG} has {', '.join(views)}")


def write_preview(
    path: Path,
    rgb: Array,
    data_window: Window,
    display_window: Window,
    view: str | None = None,
    space: ColourSpace = REC709,
    *,
    overwrite: bool = False,
) -> None:
    """Write an sRGB PNG of the frame, atomically. Pixels outside the data window are black.

    Args:
        rgb: scene linear, (height, width, 3), over ``data_window``.
        data_window, display_window: the pixels that ``rgb`` covers, and the frame, which the PNG shows.
        view: None for the paper's sRGB curve; otherwise a view of OpenColorIO's built-in CG configuration, e.g.
            ``Un-tone-mapped`` or ``ACES 1.0 - SDR Video``.
        space: linear RGB space of ``rgb``; converted to Rec. 709 for the picture.

    Raises:
        InputError: the view is unknown, or ``path`` exists.
        MssplError: the file can't be written.
    """
    if view is not None:
        check_view(view)
    to_rec709 = None if space == REC709 else conversion(space, REC709).T.astype(np.float32)

    def rows(strip: Window) -> Pixels:
        linear = np.zeros((strip.height, strip.width, 3), dtype=rgb.dtype)
        rendered = data_window.intersect(strip)
        if rendered.width and rendered.height:
            linear[rendered.slices(strip)] = rgb[rendered.slices(data_window)]
        if to_rec709 is not None:
            linear = linear @ to_rec709
        return _srgb_pixels(linear) if view is None else _to_8_bits(_through_ocio(linear, view))

    with replacing(path, overwrite=overwrite) as temporary:
        writer = oiio.ImageOutput.create(str(temporary))
        if writer is None:
            raise OSError(reason_of(oiio))
        spec = oiio.ImageSpec(display_window.width, display_window.height, 3, "uint8")
        spec.attribute("oiio:ColorSpace", "sRGB")
        spec.attribute("Software", SOFTWARE)
        spec.attribute("png:compressionLevel", 1)
        # Filter "Sub": every byte minus that of the pixel to the left. Trying all filters would take longer than zlib.
        spec.attribute("png:filter", 16)
        # Search for runs of equal bytes only: filtered rows of a render repeat little else.
        spec.attribute("compression", "rle")
        ok = writer.open(str(temporary), spec)
        strips = display_window.bands(ROWS_PER_STRIP)
        # The next rows are converted while OpenImageIO compresses these: a large frame needs no second copy.
        for strip, pixels in one_ahead((strip, np.ascontiguousarray(rows(strip))) for strip in strips):
            ok = ok and writer.write_scanlines(strip.y0 - display_window.y0, strip.y1 - display_window.y0, 0, pixels)
        ok = writer.close() and ok
        if not ok:
            raise OSError(reason_of(writer))
        # OpenImageIO does not tell if a full disk cut off the last bytes.
        with open(temporary, "rb") as file:
            file.seek(-min(len(PNG_END), temporary.stat().st_size), os.SEEK_END)
            if file.read() != PNG_END:
                raise OSError("its end is missing; is the disk full?")


def _to_8_bits(display: Array) -> Pixels:
    return (np.clip(display, 0, 1) * 255 + 0.5).astype(np.uint8)


def _srgb_pixels(linear: Array) -> Pixels:
    """Apply the sRGB curve by a table of all half floats, six times as fast; 1 % of the values are rounded apart."""
    with np.errstate(over="ignore"):  # values too bright for half become infinite, and white
        half = linear.astype(np.float16, copy=False)
    return _srgb_table().take(half.view(np.uint16))


@lru_cache(maxsize=1)
def _srgb_table() -> Pixels:
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)
    return _to_8_bits(srgb(np.nan_to_num(halves, posinf=1, neginf=0)))


def _through_ocio(linear: Array, view: str) -> Array:
    """Convert scene-linear values (height, width, 3) to display values through an OpenColorIO view."""
    image = oiio.ImageBuf(np.ascontiguousarray(linear))
    result = oiio.ImageBufAlgo.ociodisplay(
        image, OCIO_DISPLAY, view, fromspace=OCIO_INPUT, unpremult=False, colorconfig=OCIO_CONFIG
    )
    if result.has_error:
        raise MssplError(f"OpenColorIO: {result.geterror()}")
    return np.asarray(result.get_pixels(oiio.FLOAT), dtype=np.float32)
