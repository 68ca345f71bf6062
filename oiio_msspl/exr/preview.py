# SPDX-License-Identifier: Apache-2.0
"""A picture of the result for a quick look: 8-bit PNG."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.arrays import Array
from oiio_msspl.colour import srgb
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.exr.reader import ROWS_PER_READ
from oiio_msspl.exr.render import Window

#: Pinned: OpenColorIO's "-latest" configurations change their default view between releases.
OCIO_CONFIG = "ocio://cg-config-v2.2.0_aces-v1.3_ocio-v2.4"
OCIO_DISPLAY = "sRGB - Display"
OCIO_INPUT = "lin_rec709"


#: What tells our pictures from others' of the same name.
SOFTWARE = "oiio_msspl"


def is_our_preview(path: Path) -> bool:
    """Is this a picture that was written here?"""
    file = oiio.ImageInput.open(str(path))
    if file is None:
        oiio.geterror()  # or OpenImageIO says it at its end
        return False
    ours: bool = file.spec().get_string_attribute("Software") == SOFTWARE
    file.close()
    return ours


def check_view(view: str) -> None:
    """Raise InputError if OpenColorIO's configuration has no such view."""
    views = oiio.ColorConfig(OCIO_CONFIG).getViewNames(OCIO_DISPLAY)
    if view not in views:
        raise InputError(f"--view {view!r}: {OCIO_CONFIG} has {', '.join(views)}")


def write_preview(
    path: Path,
    rgb: Array,
    data_window: Window,
    display_window: Window,
    view: str | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write scene-linear ``rgb`` (height, width, 3) over ``data_window`` as it lies in the display window.

    Args:
        view: None for the paper's sRGB curve; otherwise a view of OpenColorIO's built-in CG configuration, e.g.
            ``Un-tone-mapped`` or ``ACES 1.0 - SDR Video``.

    Raises:
        InputError: no such view.
        MssplError: it can't be written.
    """
    if view is not None:
        check_view(view)

    def rows(start: int, stop: int) -> Array:
        shown = display_window
        band = Window(shown.x0, shown.y0 + start, shown.x1, shown.y0 + stop)
        linear = np.zeros((band.height, band.width, 3), dtype=np.float32)
        seen = data_window.intersect(band)
        if seen.width and seen.height:
            linear[seen.slices(band)] = rgb[seen.slices(data_window)]
        return srgb(linear) if view is None else _through_ocio(linear, view)

    _write_png(path, display_window.width, display_window.height, rows, overwrite)


def write_png(path: Path, display: Array, *, overwrite: bool = False) -> None:
    """Write display values in [0, 1], (height, width, 3), as an 8-bit PNG, atomically."""
    _write_png(path, display.shape[1], display.shape[0], lambda start, stop: display[start:stop], overwrite)


def _write_png(path: Path, width: int, height: int, rows: Callable[[int, int], Array], overwrite: bool) -> None:
    """``rows(start, stop)`` gives display values; asked for in bands, so that a large frame needs no second copy."""
    with replacing(path, overwrite=overwrite) as temporary:
        writer = oiio.ImageOutput.create(str(temporary))
        if writer is None:
            raise MssplError(f"{path}: OpenImageIO can't write it ({oiio.geterror()})")
        spec = oiio.ImageSpec(width, height, 3, "uint8")
        spec.attribute("oiio:ColorSpace", "sRGB")
        spec.attribute("Software", SOFTWARE)
        ok = writer.open(str(temporary), spec)
        for start in range(0, height, ROWS_PER_READ):
            stop = min(start + ROWS_PER_READ, height)
            pixels = (np.clip(rows(start, stop), 0, 1) * 255 + 0.5).astype(np.uint8)
            ok = ok and writer.write_scanlines(start, stop, 0, np.ascontiguousarray(pixels))
        ok = writer.close() and ok
        if not ok:
            raise MssplError(f"{path}: can't be written ({writer.geterror() or oiio.geterror()})")


def _through_ocio(linear: Array, view: str) -> Array:
    image = oiio.ImageBuf(np.ascontiguousarray(linear))
    result = oiio.ImageBufAlgo.ociodisplay(
        image, OCIO_DISPLAY, view, fromspace=OCIO_INPUT, unpremult=False, colorconfig=OCIO_CONFIG
    )
    if result.has_error:
        raise MssplError(f"OpenColorIO: {result.geterror()}")
    return np.asarray(result.get_pixels(oiio.FLOAT), dtype=np.float32)
