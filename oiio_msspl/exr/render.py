# SPDX-License-Identifier: Apache-2.0
"""The one in-memory type for a render: named float32 layers with their windows and metadata."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from oiio_msspl.arrays import Array


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

    def intersect(self, other: Window) -> Window:
        """The common rectangle; its width or height is 0 where there is none."""
        x0, y0 = max(self.x0, other.x0), max(self.y0, other.y0)
        return Window(x0, y0, max(x0, min(self.x1, other.x1)), max(y0, min(self.y1, other.y1)))

    def shift(self, dx: int, dy: int) -> Window:
        return Window(self.x0 + dx, self.y0 + dy, self.x1 + dx, self.y1 + dy)

    def slices(self, inside: Window) -> tuple[slice, slice]:
        """Row and column slices of this rectangle in an array that covers ``inside``."""
        return (
            slice(self.y0 - inside.y0, self.y1 - inside.y0),
            slice(self.x0 - inside.x0, self.x1 - inside.x0),
        )

    def __str__(self) -> str:
        return f"{self.size}{self.x0:+d}{self.y0:+d}"


@dataclass
class Render:
    """A render, or a rectangle of one.

    ``layers`` maps a feature of :mod:`oiio_msspl.aovs.features` (``rgb`` always, the others when the render has them) or
    ``alpha`` to float32 (height, width, channels) over ``data_window``, in the units that the schema states.
    """

    layers: dict[str, Array]
    data_window: Window
    display_window: Window
    pixel_aspect: float = 1.0
    metadata: dict[str, Any] = field(default_factory=dict)
    name: str = "render"
    """What messages call it: a file's path."""

    @classmethod
    def from_arrays(cls, name: str = "render", **layers: Array) -> Render:
        """A render without overscan from arrays (height, width, channels); ``rgb`` is needed.

        Raises:
            ValueError: shapes differ, or ``rgb`` is absent.
        """
        if "rgb" not in layers:
            raise ValueError(f"{name}: no 'rgb' among the layers {sorted(layers)}")
        height, width = layers["rgb"].shape[:2]
        for key, value in layers.items():
            if value.ndim != 3 or value.shape[:2] != (height, width):
                raise ValueError(
                    f"{name}: layer {key!r} has shape {value.shape}, expected ({height}, {width}, channels)"
                )
        window = Window(0, 0, width, height)
        return cls({k: np.asarray(v, dtype=np.float32) for k, v in layers.items()}, window, window, name=name)

    def read(self, window: Window, features: Iterable[str] | None = None) -> dict[str, Array]:
        """The layers (those in ``features``, or all) over a rectangle inside the data window."""
        rows, columns = window.slices(self.data_window)
        names = self.layers if features is None else [f for f in features if f in self.layers]
        return {name: self.layers[name][rows, columns] for name in names}


class ReadableRender(Protocol):
    """A render that can be read by rectangles: a file with its layers mapped, or one in memory."""

    @property
    def name(self) -> str: ...
    @property
    def display_window(self) -> Window: ...
    @property
    def data_window(self) -> Window: ...
    @property
    def pixel_aspect(self) -> float: ...
    def read(self, window: Window, features: Iterable[str] | None = None) -> dict[str, Array]: ...
