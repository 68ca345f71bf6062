# SPDX-License-Identifier: Apache-2.0
"""Group the channels of a file into layers, by the names of channels, parts and views."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from oiio_msspl.exr.reader import Channel, ExrFile, Part

#: Part names that do not name a layer: channels without a prefix in such a part are plain R, G, B.
_PLAIN_PART = re.compile(r"((rgba?|default|image|part ?\d+|subimage ?\d+)([._ -]main)?|main)?", re.IGNORECASE)
_COMPONENTS = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B", "a": "A", "alpha": "A"}
_COMPONENTS |= {c: c.upper() for c in "xyz"}
_TRIPLES = (("R", "G", "B"), ("X", "Y", "Z"))


@dataclass
class Layer:
    """The channels of one layer of one view. They may lie in several parts."""

    name: str
    """Empty for plain R, G, B."""
    view: str
    """Such as ``left``; empty in a file without views."""
    channels: dict[str, Channel] = field(default_factory=dict)
    """By component: ``R``, ``G``, ``B``, ``A``, ``X``, ``Y``, ``Z``, or else the last part of the stored name."""

    def triple(self) -> tuple[Channel, ...] | None:
        """Return the channels R, G, B or X, Y, Z; None if one is missing or holds integers: ids are no light."""
        for names in _TRIPLES:
            channels = tuple(self.channels[n] for n in names if n in self.channels)
            if len(channels) == 3 and all(channel.type != "uint" for channel in channels):
                return channels
        return None

    def scalar(self) -> tuple[Channel, ...] | None:
        """Return the only channel as a tuple of one; None if the layer has several, or if it holds integers."""
        channels = tuple(self.channels.values())
        return channels if len(channels) == 1 and channels[0].type != "uint" else None


def layers_of(file: ExrFile, *, deep: bool = False) -> list[Layer]:
    """Group a file's channels into layers, in file order: those of flat parts, or with ``deep`` of all parts.

    Renderers name layers in three ways. OpenEXR's rule puts the layer in front of the channel's name
    (``diffuse.R``). Karma and Nuke name only the part after it. Blender 5 writes the two. So the prefix of the channel
    names the layer, or else the part's name does. In a file of one part, the part's name says nothing about layers.

    If two channels have the same view, layer and component (``foo.R`` and ``foo.red``), the layer holds the first.
    """
    views = views_of(file)
    layers: dict[tuple[str, str], Layer] = {}
    for part in file.parts:
        for channel in () if part.deep and not deep else part.channels:
            view, name, component = _split_name(channel.name, part, views, several=len(file.parts) > 1)
            layer = layers.setdefault((view, name), Layer(name, view))
            layer.channels.setdefault(component, channel)
    return list(layers.values())


def layer_by_channel(file: ExrFile, *, deep: bool = False) -> dict[Channel, Layer]:
    """Map every channel that is in one of :func:`layers_of` to its layer."""
    return {channel: layer for layer in layers_of(file, deep=deep) for channel in layer.channels.values()}


def same_spelling(name: str) -> str:
    """Return a name without what programs spell differently: case, spaces, ``_`` and ``-``."""
    return re.sub(r"[ _-]", "", name).lower()


def matches_layer(pattern: str, name: str, component: str = "") -> bool:
    """Return whether a pattern such as ``crypto*`` means a layer, or a channel of it.

    Case, spaces, ``_`` and ``-`` make no difference. The pattern may leave out the view layer or part in front of the
    name: ``crypto*`` means ``ViewLayer.CryptoObject00``.

    Args:
        pattern: text with ``*`` for any text, ``?`` for any character. A bracket is one, as in ``lights[0]``.
        name: the layer's name, perhaps with a part's or a view layer's in front.
        component: the channel's own name, such as ``R``; the pattern may name it behind the layer.
    """
    wanted, words = same_spelling(pattern).replace("[", "[[]"), same_spelling(name).split(".")
    ends = [".".join(words[start:]) for start in range(len(words))]
    return any(fnmatchcase(end, wanted) or fnmatchcase(f"{end}.{same_spelling(component)}", wanted) for end in ends)


def views_of(file: ExrFile) -> list[str]:
    """Return the views of OpenEXR's ``multiView`` attribute, the default view first."""
    views = file.metadata.get("multiView") or ()
    return [views] if isinstance(views, str) else [str(view) for view in views]


def _split_name(name: str, part: Part, views: list[str], *, several: bool) -> tuple[str, str, str]:
    """Return view, layer and component of a channel, in a file of one part or of several."""
    prefix, _, component = name.rpartition(".")
    view = part.view or (views[0] if views else "")
    # In a multiView file, and perhaps in a part of one view, the view may stand in the name: diffuse.left.R. Nuke puts
    # it in front: left.diffuse.R.
    words = prefix.split(".")
    for place in (-1, 0):
        if words[place] and words[place] in (*views, part.view):
            view = words.pop(place)
            break
    return (
        view,
        ".".join(words) or (_part_layer(part) if several else ""),
        _COMPONENTS.get(component.lower(), component),
    )


def _part_layer(part: Part) -> str:
    """Return the layer that a part's name means, without its view; empty for names such as ``rgba``."""
    view = re.escape(part.view)
    name = re.sub(rf"(^|[._ -]){view}$|^{view}[._ -]", "", part.name) if view else part.name
    # Without a separator, only a plain name may be left: a view "l" is not part of "normal".
    joined = part.name.removesuffix(part.view)
    return "" if _PLAIN_PART.fullmatch(name) or _PLAIN_PART.fullmatch(joined) else name
