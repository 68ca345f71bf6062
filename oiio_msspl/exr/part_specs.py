# SPDX-License-Identifier: Apache-2.0
"""Describe the parts of a multi-part file as OpenImageIO's ``ImageSpec``.

A description starts as a copy of the HRLS's part, so that windows and metadata are kept.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import OpenImageIO as oiio

from oiio_msspl.exr.contents import FileContents, lossless
from oiio_msspl.exr.reader import Channel, ExrFile, Part
from oiio_msspl.exr.write_options import COMPONENTS

#: Attributes that say how the source was stored. The writer sets them again, or they have no meaning in the copy.
_STRUCTURE = (
    *("openexr:chunkCount", "openexr:lineOrder", "oiio:subimages", "oiio:RowsPerChunk", "compression", "type"),
    "acesImageContainerFlag",  # ST 2065-4 forbids compression and AOVs in a file that carries it
)
#: Effort of ZIP, 1 to 9. OpenEXR's default is 4, which takes a third longer and makes renders 1 to 2 % smaller.
ZIP_LEVEL = 1
#: Attributes that OpenEXR requires to be equal in all parts of a file. Only the first part may have one alone.
_SHARED = ("PixelAspectRatio", "chromaticities", "smpte:TimeCode")
#: Attributes that every part keeps. OpenImageIO would fill in defaults for the first three.
_KEPT_IN_EVERY_PART = (
    *("screenWindowWidth", "screenWindowCenter", "DateTime"),
    *(*_SHARED, "colorInteropID", "view", "name", "oiio:subimagename", "compression"),
)

#: Bytes of the largest part of mixed pixel types that stays whole, because it is held in memory while it is copied.
LARGEST_MIXED_PART = 256 << 20


class _NameOrigin(IntEnum):
    """The source of a part's name. Of two equal names, the one from the source listed first stays as it is."""

    PART = 0
    LAYER = 1
    MADE_UP = 2


@dataclass(frozen=True)
class PassedOnPart:
    """A part to be written with pixels of the HRLS."""

    spec: Any
    source: Part
    runs: tuple[tuple[Channel, ...], ...] | None
    """Runs of neighbouring channels of one pixel type, in the order in which they are written. None copies the whole
    part with its mixed pixel types."""


def beauty_spec(contents: FileContents) -> Any:
    """Describe the part of the fused beauty."""
    home = contents.home
    if contents.options.layout == "nuke":
        name, channels = _nuke_name("rgba", contents.view), ["R", "G", "B", "A"][: len(contents.beauty)]
    else:
        # The name of an only part says nothing; in the result, it would name a layer of plain channels.
        named = home.name and (len(contents.source.parts) > 1 or "." in contents.beauty[0].name)
        name, channels = home.name if named else "rgba", [channel.name for channel in contents.beauty]
    spec = _spec(home, name, channels, contents.kind, contents.view)
    _compress(spec, contents.compression)
    for key, value in contents.attributes.items():
        spec.attribute(key, value)
    return spec


def extra_spec(contents: FileContents, name: str, taken: set[str]) -> Any:
    """Describe the part of a further layer, and add its name to those that are ``taken``."""
    prefix = "" if contents.options.layout == "nuke" else f"{name}."
    channels = [f"{prefix}{component}" for component in COMPONENTS[name]]
    spec = _spec(contents.home, _unique(name, taken), channels, contents.kind, contents.view)
    _drop_repeated_attributes(spec)
    _compress(spec, contents.compression)
    return spec


def passed_on_parts(contents: FileContents, taken: set[str]) -> Iterator[PassedOnPart]:
    """Yield parts with all channels of the HRLS that are neither fused nor dropped, and add their names to ``taken``.

    A part stays whole if it can. Others are split into one part for each layer and pixel type.
    """
    named = list(_named_parts(contents))
    for name, origin, part in named:
        reserved = {n for n, o, _ in named if o < origin or (o == origin and n != name)}
        _set_name(part.spec, _unique(name, taken, reserved))
        yield part


def _named_parts(contents: FileContents) -> Iterator[tuple[str, _NameOrigin, PassedOnPart]]:
    """Yield the parts that are passed on, with the names that they should have."""
    layer_of = contents.layers
    for part in contents.source.parts:
        if part.deep:
            continue
        if _stays_whole(part, contents):
            origin = _NameOrigin.PART if part.name else _NameOrigin.MADE_UP
            spec = _copied(part)
            spec.channelnames = tuple(channel.name for channel in part.channels)
            whole = PassedOnPart(spec, part, (part.channels,) if _has_one_type(part) else None)
            yield part.name or f"part{part.index}", origin, whole
            continue
        groups: dict[tuple[str, str, str], list[Channel]] = {}
        for channel in part.channels:
            if channel not in contents.beauty and channel not in contents.dropped:
                layer = layer_of.get(channel)
                # A channel without a layer repeats another one (foo.r beside foo.R): it gets a part of its own.
                key = (layer.view, layer.name, channel.type) if layer else ("", channel.name, channel.type)
                groups.setdefault(key, []).append(channel)
        # Metadata is written once: in the beauty's part, or in the first part that this one is split into.
        repeats_metadata = not set(contents.beauty).isdisjoint(part.channels)
        for (view, layer_name, kind), channels in groups.items():
            name, origin = _layer_name(contents, part, view, layer_name, channels)
            names = _components(channels) if contents.options.layout == "nuke" else [c.name for c in channels]
            spec = _spec(part, name, names, kind, view)
            if repeats_metadata:
                _drop_repeated_attributes(spec)
            yield name, origin, PassedOnPart(spec, part, tuple(runs(channels)))
            repeats_metadata = True


def _stays_whole(part: Part, contents: FileContents) -> bool:
    """Return whether all channels of a part can be copied into one part of the same name."""
    if contents.options.layout == "nuke" or any(c in contents.beauty or c in contents.dropped for c in part.channels):
        return False
    if _has_one_type(part):
        return True
    # OpenEXR can't mix tiles with scan lines in one file, and the beauty has scan lines. OpenImageIO can't rewrite
    # mixed pixel types as scan lines: it copies such a part in memory, as it is.
    is_replaced = contents.replaced is not None and any(c in contents.replaced for c in part.channels)
    return not is_replaced and part.tile == (0, 0) and part.nbytes <= LARGEST_MIXED_PART


def is_held_whole(part: Part, contents: FileContents) -> bool:
    """Return whether a part is held in memory while it is copied: it stays whole and has several pixel types."""
    return not part.deep and not _has_one_type(part) and _stays_whole(part, contents)


def _has_one_type(part: Part) -> bool:
    return len({channel.type for channel in part.channels}) == 1


def _layer_name(
    contents: FileContents, part: Part, view: str, layer: str, channels: Sequence[Channel]
) -> tuple[str, _NameOrigin]:
    """Name the part for the channels of one layer and pixel type."""
    components = _components(channels)
    is_beauty = not layer and view and {"R", "G", "B"} <= {*components}  # of another view
    plain = layer or ("rgba" if is_beauty else "depth" if components == ["Z"] else "other")
    if contents.options.layout == "nuke":
        name = _nuke_name(plain, view)
        is_parts = name in (_nuke_name(part.name, ""), _nuke_name(part.name.removesuffix(f".{view}"), view))
    elif is_beauty and part.name and len(contents.source.parts) > 1:
        name, is_parts = part.name, True
    else:
        name = f"{plain}.{view}" if view and view != contents.view else plain
        is_parts = name == part.name
    return name, _NameOrigin.PART if is_parts else _NameOrigin.LAYER if layer else _NameOrigin.MADE_UP


def _components(channels: Sequence[Channel]) -> list[str]:
    """Return the channels' names without their layers."""
    return [channel.name.rpartition(".")[2] for channel in channels]


def share_attributes(specs: Sequence[Any], source: ExrFile) -> None:
    """Copy the attributes that OpenEXR requires to match (pixel aspect, time code, ...) to every output part.

    The first part of ``source`` that has such an attribute counts, because the beauty's part may lack it.
    """
    for name in _SHARED:
        attributes = [a for part in source.parts for a in part.spec.extra_attribs if a.name == name]
        for spec in specs if attributes else ():
            if spec.getattribute(name) is None:
                spec.attribute(name, attributes[0].type, attributes[0].value)


def runs(channels: Sequence[Channel]) -> Iterator[tuple[Channel, ...]]:
    """Cut channels of one pixel type where their indices are not neighbours: a run can be decoded in one call."""
    # In a run, index and position grow together.
    for _, run in itertools.groupby(enumerate(channels), lambda place: place[1].index - place[0]):
        yield tuple(channel for _, channel in run)


def _nuke_name(layer: str, view: str) -> str:
    """Name a part as Nuke does: the only dot is the one before the view."""
    return layer.replace(".", "_") + (f".{view}" if view else "")


def _unique(name: str, taken: set[str], reserved: Collection[str] = ()) -> str:
    """Add a number to a part's name if it is taken or reserved: parts of one file need different names."""
    candidate, number = name, 2
    while candidate in taken or candidate in reserved:
        candidate, number = f"{name}{number}", number + 1
    taken.add(candidate)
    return candidate


def _spec(part: Part, name: str, channels: list[str], kind: str, view: str) -> Any:
    """Describe a part of scan lines with channels of one view, with the windows and metadata of ``part``."""
    spec = _copied(part)
    spec.nchannels = len(channels)
    spec.channelnames = tuple(channels)
    spec.channelformats = ()
    spec.format = oiio.TypeDesc(kind)
    _set_name(spec, name)
    spec.erase_attribute("multiView")  # it names the views of a part that has several
    if view:
        spec.attribute("view", view)
    return spec


def _drop_repeated_attributes(spec: Any) -> None:
    """Drop metadata that another part holds for the whole file: a Cryptomatte manifest can take megabytes."""
    for name in [attribute.name for attribute in spec.extra_attribs]:
        # OpenImageIO can't erase an attribute whose name is not UTF-8. Such a name holds surrogates.
        if name not in _KEPT_IN_EVERY_PART and name.isprintable():
            spec.erase_attribute(name)


def _copied(part: Part) -> Any:
    """Describe a part of scan lines with all channels, windows and metadata of ``part``."""
    spec = oiio.ImageSpec(part.spec)
    spec.tile_width = spec.tile_height = spec.tile_depth = 0
    for attribute in _STRUCTURE:
        spec.erase_attribute(attribute)
    _compress(spec, lossless(part))
    return spec


def _set_name(spec: Any, name: str) -> None:
    spec.attribute("oiio:subimagename", name)
    spec.attribute("name", name)


def _compress(spec: Any, compression: str) -> None:
    spec.attribute("compression", f"{compression}:{ZIP_LEVEL}" if compression in ("zip", "zips") else compression)
