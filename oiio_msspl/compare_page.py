# SPDX-License-Identifier: Apache-2.0
"""Write a page for the browser that shows pictures with all their layers: ``msspl compare --html``.

The page is one file: ``compare_page.html`` with the pixels in it. It asks the network for nothing.

**Pixels** are stored as codes, the logarithm of the light in steps of 1.1 %::

    code = round(64 * (log2(x + 2**-12) + 12))         x = 2**(code / 64 - 12) - 2**-12

So a step is about as large as one of an 8-bit sRGB picture near white, and smaller elsewhere, at any exposure. Three
planes of codes are stored: green, red minus green, blue minus green. The noise of a render is mostly brightness, so the
differences are nearly free of it and take little space. Each code is stored as the difference to its left neighbour,
with the sign as the lowest bit: the low bytes of all, then the high bytes, in zlib's format and base64.

PNGs would not be safer: browsers that protect against tracking change the pixels that a page reads from a picture.
"""

from __future__ import annotations

import base64
import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.compare import Comparison, error_colours, error_levels, in_space_of, upsampled_like
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.exr.layers import Layer, layers_of, matches_layer, same_spelling
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import HALF_MAX, Array, repair
from oiio_msspl.image.colour import REC709, converted, space_of
from oiio_msspl.image.metrics import psnr, relmse

TEMPLATE = "compare_page.html"
#: The comment of the template that the data replace.
DATA = "<!-- data -->"

#: Codes for a factor of two.
CODES_PER_STOP = 64
#: Stops from 1 down to the light below which steps stop shrinking. At an exposure of +4 stops, the step in black is a
#: seventh of a step of an 8-bit picture.
STOPS_BELOW_ONE = 12
#: Colours of an error map.
ERROR_LEVELS = 64
#: Fraction of the values of a data layer, such as depth, that is clipped at black, and at white.
_CLIPPED = 0.005

BEAUTY = "beauty"

Codes = NDArray[np.int16]


@dataclass(frozen=True)
class _Layer:
    """A layer of one picture."""

    name: str
    formula: FeatureFormula
    is_colour: bool
    """False for data, such as depth or normals: shown from their lowest to their highest value."""
    additive: str = ""
    """Name of the additive set that holds the layer."""
    stored: str = ""
    """Name in the file."""

    def matches(self, pattern: str) -> bool:
        """Return whether a pattern such as ``light*`` means the layer or its set."""
        return any(matches_layer(pattern, name) for name in (self.name, self.stored, self.additive) if name)


@dataclass(frozen=True)
class _Picture:
    """A file on the page."""

    render: MappedRender
    layers: dict[str, _Layer]
    """All layers of the file, by :func:`oiio_msspl.exr.layers.same_spelling` of their names."""
    window: Window
    """The part of the data window that is shown."""

    def read(self, key: str) -> Array:
        """Read a layer, (height, width, 3 or 1); colours have no NaN, infinities and negative values."""
        layer = self.layers[key]
        features = {RGB: self.render.features[RGB], key: layer.formula}
        values = replace(self.render, features=features, alpha=None).read(self.window, [key])[key]
        return repair(values)[0] if layer.is_colour else values


def check_layers(comparison: Comparison, layers: Sequence[str]) -> None:
    """Raise InputError if no file has a layer of a pattern, by the headers alone."""
    _chosen(list(map(_picture, comparison.renders, comparison.windows)), layers)


def write_page(
    path: Path,
    comparison: Comparison,
    *,
    layers: Sequence[str] = (),
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[int, list[str]]:
    """Write a page that shows images, their reference, and their errors.

    Args:
        comparison: the images, and perhaps a reference. Without it, scores and error maps are left out. A smaller image
            is shown with large pixels, and upsampled bicubically for scores and error maps.
        layers: patterns of the layers to show beside the beauty. Without any, those that sum to the beauty are shown.
        progress: called with the number of layers done and of all.

    Returns:
        Bytes of the file, and names of the layers on the page.

    Raises:
        InputError: a file can't be read, no file has a layer of a pattern, or ``path`` exists.
        MssplError: the page can't be written.
    """
    pictures = list(map(_picture, comparison.renders, comparison.windows))
    largest, has_reference = pictures[comparison.largest], comparison.has_reference
    keys = _chosen(pictures, layers)
    head, tail = resources.files("oiio_msspl").joinpath(TEMPLATE).read_text(encoding="utf-8").split(DATA)
    with replacing(path, overwrite=overwrite) as temporary:
        with open(temporary, "w", encoding="utf-8", newline="\n") as out:
            out.write(head)
            shown = []
            for done, key in enumerate(keys):
                progress(done, len(keys))
                shown.append(_write_layer(out, done, key, pictures, largest if has_reference else None))
            manifest = _manifest(pictures, largest, has_reference, shown)
            # A name may hold "</script>"; JSON may write any character as an escape.
            text = json.dumps(manifest, allow_nan=False).replace("<", "\\u003c")
            out.write(f'<script type="application/json" id="manifest">{text}</script>')
            out.write(tail)
        return temporary.stat().st_size, [layer["name"] for layer in shown]


def _picture(render: MappedRender, window: Window) -> _Picture:
    beauty = render.features[RGB]
    layers = {BEAUTY: _Layer(BEAUTY, beauty, True, stored=beauty.text)}
    shown = set(beauty.terms)
    for additive in render.additive_sets:
        for light in additive.layers:
            layer = _Layer(light.label, light.formula, True, additive.name, light.name)
            layers.setdefault(same_spelling(light.label), layer)
            shown.add(light.channels)
    views = render.view.split("/")
    for stored in layers_of(render.file):
        # Cryptomattes hold numbers of objects: their pictures tell nothing.
        if "crypto" in stored.name.lower() or (stored.view and stored.view not in views):
            continue
        name = next((stored.name.removeprefix(f"{v}.") for v in views if stored.name.startswith(f"{v}.")), stored.name)
        for channels, component in _groups(stored):
            if channels not in shown and all(channel.type != "uint" for channel in channels):
                label = ".".join(filter(None, (name, component))) or "RGB"
                is_colour = len(channels) == 3 and channels[0] is stored.channels.get("R")
                layer = _Layer(label, FeatureFormula((channels,), text=label), is_colour, stored=stored.name)
                layers.setdefault(same_spelling(label), layer)
    return _Picture(render, layers, window)


def _groups(layer: Layer) -> Iterator[tuple[tuple[Channel, ...], str]]:
    """Yield the channels of a layer that make a picture, three or one, with their component's name."""
    if triple := layer.triple() or ():
        yield triple, ""
    for component, channel in layer.channels.items():
        if channel not in triple and (component != "A" or len(layer.channels) == 1):
            yield (channel,), component if len(layer.channels) > 1 else ""


def _chosen(pictures: Sequence[_Picture], patterns: Sequence[str]) -> list[str]:
    """Return the keys of the layers to show: the beauty, and those of the patterns, or else of additive sets."""
    keys = dict.fromkeys(key for picture in pictures for key in picture.layers)
    candidates = {key: [picture.layers[key] for picture in pictures if key in picture.layers] for key in keys}
    if not patterns:
        return [key for key, layers in candidates.items() if key == BEAUTY or any(layer.additive for layer in layers)]
    chosen = {BEAUTY}
    for pattern in patterns:
        matches = {key for key, layers in candidates.items() if any(layer.matches(pattern) for layer in layers)}
        if not matches:
            names = ", ".join(layers[0].name for layers in candidates.values())
            raise InputError(f"--layers {pattern!r}: no image has such a layer; they have: {names}")
        chosen |= matches
    return [key for key in candidates if key in chosen]


def _write_layer(
    out: TextIO, index: int, key: str, pictures: Sequence[_Picture], reference: _Picture | None
) -> dict[str, Any]:
    """Write the codes of a layer's pictures and error maps, and return the layer's entry in the manifest."""
    holders = [(place, picture) for place, picture in enumerate(pictures) if key in picture.layers]
    first = holders[0][1].layers[key]
    is_scored = first.is_colour and reference and key in reference.layers and reference.layers[key].is_colour
    truth = reference.read(key) if reference and is_scored else None
    value_range: tuple[float, float] | None = None
    images: dict[int, Any] = {}
    errors: dict[int, Any] = {}
    for place, picture in holders:
        values = picture.read(key)
        if picture.layers[key].is_colour:
            shown = _to_rec709(values, picture, pictures)
        else:
            black, white = value_range = value_range or _range_of(values)
            shown = np.nan_to_num((values - black) / (white - black))
        images[place] = _write_codes(out, f"image-{index}-{place}", to_codes(shown))
        if truth is not None and reference and picture is not reference and picture.layers[key].is_colour:
            image = upsampled_like(in_space_of(values, picture.render, reference.render), truth)
            decibels = psnr(image, truth)
            images[place] |= {"psnr": decibels if math.isfinite(decibels) else None, "relmse": relmse(image, truth)}
            levels = np.round(error_levels(image, truth) * (ERROR_LEVELS - 1)).astype(np.int16)
            errors[place] = _write_codes(out, f"error-{index}-{place}", levels[..., None])
    return {"name": first.name, "range": value_range, "scored": truth is not None, "images": images, "errors": errors}


def _range_of(values: Array) -> tuple[float, float]:
    """Return the values of a data layer that are shown as black and as white."""
    # A depth may be infinite, or the largest half, in the sky.
    finite = values[np.isfinite(values) & (np.abs(values) < HALF_MAX)]
    if not finite.size:
        return 0.0, 1.0
    lowest, highest = (float(v) for v in np.quantile(finite, (_CLIPPED, 1 - _CLIPPED)))
    return lowest, highest if highest > lowest else lowest + 1


def _to_rec709(values: Array, picture: _Picture, pictures: Sequence[_Picture]) -> Array:
    """Convert colours to Rec. 709 primaries. A file that declares no space has that of the first one that does."""
    spaces = [space_of(file.render.metadata) for file in (picture, *pictures)]
    space = next(filter(None, spaces), REC709)
    return values if values.shape[-1] == 1 else converted(values, space, REC709)


def to_codes(values: Array) -> Codes:
    """Encode light, see the head of this module. Negative values and NaN become 0, infinities the largest half.

    The light that a code stands for is off by at most 0.55 % of ``x + 2**-12``.
    """
    stops = np.log2(repair(values)[0] + np.float32(2**-STOPS_BELOW_ONE)) + STOPS_BELOW_ONE
    return np.round(CODES_PER_STOP * stops).astype(np.int16)


def pack(codes: Codes) -> bytes:
    """Compress codes (height, width, 1 or 3), see the head of this module."""
    planes = np.moveaxis(codes, -1, 0)
    if len(planes) == 3:
        planes = np.stack([planes[1], planes[0] - planes[1], planes[2] - planes[1]])
    differences = np.diff(planes, axis=-1, prepend=np.int16(0))
    unsigned = ((differences << 1) ^ (differences >> 15)).view(np.uint16)
    low, high = (unsigned & 255).astype(np.uint8), (unsigned >> 8).astype(np.uint8)
    # In noise, short repetitions are chance. This strategy ignores them, which saves 4 %.
    compressor = zlib.compressobj(strategy=zlib.Z_FILTERED)
    return compressor.compress(low.tobytes()) + compressor.compress(high.tobytes()) + compressor.flush()


def _write_codes(out: TextIO, name: str, codes: Codes) -> dict[str, Any]:
    """Write codes (height, width, channels) as an element of the page, and return how the manifest describes it."""
    out.write(f'<script type="text/plain" id="{name}">{base64.b64encode(pack(codes)).decode()}</script>\n')
    height, width, channels = codes.shape
    return {"id": name, "width": width, "height": height, "channels": channels}


def _manifest(
    pictures: Sequence[_Picture], largest: _Picture, has_reference: bool, layers: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Describe the pictures and layers for the page's script."""
    colours = error_colours(np.linspace(0, 1, ERROR_LEVELS, dtype=np.float32)[None])[0]
    paths = [picture.render.file.path.absolute() for picture in pictures]
    names, common = [path.name for path in paths], os.path.commonpath([path.parent for path in paths])
    return {
        "height": largest.window.height,
        "width": largest.window.width,
        "pixelAspect": largest.render.pixel_aspect,
        "codesPerStop": CODES_PER_STOP,
        "stopsBelowOne": STOPS_BELOW_ONE,
        "errorColours": np.round(colours * 255).astype(int).tolist(),
        # Where two have one name, the paths below their common folder: others need not know where the files lie.
        "pictures": [p.name if names.count(p.name) == 1 else p.relative_to(common).as_posix() for p in paths],
        "reference": len(pictures) - 1 if has_reference else None,
        "layers": list(layers),
    }
