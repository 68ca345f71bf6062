# SPDX-License-Identifier: Apache-2.0
"""Describe the parts of a multi-part file as OpenImageIO's ``ImageSpec``.

A description starts as a copy of the HRLS's part, so that windows and metadata are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
#: Where a part's name comes from. Of two equal names, the one from the source listed first stays as it is.
_PART, _LAYER, _MADE_UP = range(3)


@dataclass(frozen=True)
class PassedOnPart:
    """A part to be written with pixels of the HRLS."""

    spec: Any
    source: Part
    channels: Sequence[Channel]
    """All have one pixel type."""


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


def passed_on_parts(contents: FileContents, taken: set[str]) -> list[PassedOnPart]:
    """Return parts with all channels of the HRLS that are neither fused nor dropped, and add their names to ``taken``.

    A part stays whole if it can. Others are split into one part for each layer and pixel type.
    """
    named = list(_named_parts(contents))
    for name, _, part in sorted(named, key=lambda each: each[1]):
        _set_name(part.spec, _unique(name, taken))
    return [part for _, _, part in named]


def _named_parts(contents: FileContents) -> Iterator[tuple[str, int, PassedOnPart]]:
    """Yield the parts that are passed on, with the names that they should have and where these come from."""
    is_nuke = contents.options.layout == "nuke"
    for part, passed_on in contents.passed_on:
        kinds = {channel.type for channel in passed_on}
        if not is_nuke and len(passed_on) == len(part.channels) and len(kinds) == 1:
            name, origin = (part.name, _PART) if part.name else (f"part{part.index}", _MADE_UP)
            spec = _spec(part, name, [channel.name for channel in passed_on], kinds.pop(), "")
            yield name, origin, PassedOnPart(spec, part, passed_on)
            continue
        groups: dict[tuple[str, str, str], list[Channel]] = {}
        for channel in passed_on:
            layer = contents.layers.get(channel)
            # A channel without a layer repeats another one (foo.r beside foo.R): it gets a part of its own.
            key = (layer.view, layer.name, channel.type) if layer else ("", channel.name, channel.type)
            groups.setdefault(key, []).append(channel)
        # Metadata is written once: in the beauty's part, or in the first part that this one is split into.
        repeats_metadata = not set(contents.beauty).isdisjoint(part.channels)
        for (view, layer_name, kind), channels in groups.items():
            name, origin = _layer_name(contents, part, view, layer_name, channels)
            names = _components(channels) if is_nuke else [c.name for c in channels]
            spec = _spec(part, name, names, kind, view)
            if repeats_metadata:
                _drop_repeated_attributes(spec)
            yield name, origin, PassedOnPart(spec, part, channels)
            repeats_metadata = True


def _layer_name(
    contents: FileContents, part: Part, view: str, layer: str, channels: Sequence[Channel]
) -> tuple[str, int]:
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
    return name, _PART if is_parts else _LAYER if layer else _MADE_UP


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


def _nuke_name(layer: str, view: str) -> str:
    """Name a part as Nuke does: the only dot is the one before the view."""
    return layer.replace(".", "_") + (f".{view}" if view else "")


def _unique(name: str, taken: set[str]) -> str:
    """Add a number to a part's name if it is taken: parts of one file need different names."""
    candidate, number = name, 2
    while candidate in taken:
        candidate, number = f"{name}{number}", number + 1
    taken.add(candidate)
    return candidate


def _spec(part: Part, name: str, channels: list[str], kind: str, view: str) -> Any:
    """Describe a part of scan lines with channels of one pixel type, with the windows and metadata of ``part``.

    ``view`` is that of all channels; empty if the file has no views, or if the part keeps all its channels.
    """
    spec = oiio.ImageSpec(part.spec)
    spec.tile_width = spec.tile_height = spec.tile_depth = 0
    for attribute in _STRUCTURE:
        spec.erase_attribute(attribute)
    _compress(spec, lossless(part))
    spec.nchannels = len(channels)
    spec.channelnames = tuple(channels)
    spec.channelformats = ()
    spec.format = oiio.TypeDesc(kind)
    _set_name(spec, name)
    if view:
        spec.erase_attribute("multiView")  # it names the views of a part that has several
        spec.attribute("view", view)
    return spec


def _drop_repeated_attributes(spec: Any) -> None:
    """Drop metadata that another part holds for the whole file: a Cryptomatte manifest can take megabytes."""
    for name in [attribute.name for attribute in spec.extra_attribs]:
        # OpenImageIO can't erase an attribute whose name is not UTF-8. Such a name holds surrogates.
        if name not in _KEPT_IN_EVERY_PART and name.isprintable():
            spec.erase_attribute(name)


def _set_name(spec: Any, name: str) -> None:
    spec.attribute("oiio:subimagename", name)
    spec.attribute("name", name)


def _compress(spec: Any, compression: str) -> None:
    spec.attribute("compression", f"{compression}:{ZIP_LEVEL}" if compression in ("zip", "zips") else compression)
