# SPDX-License-Identifier: Apache-2.0
"""The alignment of a pair: how its pixels lie over each other.

Display windows show the same picture. Data windows say which part of it was rendered, or which part is not empty.
"""

from __future__ import annotations

from dataclasses import dataclass

from oiio_msspl.aovs.mapped_render import ReadableRender
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window
from oiio_msspl.model.contract import ONE_SIZE, SCALES


@dataclass(frozen=True)
class Alignment:
    """The position of a pair's pixels over each other. Windows count from the top left of the display window."""

    scale: int
    grid: Window
    """The LRHS pixels that cover the HRLS's data window: the area that is fused."""
    lr_data_window: Window
    """The LRHS pixels that are known: its data window, or the whole frame, which is black and transparent around it."""
    hr_data_window: Window
    """The HRLS's data window: the area that is written."""
    stretch: tuple[float, float] = (1.0, 1.0)
    """Size of a grid pixel in LRHS pixels, x and y: 1 unless an odd size was rounded."""


def align(lr: ReadableRender, hr: ReadableRender) -> Alignment:
    """Find how the pixels of a pair lie over each other; of one render, which is given as both, or of two of one size.

    An HRLS of odd size (1921 x 1081) may come with an LRHS that is rounded up or down (961 x 541 or 960 x 540), whose
    pixels are not exactly s HRLS pixels wide: ``stretch`` is the ratio. Pixel aspects may differ by it.

    Programs that crop a data window to what is not empty crop two noisy renders differently. So an LRHS that does not
    cover the HRLS's data window is black and transparent in the rest of the frame, as OpenEXR defines it.

    Raises:
        InputError: the inputs are swapped, or their pixel aspects, framing or sizes do not fit.
    """
    low, high = lr.display_window, hr.display_window
    scale = _scale(low, high)
    if scale is None:
        raise _wrong_ratio(lr, hr)
    if abs(lr.pixel_aspect - hr.pixel_aspect) > 1e-3 and abs(_shape(lr) / _shape(hr) - 1) > 1e-3:
        raise InputError(
            f"{lr.name} has pixel aspect {lr.pixel_aspect:g}, {hr.name} has {hr.pixel_aspect:g}; "
            "render both with the same"
        )
    lr_data = lr.data_window.shift(-low.x0, -low.y0)
    hr_data = hr.data_window.shift(-high.x0, -high.y0)
    grid = Window(hr_data.x0 // scale, hr_data.y0 // scale, -(-hr_data.x1 // scale), -(-hr_data.y1 // scale))
    if _missing(grid, lr_data) > 1:  # odd sizes and crop regions may be rounded by one pixel
        lr_data = lr_data.union(low.shift(-low.x0, -low.y0))
    if _missing(grid, lr_data) > 1:
        raise InputError(
            f"framing differs: {hr.name} covers {hr_data} of its frame, which needs {grid} of the low-resolution "
            f"frame, but {lr.name} covers only {lr_data}; render both with the same crop region and overscan"
        )
    stretch = (low.width * scale / high.width, low.height * scale / high.height)
    return Alignment(scale, grid, lr_data, hr_data, stretch)


def _missing(needed: Window, window: Window) -> int:
    """Return by how many pixels ``needed`` exceeds a window."""
    return max(window.x0 - needed.x0, window.y0 - needed.y0, needed.x1 - window.x1, needed.y1 - window.y1)


def _shape(render: ReadableRender) -> float:
    """Return width by height of the frame as it is displayed."""
    return render.display_window.width * render.pixel_aspect / render.display_window.height


def _scale(low: Window, high: Window) -> int | None:
    sides = (low.width, high.width), (low.height, high.height)
    fitting = (s for s in (ONE_SIZE, *SCALES) if all(small in (large // s, -(-large // s)) for small, large in sides))
    return next(fitting, None)


def _wrong_ratio(lr: ReadableRender, hr: ReadableRender) -> InputError:
    low, high = lr.display_window, hr.display_window
    if _scale(high, low) is not None:
        return InputError(
            f"the inputs look swapped: {lr.name} is {low.size} and {hr.name} is {high.size}; "
            "give the low-resolution render first"
        )
    x, y = high.width / low.width, high.height / low.height
    wanted = ", ".join(f"{-(-high.width // s)}x{-(-high.height // s)} (x{s})" for s in SCALES)
    if abs(x - y) > 0.02 * max(x, y):
        what = f"framing differs: the ratio is {x:.3g} in width and {y:.3g} in height"
    else:
        what = f"a ratio of {x:.3g} is not supported"
    return InputError(
        f"{what} ({lr.name} is {low.size}, {hr.name} is {high.size}); render the LRHS at one of {wanted}, "
        "or at the size of the HRLS with a noise seed of its own"
    )
