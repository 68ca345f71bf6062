# SPDX-License-Identifier: Apache-2.0
"""Describe the output file: the fused pixels, and the channels of the HRLS that are passed on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layer_by_channel, matches_layer
from oiio_msspl.exr.reader import DTYPES, Channel, ExrFile, Part
from oiio_msspl.exr.replaced import ReplacedChannels
from oiio_msspl.exr.write_options import DEFAULT_COMPRESSION, LOSSLESS, WriteOptions
from oiio_msspl.image.arrays import HALF_MAX, Array


@dataclass(frozen=True)
class FileContents:
    """The input of a writer: the fused pixels, and the channels of the HRLS that are passed on.

    Rows are converted to the stored type as they are written: a second copy of an 8K frame takes half a gigabyte.
    """

    source: ExrFile
    """The HRLS."""
    fused: tuple[Channel, ...]
    """Channels R, G, B and perhaps A of the HRLS, which the fused pixels replace."""
    options: WriteOptions
    rgb: Array = field(default_factory=lambda: np.empty((0, 0, 3), np.float32))
    """The fused beauty, scene linear, (height, width, 3), over its data window."""
    alpha: Array | None = None
    """Its alpha, (height, width, 1), if ``fused`` has an A."""
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Further layers, those of :data:`oiio_msspl.exr.write_options.COMPONENTS`, (height, width, channels) each."""
    attributes: dict[str, str] = field(default_factory=dict)
    """Header attributes that are added to the part of the beauty."""
    replaced: ReplacedChannels = field(default_factory=ReplacedChannels)
    """New pixels for channels that are passed on, over the data window of their part."""

    @cached_property
    def beauty(self) -> tuple[Channel, ...]:
        """The channels of the fused part: ``fused`` without an alpha of another part."""
        return without_alpha_apart(self.fused)

    @cached_property
    def dropped(self) -> frozenset[Channel]:
        """Channels of the HRLS that are left out."""
        return dropped_channels(self.source, self.fused, self.options.layers)

    @property
    def home(self) -> Part:
        """The HRLS's part that holds the beauty."""
        return self.source.parts[self.beauty[0].part]

    @cached_property
    def layers(self) -> dict[Channel, Layer]:
        """Layers by channel of the HRLS. Channels of deep parts are missing, and others may be."""
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

    @property
    def kind(self) -> str:
        """Pixel type of the fused beauty and the further layers: ``half`` or ``float``."""
        return stored_type(self.beauty, self.options)

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return rows of the beauty as stored, (stop - start, width, 3 or 4)."""
        values = self.rgb[start:stop]
        if self.alpha is not None:
            values = np.concatenate([values, self.alpha[start:stop]], axis=-1)
        return self._stored(values)

    def extra_rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Return rows of a further layer as stored, (stop - start, width, channels)."""
        return self._stored(self.extra[name][start:stop])

    @cached_property
    def passed_on(self) -> list[tuple[Part, list[Channel]]]:
        """The parts of the HRLS with their channels that are neither fused nor dropped."""
        left_out = self.dropped.union(self.beauty)
        parts = ((part, [c for c in part.channels if c not in left_out]) for part in self.source.parts if not part.deep)
        return [(part, channels) for part, channels in parts if channels]

    def planes(self, part: Part, channels: Sequence[Channel], *, on_disk: bool) -> dict[Channel, NDArray[Any]]:
        """Return channels that are passed on, with new pixels if they are replaced, as stored, (height, width) each."""
        new = {channel: self.replaced.planes[channel] for channel in channels if channel in self.replaced.planes}
        return new | self.source.native_planes(part, [c for c in channels if c not in new], on_disk=on_disk)

    def _stored(self, values: NDArray[Any]) -> NDArray[Any]:
        if self.kind == "half":
            values = np.minimum(values, np.float32(HALF_MAX))
        return np.ascontiguousarray(values, dtype=DTYPES[self.kind])


def lossless(part: Part) -> str:
    """Return a part's compression, or ``DEFAULT_COMPRESSION`` if that is lossy."""
    return part.compression if part.compression in LOSSLESS else DEFAULT_COMPRESSION


def stored_type(beauty: Sequence[Channel], options: WriteOptions) -> str:
    """Return the pixel type in which the fused beauty is written: ``half`` or ``float``."""
    types = {channel.type for channel in without_alpha_apart(beauty)}
    return options.pixel_type or ("float" if "float" in types else "half")


def without_alpha_apart(beauty: Sequence[Channel]) -> tuple[Channel, ...]:
    """Return the channels of a beauty without an alpha that lies in a part of its own, where it stays."""
    return tuple(beauty[:3] if beauty[-1].part != beauty[0].part and len(beauty) > 3 else beauty)


def dropped_channels(file: ExrFile, beauty: Sequence[Channel], patterns: Sequence[str]) -> frozenset[Channel]:
    """Return the channels of the HRLS that are not the beauty, and that match no pattern of ``WriteOptions.layers``."""
    if not patterns:
        return frozenset()
    # A deep part must not take the place of a flat one that has a layer of the same name.
    layer_of = layer_by_channel(file, deep=True) | layer_by_channel(file)
    channels = {c for part in file.parts for c in part.channels}
    kept: set[Channel] = {*beauty}
    for pattern in patterns:
        # A pattern may name the beauty, though it is written anyway.
        matches = {c for c in channels if _is_meant(pattern, c, layer_of.get(c), file.parts[c.part])}
        if not matches and pattern != "none":
            names = {layer_of[c].name or c.name if c in layer_of else c.name for c in channels.difference(beauty)}
            listed = ", ".join(sorted(names)) or "no other layer"
            raise InputError(f"--layers {pattern!r}: {file.path} has no such layer; it has: {listed}")
        kept |= matches
    return frozenset(channels - kept)


def _is_meant(pattern: str, channel: Channel, layer: Layer | None, part: Part) -> bool:
    prefix, _, component = channel.name.rpartition(".")
    name = layer.name if layer else prefix
    if not name:  # such as a view's beauty. In Nuke, a plain Z is called depth.
        names = [channel.name, part.name, layer.view if layer else "", "depth" if channel.name == "Z" else ""]
        return any(matches_layer(pattern, name) for name in names if name)
    return matches_layer(pattern, name if name == part.name else f"{part.name}.{name}", component)
