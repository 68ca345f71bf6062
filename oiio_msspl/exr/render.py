# SPDX-License-Identifier: Apache-2.0
"""Define windows (rectangles of pixels) and renders in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from oiio_msspl.image.arrays import Array, unload

#: Features of a render in memory and their numbers of channels; a variance may also have three.
#: :mod:`oiio_msspl.aovs.features` states their units.
CHANNELS = {"rgb": 3, "albedo": 3, "normal": 3, "diffuse": 3, "specular": 3, "variance": 1, "alpha": 1}


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels: x0 <= x < x1, y0 <= y < y1, y downwards. Origins may be negative."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        return self.y1 - self.y0

    @property
    def size(self) -> str:
        """``1920x1080``, for messages."""
        return f"{self.width}x{self.height}"

    def intersect(self, window: Window) -> Window:
        """Return the common rectangle; its width or height is 0 if the two do not overlap."""
        x0, y0 = max(self.x0, window.x0), max(self.y0, window.y0)
        return Window(x0, y0, max(x0, min(self.x1, window.x1)), max(y0, min(self.y1, window.y1)))

    def union(self, window: Window) -> Window:
        """Return the smallest rectangle around both."""
        x0, y0 = min(self.x0, window.x0), min(self.y0, window.y0)
        return Window(x0, y0, max(self.x1, window.x1), max(self.y1, window.y1))

    def shift(self, dx: int, dy: int) -> Window:
        """Return the rectangle moved by ``dx`` pixels to the right and ``dy`` pixels down."""
        return Window(self.x0 + dx, self.y0 + dy, self.x1 + dx, self.y1 + dy)

    def bands(self, rows: int) -> Iterator[Window]:
        """Cut the rectangle into bands of at most ``rows`` rows, from top to bottom."""
        for y0 in range(self.y0, self.y1, rows):
            yield Window(self.x0, y0, self.x1, min(y0 + rows, self.y1))

    def slices(self, inside: Window) -> tuple[slice, slice]:
        """Return the row and column slices of this rectangle in an array that covers ``inside``."""
        x, y = inside.x0, inside.y0
        return slice(self.y0 - y, self.y1 - y), slice(self.x0 - x, self.x1 - x)

    def __str__(self) -> str:
        return f"{self.size}{self.x0:+d}{self.y0:+d}"


@dataclass
class Render:
    """A render in memory, or a rectangle of one.

    ``layers`` maps the name of a feature, one of ``CHANNELS``, to float32 (height, width, channels) over
    ``data_window``. ``rgb`` is always present.
    """

    layers: dict[str, Array]
    data_window: Window
    display_window: Window
    pixel_aspect: float = 1.0
    metadata: dict[str, Any] = field(default_factory=dict)
    name: str = "render"
    """For messages, such as the path of the file."""

    @classmethod
    def from_arrays(cls, name: str = "render", **layers: Array) -> Render:
        """Make a render without overscan from arrays: floats (height, width, channels), of those in ``CHANNELS``.

        Raises:
            ValueError: ``rgb`` is missing, a name is unknown, sizes differ or are 0, a layer has the wrong number of
                channels, or values are not floats.
        """
        if "rgb" not in layers:
            raise ValueError(f"{name}: no 'rgb' among the layers {sorted(layers)}")
        arrays = {key: np.asarray(value) for key, value in layers.items()}
        # An rgb without three dimensions is refused below, as any layer of a wrong shape is.
        height, width = arrays["rgb"].shape[:2] if arrays["rgb"].ndim == 3 else (0, 0)
        for key, value in arrays.items():
            if key not in CHANNELS:
                raise ValueError(f"{name}: layer {key!r} is none of {', '.join(CHANNELS)}")
            count = 3 if key == "variance" and value.shape[2:] == (3,) else CHANNELS[key]
            if value.shape != (height, width, count) or not value.size:
                size = f"{height}, {width}" if height else "height, width"
                raise ValueError(f"{name}: layer {key!r} has shape {value.shape}, expected ({size}, {CHANNELS[key]})")
            if not np.issubdtype(value.dtype, np.floating):
                raise ValueError(f"{name}: layer {key!r} holds {value.dtype}, expected floats")
        window = Window(0, 0, width, height)
        return cls({k: np.asarray(v, dtype=np.float32) for k, v in arrays.items()}, window, window, name=name)

    def read(self, window: Window, features: Iterable[str] | None = None) -> dict[str, Array]:
        """Return features over a rectangle, float32 (height, width, channels) each; 0 outside of the data window.

        Values are as stored: NaN and infinities may be among them. They are views if the arrays cover the rectangle.

        Args:
            features: names of features, all if None. Those that the render lacks are left out.
        """
        inside = window.intersect(self.data_window)
        names = self.layers if features is None else [f for f in features if f in self.layers]
        layers = {name: self.layers[name][inside.slices(self.data_window)] for name in names}
        if inside == window:
            return layers
        rows, columns = inside.slices(window)
        margins = [(rows.start, window.height - rows.stop), (columns.start, window.width - columns.stop), (0, 0)]
        return {name: np.pad(values, margins) for name, values in layers.items()}

    def unload(self) -> None:
        """Give the memory of pixels that wait in temporary files back to the system."""
        for image in self.layers.values():
            unload(image)

    def cache_strips(self, max_bytes: int) -> AbstractContextManager[None]:
        """Do nothing, because the pixels are in memory already."""
        return nullcontext()
