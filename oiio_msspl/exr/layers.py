# SPDX-License-Identifier: Apache-2.0
"""From what a renderer calls its layers to the features of :mod:`oiio_msspl.aovs.features`.

The knowledge is data (``aovs.toml``); this module matches it against the layers of a file, and reads features in the
units of the schema: composites by the paper's equations, variances brought to the variance of the pixel's mean
luminance, normals to signed vectors. Whatever it chose is kept as text for the user.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from oiio_msspl.exr.reader import Channel, ExrFile

#: Part names that say nothing about a layer: their channels without a prefix are plain R, G, B.
_PLAIN_PART = re.compile(r"(rgba?|main|default|image|part ?\d+|subimage ?\d+)?", re.IGNORECASE)
_COMPONENTS = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B", "a": "A", "alpha": "A"}
_COMPONENTS |= {c: c.upper() for c in "xyz"}
_TRIPLES = (("R", "G", "B"), ("X", "Y", "Z"))


@dataclass
class Layer:
    """Channels that belong together: one layer of one view, whatever parts they lie in."""

    name: str
    view: str
    channels: dict[str, Channel] = field(default_factory=dict)
    """By component: ``R``, ``G``, ``B``, ``A``, ``X``, ... or the stored name where it is none of these."""

    def triple(self) -> tuple[Channel, ...] | None:
        for names in _TRIPLES:
            if all(n in self.channels for n in names):
                return tuple(self.channels[n] for n in names)
        return None

    def scalar(self) -> tuple[Channel, ...] | None:
        return tuple(self.channels.values()) if len(self.channels) == 1 else None


# ---------------------------------------------------------------------------------------------- layers of a file


def layers_of(file: ExrFile) -> list[Layer]:
    """Group a file's channels into layers, in file order.

    OpenEXR's rule is that the layer comes from the channel's name; Karma and Nuke put it in the part's name alone;
    Blender 5 writes both. So: the channel's prefix where there is one, the part's name otherwise, without the view.
    """
    multi_view = file.metadata.get("multiView") or ()
    views = [str(v) for v in multi_view] if not isinstance(multi_view, str) else [multi_view]
    layers: dict[tuple[str, str], Layer] = {}
    for part in file.parts:
        for channel in part.channels:
            prefix, _, component = channel.name.rpartition(".")
            view = part.view or (views[0] if views else "")
            if views and prefix.rpartition(".")[2] in views:
                prefix, _, view = prefix.rpartition(".")
            name = prefix or _part_layer(part.name, part.view)
            layer = layers.setdefault((view, name), Layer(name, view))
            layer.channels.setdefault(_COMPONENTS.get(component.lower(), component), channel)
    return list(layers.values())


def _part_layer(name: str, view: str) -> str:
    if view:
        name = re.sub(rf"[._ -]?{re.escape(view)}$", "", name)
    return "" if _PLAIN_PART.fullmatch(name) else name
