# SPDX-License-Identifier: Apache-2.0
"""Additive sets: layers of a file that sum to its beauty, such as light groups.

The table of renderers and the user's ``--sum`` name candidates. Whether a candidate really sums to the beauty is
measured by :mod:`oiio_msspl.fusion.passes.sums`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from typing import Any

from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.renderers import entry_of, names_of_aov, renderers, view_layer_of
from oiio_msspl.aovs.views import Beauty
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, matches_layer
from oiio_msspl.exr.reader import Channel, ExrFile

#: The words of a layer's name, also where a renderer writes them together (``directdiffuse``).
_WORD = re.compile(r"indirect|direct|combined|rgba|(?:(?!indirect|direct|combined|rgba)[^ _.-])+")
#: The name of a set with a layer for each lamp.
LIGHT_GROUPS = "light groups"
#: Words that mean all light.
_ALL_LIGHT = frozenset({"rgba", "c", "combined"})


@dataclass(frozen=True)
class AdditiveLayer:
    """A layer, or a layer times another one, that is a share of the beauty."""

    name: str
    """As stored, without the view layer in front."""
    channels: tuple[Channel, ...]
    """R, G, B."""
    factor: tuple[Channel, ...] | None = None
    """R, G, B of the layer that it is multiplied by: Cycles' light passes leave the surface colour out."""

    @property
    def label(self) -> str:
        """Name for the user."""
        return f"{self.name} x colour" if self.factor else self.name

    @property
    def words(self) -> frozenset[str]:
        """The kinds of light in its name: ``diffuse`` and ``key`` for ``diffuse_key``."""
        return frozenset(_WORD.findall(self.name.lower())) - _ALL_LIGHT

    @property
    def formula(self) -> FeatureFormula:
        """The light of this layer."""
        return FeatureFormula((self.channels,), self.factor, text=self.name)


@dataclass(frozen=True)
class AdditiveSet:
    """Layers that may sum to the beauty."""

    name: str
    """Such as ``light groups``."""
    layers: tuple[AdditiveLayer, ...]
    coarser: tuple[AdditiveLayer, ...] = ()
    """Layers that by their names are sums of some of ``layers``."""
    by_user: bool = False
    """The user has named it, so it must be usable."""

    @property
    def layer_names(self) -> str:
        """Its layers, for the user."""
        names = ", ".join(layer.label for layer in self.layers)
        return names + (f"; sums of these: {', '.join(layer.name for layer in self.coarser)}" if self.coarser else "")

    def matches(self, pattern: str) -> bool:
        """Whether a pattern such as ``light*`` means this set or one of its layers."""
        return any(matches_layer(pattern, name) for name in (self.name, *(layer.name for layer in self.layers)))


def find_additive_sets(
    renderer: Mapping[str, Any],
    layers: Sequence[Layer],
    beauty: Beauty,
    sums: Sequence[str] = (),
    file: ExrFile | None = None,
) -> list[AdditiveSet]:
    """Find the candidates of a file: those of the user, of its renderer, and then of names that any program may use.

    The first set of a name counts.

    They are searched in the view and view layer of ``beauty``, which they should sum to. The header of ``file`` may
    name layers.
    """
    finder = _Finder(layers, beauty, partial(names_of_aov, renderer, file) if file else lambda alias: [alias])
    sets = [_user_set(finder, text, str(file.path) if file else "") for text in sums]
    names = [additive.name for additive in sets]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"--sum: two sets are called {twice[0]!r}; give each a name of its own")
    generic = renderers()[-1]
    for entry in [*renderer.get("sets", ()), *(generic["sets"] if renderer is not generic else ())]:
        if any(entry["name"] == additive.name for additive in sets):
            continue
        lights = list(dict.fromkeys(light for candidate in entry["layers"] for light in finder.find(candidate)))
        unwanted = entry.get("except", ())
        lights = [light for light in lights if not any(fnmatchcase(light.name.lower(), p) for p in unwanted)]
        coarser = [a for a in lights if entry.get("finest") and any(a.words < b.words for b in lights)]
        finest = tuple(light for light in lights if light not in coarser)
        # A part of another set of the table says nothing new, such as raw components of a file without raw layers.
        is_known = any(
            set(finest) == set(additive.layers) or (set(finest) < set(additive.layers) and not additive.by_user)
            for additive in sets
        )
        if len(finest) > 1 and not is_known:
            sets.append(AdditiveSet(entry["name"], finest, tuple(coarser)))
    return sets


class _Finder:
    """Finder of the layers of one view and view layer that hold light."""

    def __init__(self, layers: Sequence[Layer], beauty: Beauty, names_of: Callable[[str], list[str]]) -> None:
        self._beauty, self._names_of = beauty, names_of
        named = beauty.layers_of_view(layers)
        self.layers = [(n, layer) for n, layer in named if layer.triple() and layer is not beauty.layer]

    def find(self, candidate: str | Mapping[str, str]) -> Iterator[AdditiveLayer]:
        """Yield the layers that an entry of the table means; none if a factor is missing."""
        entry = entry_of(candidate)
        factors = [layer.triple() for _, layer in self._named(entry["times"])] if "times" in entry else [None]
        for name, layer in self._named(entry["layer"]) if factors else ():
            if channels := layer.triple():
                yield AdditiveLayer(name, channels, factors[0])

    def _named(self, alias: str) -> Iterator[tuple[str, Layer]]:
        """Yield the layers of a name, or of a pattern with ``*``, where ``_`` matters: ``C_*`` is not ``coat``."""
        if "*" in alias:
            yield from (pair for pair in self.layers if fnmatchcase(pair[0].lower(), alias.lower()))
            return
        places = (self._beauty.view_layer, "")
        for name in self._names_of(alias):
            if found := [pair for pair in self.layers if view_layer_of(pair[1].name, name) in places]:
                yield from [pair for pair in found if pair[1].name.endswith(name)] or found
                return


def _user_set(finder: _Finder, text: str, path: str) -> AdditiveSet:
    """Return the set that ``NAME=a+b+c*d`` describes. A term that ends with ``*`` is a pattern: ``light_*``."""
    name, _, sum_of = (part.strip() for part in text.partition("="))
    terms = [term.strip() for term in sum_of.split("+")]
    no_sum = InputError(f"--sum {text!r}: write NAME=LAYER+LAYER, LAYER* for several, or LAYER*COLOUR for a product")
    if not name or not all(terms):
        raise no_sum
    lights: dict[AdditiveLayer, None] = {}
    for term in terms:
        layer, times, factor = (part.strip() for part in term.partition("*"))
        is_pattern = term.endswith("*")
        matches = list(finder.find({"layer": layer, "times": factor} if times and not is_pattern else term))
        if not matches or (len(matches) > 1 and not is_pattern):
            known = ", ".join(layer.name for _, layer in finder.layers[:12] if layer.name)
            no_layer = f"no layer {term!r} of three channels" + (f"; it has {known}" if known else "")
            raise InputError(f"--sum {text!r}: {path} has {f'several layers {term!r}' if matches else no_layer}")
        lights |= dict.fromkeys(matches)
    if len(lights) < 2:
        raise no_sum
    return AdditiveSet(name, tuple(lights), by_user=True)
