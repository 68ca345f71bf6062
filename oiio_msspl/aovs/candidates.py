# SPDX-License-Identifier: Apache-2.0
"""Candidates: what the table of renderers, or the user, says that a feature may be read from.

A candidate is a layer's name or one of the tables that ``renderers.toml`` describes. If all its layers exist in a file,
it becomes a formula.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import RGB, VARIANCE
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapping import split_exr
from oiio_msspl.aovs.renderers import detect_renderer, layer_of_source, sibling_of, siblings_of, view_layer_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layers_of
from oiio_msspl.exr.reader import Channel, ExrFile, open_exr


class LayerFinder:
    """Finds the layers of candidates in one view and view layer of a file."""

    def __init__(
        self, file: ExrFile, layers: list[Layer], renderer: dict[str, Any], view: str, view_layer: str
    ) -> None:
        self._file, self._renderer = file, renderer
        self._layers = [layer for layer in layers if layer.view in (view, "")]
        self._view, self._view_layer = view, view_layer

    def formula(self, feature: str, candidate: Any, problems: list[str]) -> FeatureFormula | None:
        """The formula that a candidate describes.

        Args:
            feature: what it is for.
            candidate: checked by :func:`oiio_msspl.aovs.mapping.check_mapping`.
            problems: a sentence is added for a layer that exists but has the wrong channels.

        Returns:
            None if a layer is missing or has the wrong channels.

        Raises:
            InputError: the candidate names another file, which can't be read, shows another frame, or does not have
                exactly one layer for the feature.
        """
        entry: dict[str, Any] = {"layer": candidate} if isinstance(candidate, str) else dict(candidate)
        path, named = split_exr(str(entry.get("layer", "")).removeprefix("file:"))
        if str(entry.get("layer", "")).startswith("file:") and path and not named and "times" not in entry:
            extras = {key: entry[key] for key in ("kind", "encoding", "note") if key in entry}
            return replace(self._formula_of_file(feature, Path(path)), **extras)
        groups: list[tuple[Channel, ...]] = []
        names: list[str] = []
        if "channels" in entry:
            stored = self._channels()
            if not all(name in stored for name in entry["channels"]):
                return None
            groups.append(tuple(stored[name] for name in entry["channels"]))
            names.append(" ".join(entry["channels"]))
            aliases = []
        else:
            aliases = [*(entry.get("sum") or entry.get("halves") or [entry.get("layer")])]
        if "times" in entry:
            aliases.append(entry["times"])
        for alias in aliases:
            layer = self._layer(feature, str(alias))
            if layer is None:
                return None
            group = layer.triple() or (layer.scalar() if feature == VARIANCE else None)
            if group is None:
                problems.append(wrong_channels(feature, layer))
                return None
            groups.append(group)
            names.append(layer.name or " ".join(c.name for c in group))
        factor = groups.pop() if "times" in entry else None
        kind = "halves" if "halves" in entry else entry.get("kind", "mean")
        encoding, note = entry.get("encoding", "signed"), entry.get("note", "")
        return FeatureFormula(tuple(groups), factor, kind, encoding, _text(names, factor is not None), note)

    def _channels(self) -> dict[str, Channel]:
        """The channels of the view's layers by their stored names; of equal names the view's first one."""
        stored: dict[str, Channel] = {}
        for layer in sorted(self._layers, key=lambda each: each.view != self._view):
            for channel in layer.channels.values():
                stored.setdefault(channel.name, channel)
        return stored

    def _formula_of_file(self, feature: str, path: Path) -> FeatureFormula:
        """The feature of another render, found by the table of renderers; or its only layer, for a file of one AOV."""
        other = self._open(path)
        layers = layers_of(other)
        renderer = detect_renderer(other, layers)
        found: dict[tuple[Channel, ...], FeatureFormula] = {}
        for candidate in renderer.get(feature, []):
            for view, view_layer in _views_and_view_layers(layers, (self._view, self._view_layer)):
                formula = LayerFinder(other, layers, renderer, view, view_layer).formula(feature, candidate, [])
                if formula is not None:
                    found.setdefault(tuple(formula.channels), formula)
                if found and (view, view_layer) == (self._view, self._view_layer):
                    break  # the same view layer as this render's: its siblings are not asked
            if found:
                break
        self._file.siblings.update(other.siblings)
        if not found:
            layer = _only_layer(path, layers, feature, renderer)
            group = layer.triple() or layer.scalar()
            assert group is not None
            return FeatureFormula((group,), text=path.name)
        if len(found) > 1:
            texts = [formula.text for formula in found.values()]
            raise InputError(_name_a_layer(path, feature, f"has {len(texts)} layers for it: {', '.join(texts)}", texts))
        (formula,) = found.values()
        return replace(formula, text=f"{path.name}: {formula.text}")

    def _layer(self, feature: str, alias: str) -> Layer | None:
        """The layer that an alias names: of the chosen view layer, or else of none."""
        if alias.startswith("file:"):
            return self._layer_of_file(feature, alias.removeprefix("file:"))
        names = [alias, layer_of_source(self._renderer, self._file, alias)]
        for name, view_layer in itertools.product(filter(None, names), (self._view_layer, "")):
            for layer in self._layers:
                if view_layer_of(layer.name, name) == view_layer:
                    return layer
        return None

    def _layer_of_file(self, feature: str, name: str) -> Layer | None:
        """A layer of another EXR: ``folder/other.exr:layer``, the only layer of ``folder/other.exr``, or the plain R,
        G, B of a sibling file."""
        file = self._file
        named, wanted = split_exr(name)
        if not named:
            sibling = sibling_of(file.path, name)
            if sibling is None:
                return None
            layers = layers_of(self._open(sibling))
            first = next((layer for layer in layers if layer.triple()), layers[0] if layers else None)
            return first and replace(first, name=sibling.name)
        path = Path(named)
        other = self._open(path)
        layers = layers_of(other)
        renderer = detect_renderer(other, layers)
        if not wanted:
            return replace(_only_layer(path, layers, feature, renderer), name=path.name)
        own = LayerFinder(other, layers, renderer, self._view, self._view_layer)._layer(feature, wanted)
        meant = [own] if own else [layer for layer in layers if view_layer_of(layer.name, wanted) is not None]
        if len(meant) != 1:
            texts = [each.name for each in meant or layers if each.name]
            problem = f"has {len(meant) or 'no'} layer{'s' if meant else ''} {wanted!r}"
            raise InputError(_name_a_layer(path, feature, problem, texts))
        return replace(meant[0], name=f"{path.name}: {meant[0].name}")

    def _open(self, path: Path) -> ExrFile:
        """Another file that holds layers of the same frame."""
        file = self._file
        if path not in file.siblings:
            file.siblings[path] = open_exr(path)
        other = file.siblings[path]
        if other.display_window.size != file.display_window.size:
            raise InputError(
                f"{path}: is {other.display_window.size}, but {file.path} is {file.display_window.size}; "
                "give layers of the same frame"
            )
        if other.display_window != file.display_window:  # pixels are read by their place, so all would be beside it
            raise InputError(
                f"{path}: its display window is {other.display_window}, but that of {file.path} is "
                f"{file.display_window}; give layers of the same frame"
            )
        return other


def _only_layer(path: Path, layers: list[Layer], feature: str, renderer: dict[str, Any]) -> Layer:
    """The only layer of a file that could be the feature.

    Raises:
        InputError: there is none, there are several, or the only one is named as a beauty.
    """
    fitting = [each for each in layers if each.triple() or (feature == VARIANCE and each.scalar())]
    beauties = [each for each in renderer[RGB] if each]
    if len(fitting) == 1 and all(view_layer_of(fitting[0].name, beauty) is None for beauty in beauties):
        return fitting[0]
    texts = [each.name or "R G B" for each in fitting]
    known = f"among {', '.join(texts)}" if texts else "in it"
    raise InputError(_name_a_layer(path, feature, f"no layer {known} is known as {feature}", texts))


def _name_a_layer(path: Path, feature: str, problem: str, layers: Sequence[str]) -> str:
    example = next((name for name in layers if name != "R G B"), "LAYER")
    return f"{path}: {problem}; name one, as --map '{feature}={path.name}:{example}'"


def _views_and_view_layers(layers: list[Layer], first: tuple[str, str]) -> list[tuple[str, str]]:
    """All pairs of a view and a view layer that a file's layers may have, ``first`` in front."""
    prefixes = {
        (layer.view, ".".join(words[:count]))
        for layer in layers
        for words in [layer.name.split(".")]
        for count in range(len(words))
    }
    return [first, *sorted(prefixes - {first})]


def _paths_of(path: Path, name: str) -> list[Path]:
    """The EXRs that ``file:NAME`` may mean in a mapping of the file ``path``."""
    named, _ = split_exr(name)
    return [Path(named)] if named else siblings_of(path, name)


def mapped_files(mapping: Mapping[str, Any], path: Path) -> set[Path]:
    """The other EXRs that a user's mapping of the file ``path`` may name, whether they exist or not."""
    files = set()
    for candidate in mapping.values():
        values = candidate.values() if isinstance(candidate, dict) else [candidate]
        for names in values:
            for name in names if isinstance(names, list) else [names]:
                if isinstance(name, str) and name.startswith("file:"):
                    files.update(_paths_of(path, name.removeprefix("file:")))
    return files


def missing(feature: str, candidate: Any, file: ExrFile) -> str:
    """The sentence for a candidate of the user whose layers are not in the file."""
    entry = {"layer": candidate} if isinstance(candidate, str) else candidate
    if "channels" in entry:
        names = [" ".join(entry["channels"])]
    else:
        names = [*(entry.get("sum") or entry.get("halves") or [entry["layer"]])]
    names += [entry["times"]] if "times" in entry else []
    text = _text([name.removeprefix("file:") for name in names], "times" in entry)
    if any(part.deep and part.name == text for part in file.parts):
        return f"{feature} is mapped to {text}, which is deep; flatten it first"
    if any(channel.name == text for part in file.parts for channel in part.channels):
        return f"{feature} is mapped to {text}, which is a channel, not a layer; msspl inspect names the layers"
    return f"{feature} is mapped to {text}, which is not there"


def wrong_channels(feature: str, layer: Layer) -> str:
    """The sentence for a layer that exists but can't be the feature."""
    wanted = "R, G, B (or X, Y, Z)" + (" or a single channel" if feature == VARIANCE else "")
    return f"{feature}: layer '{layer.name or 'R G B'}' has channels {', '.join(layer.channels)}, not {wanted}"


def _text(names: Sequence[str], has_factor: bool) -> str:
    """``a``, ``a + b``, ``a * c`` or ``(a + b) * c``."""
    if not has_factor:
        return " + ".join(names)
    *terms, factor = names
    text = " + ".join(terms)
    return f"({text}) * {factor}" if len(terms) > 1 else f"{text} * {factor}"
