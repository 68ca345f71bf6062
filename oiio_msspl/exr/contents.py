# SPDX-License-Identifier: Apache-2.0
"""What the output file holds: the fused pixels, and the channels of the HRLS that are passed on beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layer_by_channel, matches_layer
from oiio_msspl.exr.reader import Channel, ExrFile, Part
from oiio_msspl.exr.replaced import DTYPES, ReplacedChannels
from oiio_msspl.exr.write_options import DEFAULT_COMPRESSION, LOSSLESS, WriteOptions
from oiio_msspl.image.arrays import HALF_MAX, Array


@dataclass(frozen=True)
class FusedPixels:
    """The fused beauty, and layers about it.

    Rows are converted to the stored type as they are written: a second copy of an 8K frame takes half a gigabyte.
    """

    rgb: Array
    """Scene linear, (height, width, 3)."""
    alpha: Array | None
    """(height, width, 1), if the HRLS has an alpha."""
    extra: Mapping[str, NDArray[Any]]
    """Further layers, those of :data:`oiio_msspl.exr.write_options.COMPONENTS`, (height, width, channels) each."""
    kind: str
    """Pixel type in the file: ``half`` or ``float``."""

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Rows of the beauty as stored, (stop - start, width, 3 or 4)."""
        values = self.rgb[start:stop]
        if self.alpha is not None:
            values = np.concatenate([values, self.alpha[start:stop]], axis=-1)
        return self._stored(values)

    def extra_rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Rows of a further layer as stored, (stop - start, width, channels)."""
        return self._stored(self.extra[name][start:stop])

    def _stored(self, values: NDArray[Any]) -> NDArray[Any]:
        if self.kind == "half":
            values = np.minimum(values, np.float32(HALF_MAX))
        return np.ascontiguousarray(values, dtype=DTYPES[self.kind])


@dataclass(frozen=True)
class FileContents:
    """Everything that a writer needs to know."""

    source: ExrFile
    """The HRLS."""
    beauty: tuple[Channel, ...]
    """Its channels R, G, B and perhaps A, which the fused pixels replace."""
    dropped: frozenset[Channel]
    """Its channels that are left out."""
    pixels: FusedPixels
    attributes: dict[str, str]
    """Header attributes that are added to the part of the beauty."""
    options: WriteOptions
    replaced: ReplacedChannels | None = None
    """New pixels for channels that are passed on, over the data window of their part."""

    @property
    def home(self) -> Part:
        """The HRLS's part that holds the beauty."""
        return self.source.parts[self.beauty[0].part]

    @cached_property
    def layers(self) -> dict[Channel, Layer]:
        """The layer of each channel of the HRLS. A channel may be in none, and those of deep parts are."""
        return layer_by_channel(self.source)

    @property
    def view(self) -> str:
        """The view of the fused beauty; empty in a file without views."""
        layer = self.layers.get(self.beauty[0])
        return layer.view if layer else ""

    @property
    def compression(self) -> str:
        """Compression of the fused beauty."""
        return self.options.compression or lossless(self.home)


def lossless(part: Part) -> str:
    """A part's compression, or a lossless one in place of a lossy one."""
    return part.compression if part.compression in LOSSLESS else DEFAULT_COMPRESSION


def widest_type(channels: Sequence[Channel]) -> str:
    """``float`` if one of the channels is float, otherwise ``half``."""
    return "float" if any(c.type == "float" for c in channels) else "half"


def stored_type(beauty: Sequence[Channel], options: WriteOptions) -> str:
    """Pixel type in which the fused beauty is written: ``half`` or ``float``."""
    return options.pixel_type or widest_type(beauty)


def dropped_channels(file: ExrFile, beauty: Sequence[Channel], patterns: Sequence[str]) -> frozenset[Channel]:
    """The channels of the HRLS that are neither replaced nor passed on.

    Args:
        file: the HRLS.
        beauty: its channels that the fused beauty replaces.
        patterns: ``WriteOptions.layers``. A pattern matches the name of a layer or of a channel, see
            :func:`oiio_msspl.exr.layers.matches_layer`.

    Raises:
        InputError: a pattern matches nothing.
    """
    if not patterns:
        return frozenset()
    # A deep part must not take the place of a flat one that has a layer of the same name.
    layer_of = layer_by_channel(file, deep=True) | layer_by_channel(file)
    every = {c for part in file.parts for c in part.channels}
    kept: set[Channel] = {*beauty}
    for pattern in patterns:
        # The beauty may be named, too, though it is written anyway.
        found = {c for c in every if _is_meant(pattern, c, layer_of.get(c), file.parts[c.part])}
        if not found and pattern != "none":
            names = {layer_of[c].name or c.name if c in layer_of else c.name for c in every.difference(beauty)}
            known = ", ".join(sorted(names)) or "no other layer"
            raise InputError(f"--layers {pattern!r}: {file.path} has no such layer; it has: {known}")
        kept |= found
    return frozenset(every - kept)


def _is_meant(pattern: str, channel: Channel, layer: Layer | None, part: Part) -> bool:
    """Whether a pattern means a channel. ``depth`` also means a plain Z, as in Nuke. A layer without a name, such as a
    view's beauty, goes by the names of its part and its view."""
    prefix, _, component = channel.name.rpartition(".")
    name = layer.name if layer else prefix
    if not name:
        names = [channel.name, part.name, layer.view if layer else "", "depth" if channel.name == "Z" else ""]
        return any(matches_layer(pattern, each) for each in names if each)
    return matches_layer(pattern, name if name == part.name else f"{part.name}.{name}", component)
