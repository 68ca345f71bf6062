# SPDX-License-Identifier: Apache-2.0
"""Read EXR files through OpenImageIO: headers when a file is opened, pixels by rectangle when they are needed.

No file is read whole: an 8K frame with sixty float channels is larger than the memory of most machines.
:mod:`oiio_msspl.aovs` decides what a layer means.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import check_encodable
from oiio_msspl.exr.render import Window
from oiio_msspl.exr.strips import LARGEST_STRIP, ROWS_PER_STRIP, StripCache, StripKey, strip_rows
from oiio_msspl.image.arrays import Array, blank, unload

# OpenImageIO's own limits protect programs that read whole files: 1024 channels, and an image as large as the memory.
# Files with thousands of light groups are larger. This module reads by rectangle, so the image needs no limit.
oiio.attribute("limits:channels", 1 << 16)
oiio.attribute("limits:imagesize_MB", 0)

#: Scan lines that OpenEXR compresses together; one with the compressions that are not here.
ROWS_PER_CHUNK = {
    **dict.fromkeys(("zip", "pxr24"), 16),
    **dict.fromkeys(("piz", "b44", "b44a", "dwaa", "htj2k32"), 32),
    **dict.fromkeys(("dwab", "htj2k256"), 256),
}

#: NumPy's type of each pixel type.
DTYPES: dict[str, Any] = {"half": np.float16, "float": np.float32, "uint": np.uint32}

#: Characters of OpenImageIO's error messages that are quoted. A damaged header may be quoted in one.
LONGEST_REASON = 200


@dataclass(frozen=True)
class Channel:
    """One channel of one part of one file."""

    path: Path
    part: int
    """Index of the part in the file."""
    index: int
    """Index of the channel in the part, in OpenImageIO's order."""
    name: str
    """As stored, e.g. ``ViewLayer.Combined.R``."""
    type: str
    """``half``, ``float`` or ``uint``."""


@dataclass(frozen=True)
class Part:
    """One part of a file; OpenImageIO calls it a subimage."""

    index: int
    name: str
    """Empty in files of a single part without a name."""
    view: str
    """The view that the header names, e.g. ``left``; empty if it names none."""
    channels: tuple[Channel, ...]
    data_window: Window
    compression: str
    """As OpenImageIO names it, e.g. ``zip`` or ``dwaa``."""
    tile: tuple[int, int]
    """Width and height of a tile; (0, 0) for scan lines."""
    deep: bool
    spec: Any = field(repr=False, compare=False)
    """OpenImageIO's ``ImageSpec``, from which a copy of the part can be written."""

    @cached_property
    def metadata(self) -> dict[str, Any]:
        """Header attributes by their OpenImageIO names."""
        return {_text(attribute.name): _text(attribute.value) for attribute in self.spec.extra_attribs}

    @property
    def nbytes(self) -> int:
        """Bytes of all pixels in their stored types."""
        return sum(self.plane_bytes(channel) for channel in self.channels)

    def plane_bytes(self, channel: Channel) -> int:
        """Return the bytes of the pixels of a channel in its stored type."""
        return self.data_window.width * self.data_window.height * (2 if channel.type == "half" else 4)

    @property
    def strip_height(self) -> int:
        """Rows that are decoded together: whole tiles, or whole chunks of scan lines; fewer with many channels."""
        unit = self.tile[1] or ROWS_PER_CHUNK.get(self.compression, 1)
        row_bytes = self.nbytes // max(1, self.data_window.height)
        return unit * max(1, min(ROWS_PER_STRIP, LARGEST_STRIP // max(1, row_bytes)) // unit)


@dataclass(frozen=True)
class ExrFile:
    """An EXR file whose headers were read by :func:`open_exr`.

    Inside :meth:`cache_strips`, read it from one thread at a time.
    """

    path: Path
    parts: tuple[Part, ...]
    display_window: Window
    pixel_aspect: float
    """Width of a pixel divided by its height."""
    metadata: dict[str, Any]
    """Header attributes of all parts by their OpenImageIO names; if two parts differ, that of the first part."""
    siblings: dict[Path, ExrFile] = field(default_factory=dict, repr=False, compare=False)
    """Other files that hold layers of the same frame, for renderers that write one file for each AOV."""
    _cache: StripCache = field(default_factory=StripCache, repr=False, compare=False)

    @cached_property
    def _input(self) -> Any:
        handle = oiio.ImageInput.open(str(self.path))
        if handle is None:
            raise InputError(f"{self.path}: can't be opened ({reason_of(oiio)})")
        return handle

    def close(self) -> None:
        """Close the file and its siblings. The next :meth:`read` opens them again."""
        if (handle := self.__dict__.pop("_input", None)) is not None:
            handle.close()
        for sibling in self.siblings.values():
            sibling.close()

    def read(self, channels: Sequence[Channel], window: Window) -> Array:
        """Return channels over a rectangle, float32 (height, width, len(channels)), each contiguous in memory.

        Pixels outside a part's data window are 0, as OpenEXR defines them. All channels of a part are decoded
        together, whatever layers they belong to.

        Args:
            channels: of this file or of its ``siblings``.
            window: in the coordinates of the data windows.

        Raises:
            InputError: pixels can't be decoded, because the file is truncated or corrupt.
        """
        self._cache.drop_outside(window.y0, window.y1)
        result = np.zeros((len(channels), window.height, window.width), dtype=np.float32).transpose(1, 2, 0)
        groups: dict[tuple[Path, int], dict[int, int]] = {}
        for position, channel in enumerate(channels):
            groups.setdefault((channel.path, channel.part), {})[position] = channel.index
        for (path, part), columns in groups.items():
            owner = self if path == self.path else self.siblings[path]
            owner._read_part(owner.parts[part], columns, window, result, self._cache)
        return result

    @contextmanager
    def cache_strips(self, max_bytes: int) -> Iterator[None]:
        """Keep decoded rows from one :meth:`read` to the next inside the ``with`` block.

        Read windows from left to right and from top to bottom: every row is then decoded once for each row of windows.
        The cache holds the rows of the last window over the full width: 2 bytes for each pixel of a channel if all
        channels that are read from the part are half, otherwise 4. Rows beyond ``max_bytes`` are decoded again for each
        window; only small parts of strips are kept beyond it.
        """
        self._cache.max_bytes = max_bytes
        try:
            yield
        finally:
            self._cache.max_bytes = 0
            self._cache.clear()

    def native_planes(self, part: Part, channels: Sequence[Channel], *, on_disk: bool) -> dict[Channel, NDArray[Any]]:
        """Return whole channels of a part in their stored pixel types, (height, width) each, to be copied bit for bit.

        Args:
            on_disk: put them into temporary files.

        Raises:
            InputError: pixels can't be decoded.
            MssplError: the disk has no room for the temporary files.
        """
        window, planes = part.data_window, dict[Channel, NDArray[Any]]()
        for kind, dtype in DTYPES.items():
            alike = [channel for channel in channels if channel.type == kind]
            if not alike:
                continue
            pixels = blank((window.height, window.width, len(alike)), dtype, on_disk=on_disk)
            for y0, y1 in strip_rows(window.y0, window.y1, window.y0, part.strip_height, window.y1):
                strip = self._decode_channels(part, y0, y1, tuple(channel.index for channel in alike), kind)
                pixels[y0 - window.y0 : y1 - window.y0] = strip
                unload(pixels)
            planes |= zip(alike, np.moveaxis(pixels, -1, 0), strict=True)
        return planes

    def _read_part(self, part: Part, columns: dict[int, int], window: Window, result: Array, cache: StripCache) -> None:
        """Read channels of a part, whose indices are ``columns`` by position in ``result``, which covers ``window``."""
        whole = part.data_window
        area = window.intersect(whole)
        if area.width == 0 or area.height == 0:
            return
        indices = tuple(columns.values())
        planes = adjacent(list(columns))
        for y0, y1 in strip_rows(area.y0, area.y1, whole.y0, part.strip_height, whole.y1):
            if not (cache.max_bytes or part.tile[1]):  # only this read needs these rows
                y0, y1 = max(y0, area.y0), min(y1, area.y1)
            key = StripKey(self.path, part.index, indices, y0, y1)
            strip = cache.get(key)
            if strip is None:
                kind = "half" if all(part.channels[i].type == "half" for i in indices) else "float"
                strip = self._decode_channels(part, y0, y1, indices, kind)
                cache.keep(key, strip)
            shared = area.intersect(Window(area.x0, y0, area.x1, y1))
            result[(*shared.slices(window), planes)] = strip[shared.slices(Window(whole.x0, y0, whole.x1, y1))]

    def _decode_channels(self, part: Part, y0: int, y1: int, indices: tuple[int, ...], kind: str) -> NDArray[Any]:
        """Decode a strip of some channels in one pixel type, (rows, width, channels), each contiguous."""
        first, last = min(indices), max(indices) + 1
        strip = self._decode(part, y0, y1, first, last, kind)
        planes = np.empty((len(indices), *strip.shape[:2]), DTYPES[kind])
        wanted = adjacent([i - first for i in indices])
        for row, pixels in enumerate(strip):  # a row fits into the processor's cache, which makes this twice as fast
            planes[:, row] = pixels.T[wanted]
        return planes.transpose(1, 2, 0)

    def _decode(self, part: Part, y0: int, y1: int, first: int, last: int, kind: str) -> NDArray[Any]:
        """Decode rows of neighbouring channels over the full width, in pixel type ``kind``: (rows, width, channels)."""
        if part.tile[1]:
            x0, x1 = part.data_window.x0, part.data_window.x1
            strip = self._input.read_tiles(part.index, 0, x0, x1, y0, y1, 0, 1, first, last, kind)
        else:
            strip = self._input.read_scanlines(part.index, 0, y0, y1, 0, first, last, kind)
        if strip is None:
            raise unreadable(self.path, part, reason_of(self._input), f", rows {y0} to {y1 - 1}")
        return np.asarray(strip)


def adjacent(indices: list[int]) -> slice | list[int]:
    """Return indices as a slice if each follows the one before: it is copied several times as fast as a list."""
    run = slice(indices[0], indices[-1] + 1)
    return run if indices == list(range(run.start, run.stop)) else indices


def use_threads(count: int) -> None:
    """Set the number of threads with which this process decodes and compresses; 0 changes nothing."""
    for library in ("threads", "exr_threads") if count else ():
        oiio.attribute(library, count)


def unreadable(path: Path, part: Part, reason: str, where: str = "") -> InputError:
    """Return the error for pixels that can't be decoded; ``where`` follows the part's name."""
    return InputError(
        f"{path}: part {part.index} ({part.name or 'unnamed'}){where} can't be read ({reason}); "
        "the file is damaged or still being written"
    )


def open_exr(path: str | Path) -> ExrFile:
    """Read the headers of an EXR file.

    Raises:
        InputError: the file does not exist, is not an EXR, has corrupt headers, or has subsampled channels.
    """
    path = Path(path)
    check_encodable(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    if not path.is_file():
        raise InputError(f"{path}: {'is no ordinary file' if path.exists() else 'no such file'}")
    handle = oiio.ImageInput.open(str(path))
    if handle is None:
        raise _refused(path, reason_of(oiio))
    if handle.format_name() != "openexr":
        kind = handle.format_name()
        raise InputError(f"{path}: is a {kind} file; give an EXR, other formats lose what the network needs")
    parts: list[Part] = []
    metadata: dict[str, Any] = {}
    while handle.seek_subimage(len(parts), 0):
        parts.append(_part(path, len(parts), handle.spec()))
        for name, value in parts[-1].metadata.items():
            metadata.setdefault(name, value)
    if handle.has_error:  # the loop ended at a part that OpenImageIO can't read
        raise _refused(path, reason_of(handle))
    if not parts:
        raise InputError(f"{path}: holds no image")
    first = parts[0].spec
    frame = Window(0, 0, first.full_width, first.full_height).shift(first.full_x, first.full_y)
    return ExrFile(path, tuple(parts), frame, float(metadata.get("PixelAspectRatio", 1.0)), metadata)


def _refused(path: Path, reason: str) -> InputError:
    hint = "convert it to RGB" if "ubsampled" in reason else "render it again"
    return InputError(f"{path}: can't be opened as an EXR ({reason}); {hint}")


def _part(path: Path, index: int, spec: Any) -> Part:
    types = [str(t) for t in spec.channelformats] or [str(spec.format)] * spec.nchannels
    named = enumerate(zip(map(_text, spec.channelnames), types, strict=True))
    return Part(
        index=index,
        name=_text(str(spec.getattribute("oiio:subimagename") or "")),
        view=_text(str(spec.getattribute("view") or "")),
        channels=tuple(Channel(path, index, i, name, kind) for i, (name, kind) in named),
        data_window=Window(0, 0, spec.width, spec.height).shift(spec.x, spec.y),
        compression=str(spec.getattribute("compression") or "none").split(":")[0],
        tile=(spec.tile_width, spec.tile_height),
        deep=bool(spec.deep),
        spec=oiio.ImageSpec(spec),
    )


def _text(value: Any) -> Any:
    """Return a header's text, or its sequence of texts, with bytes that are not UTF-8 read as Latin-1."""
    if isinstance(value, tuple | list):
        return tuple(_text(element) for element in value)
    if not isinstance(value, str) or value.isascii():
        return value
    # Old exporters write Latin-1. OpenImageIO gives such bytes as lone surrogates, which it refuses to write.
    raw = value.encode("utf-8", "surrogateescape")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def reason_of(source: Any) -> str:
    """Return the first error of OpenImageIO, or of one of its files, on one line; others may follow from it."""
    try:
        # The rest is advice for programmers: to raise a limit of the library.
        reason = str(source.geterror()).partition("Possible corrupt input?")[0].strip()
        first = " ".join(reason.partition("\n")[0].split())
        return f"{first[:LONGEST_REASON]}..." if len(first) > LONGEST_REASON else first or "no reason given"
    except UnicodeDecodeError:  # the message quotes bytes of the file, and OpenImageIO's binding expects UTF-8
        return "its header or its pixels are damaged"
