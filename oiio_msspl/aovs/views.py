# SPDX-License-Identifier: Apache-2.0
"""Find the beauty, and choose among the views and view layers of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from oiio_msspl.aovs.renderers import best_spelled, entry_of, view_layer_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, views_of
from oiio_msspl.exr.reader import Channel, ExrFile


class Beauty(NamedTuple):
    """The beauty layer of one view and view layer."""

    view: str
    """Such as ``left``; empty in a file without views."""
    view_layer: str
    """Such as ``ViewLayer``; empty in a file without view layers."""
    layer: Layer

    @property
    def label(self) -> str:
        """Name for the user: ``left``, ``ViewLayer`` or ``left/ViewLayer``."""
        return "/".join(name for name in (self.view, self.view_layer) if name)

    def layers_of_view(self, layers: Iterable[Layer]) -> Iterator[tuple[str, Layer]]:
        """Yield the layers of the beauty's view, and those of none, with their names behind its view layer."""
        prefix = f"{self.view_layer}." if self.view_layer else ""
        return ((layer.name.removeprefix(prefix), layer) for layer in layers if layer.view in (self.view, ""))


def name_of(view: str) -> str:
    """Return the name of a view or view layer for messages."""
    return view or "(unnamed)"


def find_beauties(file: ExrFile, layers: list[Layer], candidates: Sequence[Any]) -> list[Beauty]:
    """Return the beauties of all views and view layers, by the first candidate that any layer matches.

    They are in the order of the file. In a file with views, that order depends on whether views have parts of their
    own, because a part keeps its channels sorted by name. So there they are sorted by the names of their view layers,
    and then by views, the default view of ``multiView`` or else of the parts in front.
    """
    for candidate in candidates:
        alias = entry_of(candidate).get("layer", "")
        named: dict[tuple[str, str], list[Layer]] = {}
        for layer in layers:
            if (view_layer := view_layer_of(layer.name, alias)) is not None and layer.triple():
                named.setdefault((layer.view, view_layer), []).append(layer)
        beauties = [Beauty(*place, best_spelled(group, alias) or group[0]) for place, group in named.items()]
        if any(beauty.view for beauty in beauties):
            views = list(dict.fromkeys([*views_of(file), *(beauty.view for beauty in beauties)]))
            return sorted(beauties, key=lambda beauty: (beauty.view_layer, views.index(beauty.view)))
        if beauties:
            return beauties
    return []


def only_colour(layers: list[Layer], is_known: Callable[[str], bool]) -> list[str]:
    """Return the name of the only layer of R, G, B that is not known as something else; nothing if there are several.

    ``is_known`` tells it by the name of a layer. A name may occur once in each view of the file.
    """
    colours = (layer for layer in layers if {"R", "G", "B"} <= layer.channels.keys() and layer.triple())
    names = {layer.name for layer in colours if not is_known(layer.name)}
    return list(names) if len(names) == 1 else []


def find_alpha(layers: Iterable[Layer], beauty: Beauty) -> Channel | None:
    """Return the alpha of a beauty: its own, or that of a layer of its view and view layer that holds no colour.

    RenderMan writes ``a`` beside ``Ci.r``, and other programs write a layer or part ``alpha``. Integers are no alpha.
    """
    beside = [layer for layer in layers if layer.view == beauty.view and not layer.triple()]
    own = [beauty.layer, *(layer for layer in beside if layer.name == beauty.view_layer)]
    alphas = [layer.channels.get("A") for layer in own]
    for layer in beside:
        if view_layer_of(layer.name, "alpha") == beauty.view_layer:
            alphas += [layer.channels.get("A"), *(layer.scalar() or ())]
    return next((alpha for alpha in alphas if alpha and alpha.type != "uint"), None)


def choose_beauty(file: ExrFile, beauties: list[Beauty], wanted: str | None) -> Beauty:
    """Return the beauty of the view or view layer that is wanted, or the first one if none is."""
    if wanted is None or (len(beauties) == 1 and not beauties[0].label):  # the only view may have no name
        return beauties[0]
    for beauty in sorted(beauties, key=lambda beauty: beauty.label != wanted):  # the whole name counts more than a part
        if wanted in (beauty.view, beauty.view_layer, beauty.label):
            return beauty
    names = ", ".join(dict.fromkeys(name_of(beauty.label) for beauty in beauties))
    raise InputError(f"{file.path}: no view or view layer {wanted!r}; the file has {names}")
