# SPDX-License-Identifier: Apache-2.0
"""Finding the beauty, and choosing among the views and view layers of a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from oiio_msspl.aovs.renderers import view_layer_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, views_of
from oiio_msspl.exr.reader import ExrFile


class Beauty(NamedTuple):
    """The beauty layer of one view and view layer."""

    view: str
    """Such as ``left``; empty in a file without views."""
    view_layer: str
    """Such as ``ViewLayer``; empty in a file without view layers."""
    layer: Layer

    @property
    def label(self) -> str:
        """What the user calls it: ``left``, ``ViewLayer`` or ``left/ViewLayer``."""
        return "/".join(name for name in (self.view, self.view_layer) if name)


def name_of(view: str) -> str:
    """A view or view layer, in words."""
    return view or "(unnamed)"


def find_beauties(file: ExrFile, layers: list[Layer], candidates: Sequence[Any]) -> list[Beauty]:
    """The beauties of all views and view layers: the layers that match the first candidate that matches any.

    They are in the order of the file. In a file with views, that order depends on whether views have parts of their
    own, as a part keeps its channels sorted by name. So view layers are sorted by name there, and each one has its
    default view in front: the first one of ``multiView``, or of the parts.
    """
    for candidate in candidates:
        alias = candidate if isinstance(candidate, str) else candidate.get("layer", "")
        found = [
            Beauty(layer.view, view_layer, layer)
            for layer in layers
            if (view_layer := view_layer_of(layer.name, alias)) is not None and layer.triple()
        ]
        if found:
            return _sorted_by_view_layer(file, found) if any(beauty.view for beauty in found) else found
    return []


def _sorted_by_view_layer(file: ExrFile, beauties: list[Beauty]) -> list[Beauty]:
    order = list(dict.fromkeys([*views_of(file), *(beauty.view for beauty in beauties)]))
    return sorted(beauties, key=lambda each: (each.view_layer, order.index(each.view)))


def choose_beauty(file: ExrFile, beauties: list[Beauty], wanted: str | None) -> Beauty:
    """The beauty of the view or view layer that the user wants, or the first one if they don't say.

    Raises:
        InputError: the file has no such view or view layer.
    """
    if wanted is None:
        return beauties[0]
    if len(beauties) == 1 and not beauties[0].label:
        return beauties[0]  # the only view, and it has no name
    for beauty in sorted(beauties, key=lambda each: each.label != wanted):  # the whole name counts more than a part
        if wanted in (beauty.view, beauty.view_layer, beauty.label):
            return beauty
    known = ", ".join(dict.fromkeys(name_of(beauty.label) for beauty in beauties))
    raise InputError(f"{file.path}: no view or view layer {wanted!r}; the file has {known}")
