# SPDX-License-Identifier: Apache-2.0
"""The light of the layers of one render, which is decoded once for all that needs it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, LIGHT_OF, NORMAL, RGB
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapped_render import MappedRender, ReadableRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.image.arrays import has_many_pixels

#: Channels of a colour that light is multiplied by.
Factor = tuple[Channel, ...]
#: Rows of an image that are looked at together.
ROWS = 128


@dataclass(frozen=True)
class LayerLight:
    """The light of the layers of a render, as features of :attr:`pixels`."""

    file: MappedRender
    """Has the features of :func:`with_light`."""
    names: Mapping[AdditiveLayer, str]
    """Names of features, by layer."""
    pixels: ReadableRender
    """Where the features are read: all are decoded, or each read decodes what it needs."""


def light_of(
    render: MappedRender,
    names: Mapping[AdditiveLayer, str],
    *,
    decode: bool = False,
    decoded: ReadableRender | None = None,
) -> LayerLight:
    """Return the light of layers of a render.

    Args:
        decode: whether all pixels are decoded now, once: into temporary files if there are many.
        decoded: the render, perhaps in memory. It is used if it has the features of :func:`with_light`.
    """
    file = with_light(render, names)
    needed = [RGB, ALBEDO, NORMAL, *names.values(), *colours_of(names).values()]
    if isinstance(decoded, Render) and decoded.layers.keys() >= file.features.keys() & {*needed}:
        return LayerLight(file, names, decoded)
    return LayerLight(file, names, file.load(needed, on_disk=is_large(file)) if decode else file)


def with_light(render: MappedRender, names: Mapping[AdditiveLayer, str]) -> MappedRender:
    """Return a render with the light of layers, and the colours that it is multiplied by, as further features."""
    light = {name: layer.formula for layer, name in names.items()}
    colours = {name: FeatureFormula((factor,)) for factor, name in colours_of(names).items()}
    return replace(render, features=render.features | light | colours)


def colours_of(names: Iterable[AdditiveLayer]) -> dict[Factor, str]:
    """Return names, as features, of the colours by which layers are multiplied."""
    factors = dict.fromkeys(layer.factor for layer in names if layer.factor is not None)
    return {factor: f"colour {i}" for i, factor in enumerate(factors)}


def is_large(render: MappedRender) -> bool:
    """Return whether a render has many pixels."""
    return has_many_pixels(render.data_window.height, render.data_window.width)


def layer_names(sets: Sequence[AdditiveSet]) -> dict[AdditiveLayer, str]:
    """Return names, as features, of the light of all layers of sets, and then of their coarser layers.

    Frames of a shot have the same names.
    """
    layers = [layer for additive_set in sets for layer in additive_set.layers]
    coarser = [layer for additive_set in sets for layer in additive_set.coarser]
    names: dict[AdditiveLayer, str] = {}
    for layer in dict.fromkeys([*layers, *coarser]):
        name = f"{LIGHT_OF}{layer.name}{' x colour' if layer.factor else ''}"
        while name in names.values():
            name += " again"
        names[layer] = name
    return names


def same_layers(render: MappedRender, additive_set: AdditiveSet) -> dict[AdditiveLayer, AdditiveLayer]:
    """Return layers of a set, each with the layer of the same name in another render: of the set that has most."""
    by_name = {(layer.name, layer.factor is None): layer for layer in additive_set.layers}
    matches = (
        {by_name[key]: layer for layer in candidate.layers if (key := (layer.name, layer.factor is None)) in by_name}
        for candidate in render.additive_sets
    )
    return max(matches, key=len, default={})


def lrhs_names(lr: MappedRender, sets: Sequence[AdditiveSet]) -> dict[AdditiveLayer, str]:
    """Return the names that the layers of an LRHS have as features: those of the same layers of the HRLS."""
    names = layer_names(sets)
    matches = {layer: match for additive_set in sets for layer, match in same_layers(lr, additive_set).items()}
    return {match: names[layer] for layer, match in matches.items()}


def pass_features(lr: MappedRender, hr: MappedRender, sets: Sequence[AdditiveSet]) -> tuple[MappedRender, MappedRender]:
    """Return LRHS and HRLS with the features of :func:`with_light` for additive sets; the LRHS may lack layers."""
    high = with_light(hr, layer_names(sets))
    return high if lr is hr else with_light(lr, lrhs_names(lr, sets)), high


def is_black(render: ReadableRender, name: str, area: Window | None = None) -> bool:
    """Return whether a feature of a decoded render has no light in an area of the display window, or anywhere."""
    if not isinstance(render, Render):
        return False
    window = render.data_window
    if area is not None:
        window = area.shift(render.display_window.x0, render.display_window.y0).intersect(window)
    return not any(np.any(pixels) for part in window.bands(ROWS) for pixels in render.read(part, [name]).values())
