# SPDX-License-Identifier: Apache-2.0
"""Candidates: what the table of renderers, or the user, says that a feature may be read from.

A candidate is a layer's name or one of the tables that ``renderers.toml`` describes. If all its layers exist in a file,
it becomes a formula.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import VARIANCE
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.renderers import view_layer_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layers_of
from oiio_msspl.exr.reader import Channel, ExrFile, open_exr


class LayerFinder:
    """Finds the layers of candidates in one view and view layer of a file."""

    def __init__(self, file: ExrFile, layers: list[Layer], view: str, view_layer: str) -> None:
        self._file = file
        self._layers = [layer for layer in layers if layer.view in (view, "")]
        self._view_layer = view_layer

    def formula(self, feature: str, candidate: Any, problems: list[str]) -> FeatureFormula | None:
        """The formula that a candidate describes.

        Args:
            feature: what it is for.
            candidate: checked by :func:`oiio_msspl.aovs.mapping.check_mapping`.
            problems: a sentence is added for a layer that exists but has the wrong channels.

        Returns:
            None if a layer is missing or has the wrong channels.

        Raises:
            InputError: the candidate names another file, which can't be read or shows another frame.
        """
        entry: dict[str, Any] = {"layer": candidate} if isinstance(candidate, str) else dict(candidate)
        if "channels" in entry:
            return self._formula_of_channels(entry)
        aliases = entry.get("sum") or entry.get("halves") or [entry.get("layer")]
        if "times" in entry:
            aliases = [*aliases, entry["times"]]
        groups: list[tuple[Channel, ...]] = []
        names: list[str] = []
        for alias in aliases:
            layer = self._layer(str(alias))
            if layer is None:
                return None
            group = layer.triple() or (layer.scalar() if feature == VARIANCE else None)
            if group is None:
                problems.append(_wrong_channels(feature, layer))
                return None
            groups.append(group)
            names.append(layer.name or " ".join(c.name for c in group))
        factor = groups.pop() if "times" in entry else None
        kind = "halves" if "halves" in entry else entry.get("kind", "mean")
        encoding, note = entry.get("encoding", "signed"), entry.get("note", "")
        return FeatureFormula(tuple(groups), factor, kind, encoding, _text(names, factor is not None), note)

    def _formula_of_channels(self, entry: dict[str, Any]) -> FeatureFormula | None:
        """The formula of a candidate that lists channels by their stored names."""
        stored = {c.name: c for part in self._file.parts for c in part.channels}
        names = entry["channels"]
        if not all(n in stored for n in names):
            return None
        group = tuple(stored[n] for n in names)
        encoding, note = entry.get("encoding", "signed"), entry.get("note", "")
        return FeatureFormula((group,), encoding=encoding, text=" ".join(names), note=note)

    def _layer(self, alias: str) -> Layer | None:
        """The layer that an alias names: of the chosen view layer, or else of none."""
        if alias.startswith("file:"):
            return self._layer_of_sibling(alias.removeprefix("file:"))
        for view_layer in (self._view_layer, ""):
            for layer in self._layers:
                if view_layer_of(layer.name, alias) == view_layer:
                    return layer
        return None

    def _layer_of_sibling(self, name: str) -> Layer | None:
        """The first layer with three channels of another EXR: its path, or the stem of a file in the same folder."""
        file = self._file
        path = _path_of_sibling(file.path, name)
        if path == file.path or not path.is_file():
            return None
        if path not in file.siblings:
            file.siblings[path] = open_exr(path)
        other = file.siblings[path]
        if other.display_window.size != file.display_window.size:
            raise InputError(
                f"{path}: is {other.display_window.size}, but {file.path} is {file.display_window.size}; "
                "give layers of the same frame"
            )
        layers = [replace(layer, name=path.name) for layer in layers_of(other)]
        return next((layer for layer in layers if layer.triple()), layers[0] if layers else None)


def _path_of_sibling(path: Path, name: str) -> Path:
    """The EXR that ``file:NAME`` means in a mapping of the file ``path``."""
    return Path(name) if name.lower().endswith(".exr") else path.with_name(name + ".exr")


def mapped_files(mapping: Mapping[str, Any], path: Path) -> set[Path]:
    """The other EXRs that a user's mapping of the file ``path`` names, whether they exist or not."""
    files = set()
    for candidate in mapping.values():
        values = candidate.values() if isinstance(candidate, dict) else [candidate]
        for names in values:
            for name in names if isinstance(names, list) else [names]:
                if isinstance(name, str) and name.startswith("file:"):
                    files.add(_path_of_sibling(path, name.removeprefix("file:")))
    return files


def missing(feature: str, candidate: Any) -> str:
    """The sentence for a candidate of the user whose layers are not in the file."""
    names = [candidate] if isinstance(candidate, str) else [str(v) for v in candidate.values()]
    return f"{feature} is mapped to {' * '.join(names).removeprefix('file:')}, which is not there"


def _wrong_channels(feature: str, layer: Layer) -> str:
    wanted = "R, G, B (or X, Y, Z)" + (" or a single channel" if feature == VARIANCE else "")
    return f"{feature}: layer '{layer.name or 'R G B'}' has channels {', '.join(layer.channels)}, not {wanted}"


def _text(names: Sequence[str], has_factor: bool) -> str:
    """``a``, ``a + b``, ``a * c`` or ``(a + b) * c``."""
    if not has_factor:
        return " + ".join(names)
    *terms, factor = names
    text = " + ".join(terms)
    return f"({text}) * {factor}" if len(terms) > 1 else f"{text} * {factor}"
