# SPDX-License-Identifier: Apache-2.0
"""Find the layers of candidates: what the table of renderers, or the user, says that a feature may be read from.

A candidate is a layer's name or one of the tables that ``renderers.toml`` describes. If all its layers exist in a file,
it becomes a formula.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import NORMAL, RGB, VARIANCE
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapping import SAMPLES, split_exr
from oiio_msspl.aovs.renderers import (
    best_spelled,
    candidates_of,
    detect_renderer,
    entry_of,
    file_beside,
    file_names,
    names_of_aov,
    sibling_of,
    siblings_of,
    view_layer_of,
)
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layers_of
from oiio_msspl.exr.reader import Channel, ExrFile, open_exr


class LayerFinder:
    """Finder of candidates' layers in one view and view layer of a file."""

    def __init__(
        self,
        file: ExrFile,
        layers: list[Layer],
        renderer: dict[str, Any],
        view: str,
        view_layer: str,
        spp: float | None = None,
    ) -> None:
        self._file, self._renderer, self._spp = file, renderer, spp
        self._layers = [layer for layer in layers if layer.view in (view, "")]
        self._view, self._view_layer = view, view_layer

    def formula(self, feature: str, candidate: Any, problems: list[str]) -> FeatureFormula | None:
        """Return the formula that a candidate describes; None if a layer is missing or has the wrong channels.

        The variance of samples is none either, unless their number is known.

        Args:
            candidate: checked by :func:`oiio_msspl.aovs.mapping.check_mapping`.
            problems: a sentence is added for a layer that exists but has the wrong channels.

        Raises:
            InputError: the candidate names another file, which can't be read, shows another frame, or does not have
                exactly one layer for the feature.
        """
        entry = entry_of(candidate)
        found = []
        for alias in _aliases(entry):
            if (group := self._group(feature, alias, problems)) is None:
                return None
            found.append(group)
        groups = [channels for channels, _ in found]
        factor = groups.pop() if "times" in entry else None
        # The table knows how a renderer stores normals, but not how another EXR does.
        is_exr = feature == NORMAL and bool(split_exr(str(entry.get("layer", "")))[0])
        encoding, note = entry.get("encoding", "auto" if is_exr else "signed"), entry.get("note", "")
        text = _text([name for _, name in found], factor is not None)
        samples = self._spp if entry.get("of") == SAMPLES else 1.0
        if samples is None:
            problems.append(f"{feature}: {text} is that of samples, and no header tells the spp; give --hr-spp")
            return None
        if samples != 1:
            text += f" / {samples:g} spp"
        return FeatureFormula(tuple(groups), factor, samples, encoding, text, note)

    def _group(
        self, feature: str, alias: str | list[str], problems: list[str]
    ) -> tuple[tuple[Channel, ...], str] | None:
        """Return the channels of a layer, or of a list of channel names, and their name for the user."""
        if isinstance(alias, list):
            # Of equal names, the chosen view's first one.
            layers = sorted(self._layers, key=lambda layer: layer.view != self._view)
            channels = (c for layer in reversed(layers) for c in reversed(layer.channels.values()))
            stored = {c.name: c for c in channels if c.type != "uint"}
            return (tuple(stored[c] for c in alias), " ".join(alias)) if all(c in stored for c in alias) else None
        layer = self._layer(feature, alias)
        if layer is None:
            return None
        group = layer.triple() or (layer.scalar() if feature == VARIANCE else None)
        if group is None:
            problems.append(wrong_channels(feature, layer))
            return None
        return group, layer.name or " ".join(channel.name for channel in group)

    def _layer(self, feature: str, alias: str) -> Layer | None:
        """Return the layer that an alias names: of the chosen view layer, or else of none."""
        if alias.startswith("file:"):
            return self._layer_of_file(feature, alias.removeprefix("file:"))
        if alias.startswith("beside:"):
            return self._layer_beside(alias.removeprefix("beside:"))
        names = names_of_aov(self._renderer, self._file, alias)
        for name, view_layer in itertools.product(names, (self._view_layer, "")):
            named = (layer for layer in self._layers if view_layer_of(layer.name, name) == view_layer)
            if layer := best_spelled(named, name):
                return layer
        return None

    def _layer_beside(self, aov: str) -> Layer | None:
        """Return the only layer of a file beside the beauty, if it shows the same frame."""
        path = file_beside(self._file.path, aov)
        if path is None or self._view_layer:
            return None
        try:
            file = self._open(path)
        except InputError:  # nobody has named this file
            return None
        layers = [layer for layer in layers_of(file) if layer.triple() and layer.view in (self._view, "")]
        return replace(layers[0], name=path.name) if len(layers) == 1 else None

    def _layer_of_file(self, feature: str, name: str) -> Layer | None:
        """Return a layer of another EXR, which ``name`` gives as FILE.exr:LAYER, FILE.exr, or AOV of a sibling file."""
        file_name, alias = split_exr(name)
        path = Path(file_name) if file_name else sibling_of(self._file.path, name)
        if path is None:
            return None
        file = self._open(path)
        layers = layers_of(file)
        if not file_name:
            layer = next((layer for layer in layers if layer.triple()), layers[0] if layers else None)
            return layer and replace(layer, name=path.name)
        renderer = detect_renderer(file, layers)
        if not alias:
            return replace(_only_layer(path, layers, feature, renderer), name=path.name)
        layer = LayerFinder(file, layers, renderer, self._view, self._view_layer)._layer(feature, alias)
        matches = [layer] if layer else [layer for layer in layers if view_layer_of(layer.name, alias) is not None]
        if len(matches) != 1:
            texts = [layer.name for layer in matches or layers if layer.name]
            problem = f"has {len(matches) or 'no'} layer{'s' if matches else ''} {alias!r}"
            raise InputError(_name_a_layer(path, feature, problem, texts))
        return replace(matches[0], name=f"{path.name}: {matches[0].name}")

    def _open(self, path: Path) -> ExrFile:
        """Open another file that holds layers of this frame."""
        if path not in self._file.siblings:
            self._file.siblings[path] = open_exr(path)
        sibling = self._file.siblings[path]
        window, frame, render = sibling.display_window, self._file.display_window, self._file.path
        hint = "give layers of the same frame"
        if window.size != frame.size:
            raise InputError(f"{path}: is {window.size}, but {render} is {frame.size}; {hint}")
        if window != frame:  # pixels are read by their place, so all would be beside the frame
            raise InputError(f"{path}: its display window is {window}, but that of {render} is {frame}; {hint}")
        return sibling


def _aliases(entry: Mapping[str, Any]) -> list[str | list[str]]:
    """Return the layers of a candidate, the factor last; ``channels`` are a list of names."""
    names = [entry["channels"]] if "channels" in entry else entry.get("sum") or [entry["layer"]]
    return [*names, entry["times"]] if "times" in entry else [*names]


def _only_layer(path: Path, layers: list[Layer], feature: str, renderer: dict[str, Any]) -> Layer:
    """Return the only layer of a file that could be the feature and is not named as a beauty."""
    fitting = [layer for layer in layers if layer.triple() or (feature == VARIANCE and layer.scalar())]
    beauties = filter(None, candidates_of(renderer, RGB))
    if len(fitting) == 1 and all(view_layer_of(fitting[0].name, beauty) is None for beauty in beauties):
        return fitting[0]
    texts = [layer.name or "R G B" for layer in fitting]
    there = ", ".join(texts) or "no layer of three channels"
    raise InputError(_name_a_layer(path, feature, f"holds {there}, and not the {feature} alone", texts))


def _name_a_layer(path: Path, feature: str, problem: str, layers: Sequence[str]) -> str:
    example = next((name for name in layers if name != "R G B"), "LAYER")
    return f"{path}: {problem}; name one, as --map '{feature}={path.name}:{example}'"


def mapped_files(mapping: Mapping[str, Any], path: Path) -> set[Path]:
    """Return the EXRs that a user's mapping of the file ``path`` may name beside it, whether they exist or not."""
    files = [(split_exr(name)[0], name) for name in file_names(mapping)]
    return {file for exr, name in files for file in ([Path(exr)] if exr else siblings_of(path, name))}


def missing(feature: str, candidate: Any, file: ExrFile) -> str:
    """Return the sentence for a candidate of the user whose layers are not in the file."""
    entry = entry_of(candidate)
    names = [name.removeprefix("file:") if isinstance(name, str) else " ".join(name) for name in _aliases(entry)]
    text = _text(names, "times" in entry)
    if any(part.deep and part.name == text for part in file.parts):
        return f"{feature} is mapped to {text}, which is deep; flatten it first"
    if any(channel.name == text for part in file.parts for channel in part.channels):
        return f"{feature} is mapped to {text}, which is a channel, not a layer; msspl inspect names the layers"
    there = ", ".join(layer.name for layer in layers_of(file) if layer.name and layer.triple())
    return f"{feature} is mapped to {text}, which is not there" + (f" (layers: {there})" if there else "")


def wrong_channels(feature: str, layer: Layer) -> str:
    """Return the sentence for a layer that exists but can't be the feature."""
    wanted = "R, G, B (or X, Y, Z)" + (" or a single channel" if feature == VARIANCE else "")
    of = " of integers (ids, not light)" if any(c.type == "uint" for c in layer.channels.values()) else ""
    return f"{feature}: layer '{layer.name or 'R G B'}' has channels {', '.join(layer.channels)}{of}, not {wanted}"


def _text(names: Sequence[str], has_factor: bool) -> str:
    """Write a formula as ``a``, ``a + b``, ``a * c`` or ``(a + b) * c``."""
    if not has_factor:
        return " + ".join(names)
    *terms, factor = names
    text = " + ".join(terms)
    return f"({text}) * {factor}" if len(terms) > 1 else f"{text} * {factor}"
