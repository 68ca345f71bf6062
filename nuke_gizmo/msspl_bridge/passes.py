# SPDX-License-Identifier: Apache-2.0
"""Finds the layers of a fused file that sum to its beauty."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

from msspl_bridge import FuseError

#: Where Nuke shows the EXR attribute in which msspl-fuse names the layers that it has fused.
ATTRIBUTE = "exr/msspl/passes"


def fused_sets(attribute: object, channels: Iterable[str]) -> dict[str, list[list[str]]]:
    """Return the fused sets of a file that have all their layers, by name, such as ``light groups``.

    A set is a list of terms. A term is Nuke's name of a layer, or of light and the colour that it is multiplied by.

    Args:
        attribute: value of :data:`ATTRIBUTE`; None in a file without it.
        channels: of the Read, such as ``ViewLayer_Emit.red``.
    """
    stored = json.loads(str(attribute or "[]"))
    if not stored:
        raise FuseError("the file has no fused passes; fuse it again with passes that sum to the beauty")
    layers = {_spelling(layer): layer for layer in (channel.rpartition(".")[0] for channel in channels)}
    complete, missing = {}, []
    for entry in stored:
        lacking = [name for term in entry["layers"] for name in term if _spelling(name) not in layers]
        missing += [(name, entry["name"]) for name in lacking]
        if not lacking:
            complete[entry["name"]] = [[layers[_spelling(name)] for name in term] for term in entry["layers"]]
    if not complete:
        layer, name = missing[0]
        raise FuseError(f"the file has no layer {layer}; fuse it again with all layers of {name}")
    return complete


def _spelling(layer: str) -> str:
    """Return the lower-case name of a layer with the signs that Nuke replaces, such as dots and spaces, as ``_``."""
    return re.sub(r"[^0-9a-z]", "_", layer.lower())
