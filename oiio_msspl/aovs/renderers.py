# SPDX-License-Identifier: Apache-2.0
"""Read the table of renderers (``renderers.toml``): which renderer wrote a file, and how it names its layers."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from oiio_msspl.exr.layers import Layer, same_spelling
from oiio_msspl.exr.reader import ExrFile


@lru_cache(maxsize=1)
def renderers() -> list[dict[str, Any]]:
    """Return the entries of ``renderers.toml``, most specific renderer first; the last one matches every file."""
    text = resources.files("oiio_msspl.aovs").joinpath("renderers.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["renderer"])


def detect_renderer(file: ExrFile, layers: list[Layer]) -> dict[str, Any]:
    """Find the entry of the renderer that wrote a file, by layers, header attributes and file name."""
    return next(entry for entry in renderers() if any(_holds(rule, file, layers) for rule in entry["detect"]))


def entry_of(candidate: str | Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a candidate as a table: a plain name means ``{ layer = name }``."""
    return {"layer": candidate} if isinstance(candidate, str) else candidate


def samples_per_pixel(renderer: dict[str, Any], file: ExrFile, view_layer: str) -> float | None:
    """Read the samples per pixel from the header; None if it does not say, or says no number above 0.

    Blender writes an attribute for each view layer.
    """
    for rule in renderer.get("spp", ()):
        matches = [match for key in file.metadata if (match := re.search(rule["attribute"], key))]
        if matches:
            match = next((match for match in matches if view_layer in match.groups()), matches[0])
            try:
                spp = float(file.metadata[match.string]) ** rule.get("power", 1)
            except (TypeError, ValueError, OverflowError):
                return None
            return spp if 0 < spp < math.inf else None
    return None


def layer_of_source(renderer: dict[str, Any], file: ExrFile, aov: str) -> str | None:
    """Return the layer that by the header holds an AOV under another name; None if none or several do.

    Several layers hold one AOV if lights are split into groups: none of the layers is the whole AOV.
    """
    if "source" not in renderer:
        return None
    named = (key for key, value in file.metadata.items() if same_spelling(str(value)) == same_spelling(aov))
    layers = {match[1] for key in named if (match := re.search(renderer["source"], key))}
    return layers.pop() if len(layers) == 1 else None


def view_layer_of(layer: str, alias: str) -> str | None:
    """Return the view layer in front of ``alias`` in the name of an EXR layer; None if it means another layer.

    It is ``ViewLayer`` for the layer ``ViewLayer.Combined`` and the alias ``combined``, and empty if the alias is the
    whole name. Names are compared without case, spaces, ``_`` and ``-``; ``*`` in the alias matches any text.
    """
    name, wanted = same_spelling(layer), same_spelling(alias)
    if name == wanted or ("*" in wanted and fnmatchcase(name, wanted)):
        return ""
    if wanted and name.endswith("." + wanted):
        # Cut as many dots from the end of the stored name as the alias takes.
        return layer.rsplit(".", wanted.count(".") + 1)[0]
    return None


def _holds(rule: dict[str, Any], file: ExrFile, layers: list[Layer]) -> bool:
    """Return whether all conditions of an entry of ``detect`` are true of a file."""
    return (
        all(any(view_layer_of(layer.name, alias) is not None for layer in layers) for alias in rule.get("layers", ()))
        and all(
            any(re.search(name, key) and re.search(value, str(stored)) for key, stored in file.metadata.items())
            for name, value in rule.get("attributes", {}).items()
        )
        and _holds_by_name(rule, file.path)
    )


def _holds_by_name(rule: dict[str, Any], path: Path) -> bool:
    """Return whether the conditions of an entry of ``detect`` on file names are true."""
    if "sibling" in rule and not siblings_of(path, rule["sibling"])[0].is_file():
        return False
    return bool(re.search(rule.get("file", ""), path.stem))


def siblings_of(path: Path, aov: str) -> list[Path]:
    """Return the possible files of an AOV beside the beauty ``path``; the one named after the beauty comes first."""
    return [path.with_name(f"{stem}.exr") for stem in (f"{path.stem}.{aov}", aov)]


def sibling_of(path: Path, aov: str) -> Path | None:
    """Return the file of an AOV beside the beauty ``path``; None if it does not exist."""
    return next((file for file in siblings_of(path, aov) if file != path and file.is_file()), None)


def aov_files(path: Path) -> set[Path]:
    """Find the files of AOVs beside the beauty ``path`` by names, without opening the beauty."""
    names: set[str] = set()
    for renderer in renderers():
        aovs = set(file_names(renderer))
        if aovs and any(_holds_by_name(rule, path) for rule in renderer["detect"]):
            names |= aovs
    return {file for name in names if (file := sibling_of(path, name))}


def file_names(entry: object) -> Iterator[str]:
    """Yield NAME for every ``file:NAME`` in a candidate, a mapping, or an entry of the table."""
    if isinstance(entry, str) and entry.startswith("file:"):
        yield entry.removeprefix("file:")
    elif isinstance(entry, Mapping | list):
        for element in entry.values() if isinstance(entry, Mapping) else entry:
            yield from file_names(element)
