# SPDX-License-Identifier: Apache-2.0
"""Reading EXR files of any kind through OpenImageIO: headers first, pixels by rectangle when they are needed.

Nothing here knows what a layer means (:mod:`oiio_msspl.aovs` does), and no file is ever read whole: an 8K frame with
sixty float channels is larger than most machines' memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError
from oiio_msspl.exr.render import Window

#: Rows decoded at once: a few chunks of any compression, so that wide files with many channels stay small in memory.
ROWS_PER_READ = 64


@dataclass(frozen=True)
class Channel:
    """One channel of one part of one file."""

    path: Path
    part: int
    index: int
    name: str
    """As stored, e.g. ``ViewLayer.Combined.R``."""
    type: str
    """``half``, ``float`` or ``uint``."""


@dataclass(frozen=True)
class Part:
    """One part (OpenImageIO: subimage) of a file."""

    index: int
    name: str
    view: str
    channels: tuple[Channel, ...]
    data_window: Window
    compression: str
    tile: tuple[int, int]
    """Tile width and height, (0, 0) for scan lines."""
    deep: bool
    spec: Any = field(repr=False, compare=False)
    """OpenImageIO's own description, from which a copy of the part can be written."""


@dataclass(frozen=True)
class ExrFile:
    """An opened EXR file: headers are read, pixels come through :meth:`read`."""

    path: Path
    parts: tuple[Part, ...]
    display_window: Window
    pixel_aspect: float
    metadata: dict[str, Any]
    """Attributes of all parts by their OpenImageIO names; the first part that has one wins."""
    siblings: dict[Path, ExrFile] = field(default_factory=dict, repr=False, compare=False)
    """Other files that hold layers of the same frame (one file an AOV)."""

    @cached_property
    def _input(self) -> Any:
        handle = oiio.ImageInput.open(str(self.path))
        if handle is None:
            raise InputError(f"{self.path}: can't be opened ({_last_error()})")
        return handle

    def read(self, channels: Sequence[Channel], window: Window) -> Array:
        """Channels over a rectangle, as float32 (height, width, len(channels)).

        Pixels outside a part's data window are 0, as OpenEXR defines them. All channels of a part are decoded in one
        pass, however many layers they belong to.

        Raises:
            InputError: pixels can't be decoded (truncated or corrupt file).
        """
        result = np.zeros((window.height, window.width, len(channels)), dtype=np.float32)
        groups: dict[tuple[Path, int], list[int]] = {}
        for position, channel in enumerate(channels):
            groups.setdefault((channel.path, channel.part), []).append(position)
        for (path, part), positions in groups.items():
            owner = self if path == self.path else self.siblings[path]
            owner._read_part(owner.parts[part], [channels[i].index for i in positions], window, result, positions)
        return result

    def _read_part(self, part: Part, indices: list[int], window: Window, result: Array, positions: list[int]) -> None:
        area = window.intersect(part.data_window)
        if area.width == 0 or area.height == 0:
            return
        first, last = min(indices), max(indices) + 1
        picks = [i - first for i in indices]
        for y0, y1, rows in self._bands(part, area, first, last, "float"):
            band = Window(part.data_window.x0, y0, part.data_window.x1, y1)
            part_rows, columns = Window(area.x0, max(y0, area.y0), area.x1, min(y1, area.y1)).slices(band)
            target = Window(area.x0, max(y0, area.y0), area.x1, min(y1, area.y1)).slices(window)
            result[(*target, positions)] = rows[part_rows, columns][..., picks]

    def native_bands(self, part: Part, first: int, last: int) -> Any:
        """All rows of the channels ``first`` to ``last`` (exclusive; one pixel type), in that type, a band at a time.

        Yields (first row, last row exclusive, array (rows, width, channels)): for copying bit for bit.
        """
        return self._bands(part, part.data_window, first, last, part.channels[first].type)

    def _bands(self, part: Part, area: Window, first: int, last: int, kind: str) -> Any:
        window = part.data_window
        tile_height = part.tile[1]
        # Bands start on a multiple of their height from the part's first row: whole chunks, and OpenImageIO wants
        # whole tiles.
        step = tile_height * max(1, ROWS_PER_READ // tile_height) if tile_height else ROWS_PER_READ
        start = window.y0 + (area.y0 - window.y0) // step * step
        for y0 in range(start, area.y1, step):
            y1 = min(y0 + step, window.y1)
            if tile_height:
                rows = self._input.read_tiles(part.index, 0, window.x0, window.x1, y0, y1, 0, 1, first, last, kind)
            else:
                rows = self._input.read_scanlines(part.index, 0, y0, y1, 0, first, last, kind)
            if rows is None:
                raise unreadable(self.path, part, self._input.geterror(), f", rows {y0} to {y1 - 1}")
            yield y0, y1, rows


def unreadable(path: Path, part: Part, reason: str, where: str = "") -> InputError:
    """The error for pixels that can't be decoded."""
    return InputError(
        f"{path}: part {part.index} ({part.name or 'unnamed'}){where} can't be read "
        f"({' '.join(reason.split()) or 'no reason given'}); the file is damaged or still being written"
    )


def open_exr(path: str | Path) -> ExrFile:
    """Read the headers of an EXR file.

    Raises:
        InputError: there is no such file, it is no EXR, or its headers are corrupt.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    handle = oiio.ImageInput.open(str(path))
    if handle is None:
        reason = _last_error()
        hint = "; if its channels are subsampled (luminance and chroma), convert it to RGB" if "twice" in reason else ""
        raise InputError(f"{path}: can't be opened as an EXR ({reason}){hint}")
    if handle.format_name() != "openexr":
        raise InputError(
            f"{path}: is a {handle.format_name()} file; give an EXR, other formats lose what the network needs"
        )
    parts: list[Part] = []
    metadata: dict[str, Any] = {}
    while handle.seek_subimage(len(parts), 0):
        spec = handle.spec()
        index = len(parts)
        types = [str(t) for t in spec.channelformats] or [str(spec.format)] * spec.nchannels
        parts.append(
            Part(
                index=index,
                name=str(spec.getattribute("oiio:subimagename") or ""),
                view=str(spec.getattribute("view") or ""),
                channels=tuple(
                    Channel(path, index, i, name, kind)
                    for i, (name, kind) in enumerate(zip(spec.channelnames, types, strict=True))
                ),
                data_window=Window(spec.x, spec.y, spec.x + spec.width, spec.y + spec.height),
                compression=str(spec.getattribute("compression") or "none").split(":")[0],
                tile=(spec.tile_width, spec.tile_height),
                deep=bool(spec.deep),
                spec=oiio.ImageSpec(spec),
            )
        )
        for attribute in spec.extra_attribs:
            metadata.setdefault(attribute.name, attribute.value)
    if not parts:
        raise InputError(f"{path}: holds no image ({handle.geterror() or 'empty'})")
    first = parts[0].spec
    return ExrFile(
        path=path,
        parts=tuple(parts),
        display_window=Window(
            first.full_x, first.full_y, first.full_x + first.full_width, first.full_y + first.full_height
        ),
        pixel_aspect=float(metadata.get("PixelAspectRatio", 1.0)),
        metadata=metadata,
    )


def _last_error() -> str:
    """OpenImageIO's last error on one line: its messages repeat the path and break lines."""
    try:
        return " ".join(str(oiio.geterror()).split()) or "no reason given"
    except UnicodeDecodeError:  # the message quotes the file, and OpenImageIO's binding takes it for UTF-8
        return "its header is damaged"
