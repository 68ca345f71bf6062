# SPDX-License-Identifier: Apache-2.0
"""From what a renderer calls its layers to the features of :mod:`oiio_msspl.aovs.features`.

The knowledge is data (``aovs.toml``); this module matches it against the layers of a file, and reads features in the
units of the schema: composites by the paper's equations, variances brought to the variance of the pixel's mean
luminance, normals to signed vectors. Whatever it chose is kept as text for the user.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.aovs.features import NORMAL, OPTIONAL_FEATURES, RGB, VARIANCE
from oiio_msspl.aovs.mapped_render import FeatureFormula, MappedRender
from oiio_msspl.aovs.mapping import check_mapping
from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layers_of
from oiio_msspl.exr.reader import Channel, ExrFile, open_exr
from oiio_msspl.exr.render import Window


def _normal_form(name: str) -> str:
    return re.sub(r"[ _-]", "", name).lower()


def _matches(layer: str, alias: str) -> str | None:
    """The view layer in front of ``alias`` if ``layer`` is that alias ("" for none), None if it is another layer."""
    name, wanted = _normal_form(layer), _normal_form(alias)
    if name == wanted or ("*" in wanted and fnmatchcase(name, wanted)):
        return ""
    if wanted and name.endswith("." + wanted):
        # Same number of dots from the end, on the name as stored.
        return layer.rsplit(".", wanted.count(".") + 1)[0]
    return None


# ---------------------------------------------------------------------------------------------- the table


@lru_cache(maxsize=1)
def renderers() -> list[dict[str, Any]]:
    """The shipped table, most specific renderer first."""
    text = resources.files("oiio_msspl.aovs").joinpath("renderers.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["renderer"])


def _detected(renderer: dict[str, Any], file: ExrFile, layers: list[Layer]) -> bool:
    def holds(condition: dict[str, Any]) -> bool:
        names = all(
            any(_matches(layer.name, alias) is not None for layer in layers) for alias in condition.get("layers", ())
        )
        attributes = all(
            any(re.search(key, k) and re.search(value, str(v)) for k, v in file.metadata.items())
            for key, value in condition.get("attributes", {}).items()
        )
        return names and attributes and bool(re.search(condition.get("file", ""), file.path.stem))

    return any(holds(condition) for condition in renderer["detect"])


# ---------------------------------------------------------------------------------------------- resolving


class _Matcher:
    """Candidates of the table against the layers of one view layer of one file."""

    def __init__(self, file: ExrFile, layers: list[Layer], view: str, group: str) -> None:
        self.file = file
        self.group = group
        self.layers = [layer for layer in layers if layer.view in (view, "")]

    def layer(self, alias: str) -> Layer | None:
        if alias.startswith("file:"):
            return self._sibling(alias.removeprefix("file:"))
        for wanted in (self.group, ""):
            for layer in self.layers:
                if _matches(layer.name, alias) == wanted:
                    return layer
        return None

    def _sibling(self, stem: str) -> Layer | None:
        path = Path(stem) if stem.lower().endswith(".exr") else self.file.path.with_name(stem + ".exr")
        if path == self.file.path or not path.is_file():
            return None
        if path not in self.file.siblings:
            self.file.siblings[path] = open_exr(path)
        other = self.file.siblings[path]
        if other.display_window.size != self.file.display_window.size:
            raise InputError(
                f"{path}: is {other.display_window.size}, but {self.file.path} is {self.file.display_window.size}; "
                "give layers of the same frame"
            )
        layers = [replace(layer, name=path.name) for layer in layers_of(other)]
        return next((layer for layer in layers if layer.triple()), layers[0] if layers else None)

    def source(self, feature: str, candidate: Any, problems: list[str]) -> FeatureFormula | None:
        """A candidate's channels if all of it is there; what is there but unusable goes to ``problems``."""
        entry: dict[str, Any] = {"layer": candidate} if isinstance(candidate, str) else dict(candidate)
        kind = entry.get("kind", "mean")
        aliases = entry.get("sum") or entry.get("halves") or [entry.get("layer")]
        if "halves" in entry:
            kind = "halves"
        if "channels" in entry:
            return self._by_channel_names(entry)
        groups: list[tuple[Channel, ...]] = []
        texts: list[str] = []
        for alias in [*aliases, *([entry["times"]] if "times" in entry else [])]:
            layer = self.layer(str(alias))
            if layer is None:
                return None
            group = layer.triple() or (layer.scalar() if feature == VARIANCE else None)
            if group is None:
                wanted = "R, G, B (or X, Y, Z)" + (" or a single channel" if feature == VARIANCE else "")
                problems.append(
                    f"{feature}: layer '{layer.name or 'R G B'}' has channels {', '.join(layer.channels)}, not {wanted}"
                )
                return None
            groups.append(group)
            texts.append(layer.name or " ".join(c.name for c in group))
        factor = groups.pop() if "times" in entry else None
        text = " + ".join(texts[: len(groups)])
        if factor is not None:
            text = f"({text}) * {texts[-1]}" if len(groups) > 1 else f"{text} * {texts[-1]}"
        encoding = entry.get("encoding", "signed")
        return FeatureFormula(tuple(groups), factor, kind, encoding, text, entry.get("note", ""))

    def _by_channel_names(self, entry: dict[str, Any]) -> FeatureFormula | None:
        stored = {c.name: c for part in self.file.parts for c in part.channels}
        names = entry["channels"]
        if not all(n in stored for n in names):
            return None
        group = tuple(stored[n] for n in names)
        return FeatureFormula(
            (group,), encoding=entry.get("encoding", "signed"), text=" ".join(names), note=entry.get("note", "")
        )


def map_render(
    file: ExrFile,
    mapping: Mapping[str, Any] | None = None,
    *,
    view: str | None = None,
    spp: float | None = None,
    features: Sequence[str] = OPTIONAL_FEATURES,
) -> MappedRender:
    """Find the features of :mod:`oiio_msspl.aovs.features` among a file's layers.

    Args:
        file: from :func:`oiio_msspl.exr.reader.open_exr`.
        mapping: the user's own candidates by feature; they win over the table, and must exist.
        view: view (``left``) or view layer (``ViewLayer``) to take; the file's first if None.
        spp: samples per pixel, if the header does not say or says it wrongly.
        features: which to look for, beside the beauty.

    Raises:
        InputError: a mapping of no known form, deep data only, no beauty, no such view, integers where light should be,
            or a mapped layer that is absent or has the wrong channels.
    """
    if all(part.deep for part in file.parts):
        raise InputError(
            f"{file.path}: holds deep data only; flatten it first (a deep pixel has no single colour to fuse)"
        )
    mapping = check_mapping(dict(mapping or {}), "mapping")
    deep = {part.index for part in file.parts if part.deep}
    layers = [layer for layer in layers_of(file) if not any(c.part in deep for c in layer.channels.values())]
    renderer = next(r for r in renderers() if _detected(r, file, layers))
    if "not_beauty" in renderer and re.search(renderer["not_beauty"], file.path.stem) and RGB not in mapping:
        raise InputError(
            f"{file.path}: holds {renderer['name']}'s {file.path.stem} alone, no beauty; give the RGB file beside it "
            "(or say --map rgb=... to take it all the same)"
        )

    beauties = _beauties(layers, [mapping[RGB]] if RGB in mapping else renderer["rgb"])
    if not beauties:
        seen = ", ".join(sorted({layer.name or " ".join(layer.channels) for layer in layers})[:12])
        raise InputError(f"{file.path}: no beauty (R, G, B) found among: {seen}; name it with --map rgb=LAYER")
    chosen_view, group, beauty = _choose(file, beauties, view)
    labels = list(dict.fromkeys(_label(v, g) for v, g, _ in beauties))

    matcher = _Matcher(file, layers, chosen_view, group)
    rgb = beauty.triple()
    assert rgb is not None
    found_features = {RGB: FeatureFormula((rgb,), text=beauty.name or " ".join(c.name for c in rgb))}
    notes: list[str] = []
    for feature in features:
        problems: list[str] = []
        candidates = [mapping[feature]] if feature in mapping else renderer.get(feature, [])
        found = next((s for c in candidates if (s := matcher.source(feature, c, problems))), None)
        if found is None and feature in mapping:
            raise InputError(f"{file.path}: " + (problems[0] if problems else _absent(feature, mapping[feature])))
        notes += problems
        if found is not None:
            found_features[feature] = found
    for feature, source in found_features.items():
        integers = [c.name for c in source.channels if c.type == "uint"]
        if integers:
            raise InputError(
                f"{file.path}: {feature}: {', '.join(integers)} hold integers (ids, not light); "
                f"choose another layer with --map {feature}=LAYER"
            )

    resolution = MappedRender(
        file=file,
        renderer=renderer["name"],
        view=_label(chosen_view, group),
        other_views=[label for label in labels if label != _label(chosen_view, group)],
        features=found_features,
        alpha=beauty.channels.get("A"),
        spp=spp if spp is not None else _spp(renderer, file, group),
        data_window=file.parts[rgb[0].part].data_window,
        notes=notes,
    )
    _check_variance(resolution)
    _decide_normal_encoding(resolution)
    return resolution


def _absent(feature: str, candidate: Any) -> str:
    names = [candidate] if isinstance(candidate, str) else [str(v) for v in candidate.values()]
    return f"{feature} is mapped to {' * '.join(names).removeprefix('file:')}, which is not there"


def _beauties(layers: list[Layer], candidates: Sequence[Any]) -> list[tuple[str, str, Layer]]:
    """(view, view layer, beauty layer) of the first candidate that exists anywhere."""
    for candidate in candidates:
        alias = candidate if isinstance(candidate, str) else candidate.get("layer", "")
        found = [
            (layer.view, group, layer)
            for layer in layers
            if (group := _matches(layer.name, alias)) is not None and layer.triple()
        ]
        if found:
            return found
    return []


def _label(view: str, group: str) -> str:
    return "/".join(part for part in (view, group) if part)


def _choose(file: ExrFile, beauties: list[tuple[str, str, Layer]], wanted: str | None) -> tuple[str, str, Layer]:
    if wanted is None:
        return beauties[0]
    if len(beauties) == 1 and not _label(*beauties[0][:2]):
        return beauties[0]  # a file with one view that has no name: it is the one that is meant
    for view, group, layer in beauties:
        if wanted in (view, group, _label(view, group)):
            return view, group, layer
    known = ", ".join(dict.fromkeys(_label(v, g) or "(unnamed)" for v, g, _ in beauties))
    raise InputError(f"{file.path}: no view or view layer {wanted!r}; the file has {known}")


def _spp(renderer: dict[str, Any], file: ExrFile, group: str) -> float | None:
    for rule in renderer.get("spp", ()):
        matches = {k: v for k, v in file.metadata.items() if re.search(rule["attribute"], k)}
        # Blender writes one entry a view layer: prefer ours.
        keys = [k for k in matches if group and group in k] or list(matches)
        if keys:
            try:
                return float(matches[keys[0]]) ** rule.get("power", 1)
            except (TypeError, ValueError):
                return None
    return None


def _check_variance(resolution: MappedRender) -> None:
    source = resolution.features.get(VARIANCE)
    if source is None:
        return
    if source.kind in ("per_sample", "relative", "second_moment") and not resolution.spp:
        del resolution.features[VARIANCE]
        resolution.notes.append(
            f"variance: '{source.text}' is {source.kind.replace('_', ' ')}, which needs the samples per pixel; "
            "the header does not say, so it is defaulted (give --hr-spp)"
        )


def _decide_normal_encoding(resolution: MappedRender) -> None:
    """Look into the pixels where the table can't say whether normals are signed or n * 0.5 + 0.5."""
    source = resolution.features.get(NORMAL)
    if source is None or source.encoding != "auto":
        return
    window = resolution.data_window
    middle = window.y0 + window.height // 2
    rows = Window(window.x0, max(window.y0, middle - 32), window.x1, min(window.y1, middle + 32))
    normal = resolution.file.read(source.terms[0], rows).reshape(-1, 3)
    normal = normal[np.isfinite(normal).all(axis=1) & (np.abs(normal).max(axis=1) > 0)]

    def unit(vectors: Array) -> float:
        return float(np.mean(np.abs(np.linalg.norm(vectors, axis=1) - 1) < 0.1)) if len(vectors) else 0.0

    unsigned = len(normal) > 0 and normal.min() >= 0 and unit(normal * 2 - 1) > unit(normal)
    resolution.features[NORMAL] = replace(source, encoding="unsigned" if unsigned else "signed")
