# SPDX-License-Identifier: Apache-2.0
"""Finds the layers about the motion of surfaces: motion vectors and position.

The table of renderers names the layers, and the format in which a renderer usually writes its vectors. Manuals leave
too much open to believe that format: :mod:`oiio_msspl.fusion.motion.source` verifies it on two frames of the shot.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any

from oiio_msspl.aovs.renderers import known_as_other, renderers, view_layer_of
from oiio_msspl.aovs.views import Beauty
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, same_spelling
from oiio_msspl.exr.reader import Channel

#: The values that each word of a format may have.
CHOICES = {
    "to": ("next", "previous"),
    "x": ("right", "left"),
    "y": ("down", "up"),
    "unit": ("pixels", "ndc", "screen", "width"),
}
#: Channels of a vector, where the entry of the table does not name them.
_PAIRS = (("R", "G"), ("X", "Y"), ("u", "v"), ("U", "V"))
#: The most layers of unknown names that the pixels are asked about: each takes a second.
MOST_GUESSES = 8


@dataclass(frozen=True)
class MotionFormat:
    """How two channels say where a surface is in another frame.

    ``(stored - offset) * scale``, in a unit and along two axes, is the way from the pixel to the surface's place there.
    """

    to: str = "next"
    """The other frame: ``next`` or ``previous``."""
    x: str = "right"
    """Where positive values of the first channel point: ``right`` or ``left``."""
    y: str = "down"
    """Where positive values of the second channel point: ``down`` or ``up``."""
    unit: str = "pixels"
    """``pixels``; ``ndc`` (1 is the width of the frame in x and its height in y); ``screen`` (the frame spans -1 to 1);
    ``width`` (1 is the width of the frame, in both axes)."""
    scale: float = 1.0
    """Such as 2 where a shutter of 180 degrees has halved the vectors."""
    offset: float = 0.0
    """The stored value of no motion: 0.5 where vectors are encoded as colours."""
    premultiplied: bool = False
    """Vectors are multiplied by alpha."""

    @property
    def hop(self) -> int:
        """1 for the next frame, -1 for the previous one."""
        return 1 if self.to == "next" else -1

    def pixels_per_unit(self, width: int, height: int) -> tuple[float, float]:
        """Return how many pixels to the right and down a stored 1 means in a frame of this size, without the offset."""
        x, y = {
            "pixels": (1.0, 1.0),
            "ndc": (float(width), float(height)),
            "screen": (width / 2, height / 2),
            "width": (float(width), float(width)),
        }[self.unit]
        return (x if self.x == "right" else -x) * self.scale, (y if self.y == "down" else -y) * self.scale

    def __str__(self) -> str:
        """Return the words that the user may write behind ``layer=NAME,``."""
        words = [f"to={self.to}", f"x={self.x}", f"y={self.y}", f"unit={self.unit}"]
        words += [f"scale={self.scale:g}"] if self.scale != 1 else []
        words += [f"offset={self.offset:g}"] if self.offset else []
        return ",".join(words + (["premultiplied"] if self.premultiplied else []))


@dataclass(frozen=True)
class MotionField:
    """Two channels that hold motion vectors."""

    layer: str
    """Name of the layer, without the view layer in front."""
    components: tuple[str, str]
    """Such as ``X`` and ``Y``."""
    channels: tuple[Channel, Channel]
    format: MotionFormat
    """The expected format; nothing has verified it yet."""
    fixed: frozenset[str] = frozenset()
    """The words of the format that the user has given."""

    @property
    def name(self) -> str:
        """For the user, such as ``Vector.XY``."""
        return f"{self.layer}.{''.join(self.components)}"


@dataclass(frozen=True)
class MotionLayers:
    """The layers of one view and view layer that tell the motion and the place of surfaces."""

    fields: tuple[MotionField, ...] = ()
    """Motion vectors, in the order of the table."""
    guesses: tuple[MotionField, ...] = ()
    """Layers of two or three channels of which nothing is known: the pixels may tell that they are vectors."""
    position: tuple[Channel, ...] | None = None
    """World-space position of the surface, X, Y, Z."""
    layers: Mapping[str, Layer] = field(default_factory=dict, repr=False)
    """All layers of the view and view layer, by name without the view layer."""

    def channels(self, layer: str, components: tuple[str, str]) -> tuple[Channel, Channel] | None:
        """Return the channels of a vector that was found in another frame; None if this frame lacks them."""
        channels = self.layers[layer].channels if layer in self.layers else {}
        x, y = (channels.get(component) for component in components)
        return (x, y) if x and y else None


def find_motion_layers(
    renderer: Mapping[str, Any], layers: Sequence[Layer], beauty: Beauty, read: Collection[Channel] = ()
) -> MotionLayers:
    """Find the layers of motion vectors and position in the view and view layer of a beauty.

    The names of the renderer are tried before those that are common to all. The channels ``read`` hold something else.
    """
    named = {name: layer for name, layer in beauty.layers_of_view(layers) if name}
    common = renderers()[-1]
    vectors: dict[tuple[Channel, Channel], MotionField] = {}
    for entry in [*renderer.get("motion", ()), *common["motion"]]:
        words = {key: value for key, value in entry.items() if key not in ("layer", "channels")}
        for vector in _vectors_in(_named(named, entry["layer"]), entry.get("channels"), MotionFormat(**words)):
            vectors.setdefault(vector.channels, vector)
    positions = (_named(named, alias) for alias in [*renderer.get("position", ()), *common["position"]])
    return MotionLayers(
        tuple(vectors.values()),
        tuple(_guesses(named, known_as_other(renderer), read)),
        next((triple for _, layer in filter(None, positions) if (triple := layer.triple())), None),
        named,
    )


def _guesses(
    named: Mapping[str, Layer], is_known: Callable[[str], bool], read: Collection[Channel]
) -> list[MotionField]:
    """Return the layers of two or three channels that are neither known nor read, those of two channels first."""
    unknown = {name: layer for name, layer in named.items() if len(layer.channels) in (2, 3) and not is_known(name)}
    unread = [name for name, layer in unknown.items() if not set(read).intersection(layer.channels.values())]
    unread.sort(key=lambda name: len(named[name].channels))
    return [field for name in unread for field in _vectors_in((name, named[name]))][:MOST_GUESSES]


def user_fields(layers: MotionLayers, text: str, path: str = "") -> list[MotionField]:
    """Find the motion vectors that the user's ``--motion-format`` describes.

    Args:
        layers: those of the file ``path``.
        text: ``layer=NAME`` and any of ``channels=XY``, ``to=``, ``x=``, ``y=``, ``unit=``, ``scale=``, ``offset=`` and
            ``premultiplied``, separated by commas. Further layers follow behind ``+``. The pixels decide words that are
            left out.
    """
    described = []
    for words in read_format(text):
        layer = words.pop("layer")
        letters = words.pop("channels", "")
        # Words that the user leaves out keep the values of the table, as long as the pixels agree.
        named = _named(layers.layers, layer)
        in_table = [f for f in layers.fields if named and f.layer == named[0]]
        matching = [f for f in in_table if not letters or "".join(f.components) == letters]
        matching = matching or _vectors_in(named, letters)
        # A layer may hold vectors to both frames, in different channels.
        matching = [f for f in matching if f.format.to == words.get("to", f.format.to)] or matching
        if not matching:
            raise InputError(
                f"--motion-format {text!r}: {path} has no layer {layer!r} with two channels {letters}".strip()
            )
        described += [replace(f, format=replace(f.format, **words), fixed=frozenset(words)) for f in matching]
    return described


def read_format(text: str) -> list[dict[str, Any]]:
    """Read a ``--motion-format``, see :func:`user_fields`: the words of each layer."""
    layers: list[dict[str, Any]] = []
    for part in re.split(r"\+(?=layer=)", text.strip()):
        layers.append(words := {})
        for word in part.split(","):
            key, equals, value = (piece.strip() for piece in word.partition("="))
            if problem := f"{key} is given twice" if key in words else _problem_of_word(key, equals, value):
                example = "an example is layer=velocity,to=next,y=up,scale=2"
                raise InputError(f"--motion-format {text!r}: {problem}; {example}")
            words[key] = True if key == "premultiplied" else float(value) if key in ("scale", "offset") else value
        if "layer" not in words:
            raise InputError(f"--motion-format {text!r}: starts with layer=NAME")
    return layers


def _problem_of_word(key: str, equals: str, value: str) -> str:
    """Return why a word of a format can't be read; nothing if it can."""
    keys = ["layer", "channels", *(f.name for f in fields(MotionFormat))]
    if key not in keys:
        return f"{key!r} is none of {', '.join(keys)}"
    if key in CHOICES:
        return "" if value in CHOICES[key] else f"{key} is {' or '.join(CHOICES[key])}"
    if key in ("scale", "offset"):
        with suppress(ValueError):
            if math.isfinite(float(value)) and (key == "offset" or float(value)):
                return ""
        return f"{key} is a number" + (", but not 0" if key == "scale" else "")
    if key == "channels":
        return "" if len(value) == 2 else "channels are two letters, such as XY"
    if key == "premultiplied":
        return "premultiplied stands alone; leave it out if they are not" if equals else ""
    return "" if equals and value else f"write {key}=..."


def _named(layers: Mapping[str, Layer], alias: str) -> tuple[str, Layer] | None:
    """Return the layer that an alias means, and its short name."""
    meant = [name for name in layers if view_layer_of(name, alias) == "" or same_spelling(name) == same_spelling(alias)]
    name = min(meant, key=lambda name: name != alias, default=None)
    return None if name is None else (name, layers[name])


def _vectors_in(
    named: tuple[str, Layer] | None, components: Sequence[str] | None = None, form: MotionFormat | None = None
) -> list[MotionField]:
    """Return the vectors of a layer, if there is one, in these channels or in the first usual ones: one or none."""
    name, layer = named or ("", Layer("", ""))
    for pair in [tuple(components)] if components else _PAIRS:
        channels = [layer.channels[c] for c in pair if c in layer.channels]
        if len(channels) == 2 and all(c.type != "uint" for c in channels) and channels[0].part == channels[1].part:
            return [MotionField(name, (pair[0], pair[1]), (channels[0], channels[1]), form or MotionFormat())]
    return []
