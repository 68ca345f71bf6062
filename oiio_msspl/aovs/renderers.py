# SPDX-License-Identifier: Apache-2.0
"""The table of renderers (``renderers.toml``): which renderer wrote a file, and how it names its layers."""

from __future__ import annotations

import math
import re
import tomllib
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from oiio_msspl.exr.layers import Layer, same_spelling
from oiio_msspl.exr.reader import ExrFile


@lru_cache(maxsize=1)
def renderers() -> list[dict[str, Any]]:
    """The entries of ``renderers.toml``, most specific renderer first; the last one matches every file."""
    text = resources.files("oiio_msspl.aovs").joinpath("renderers.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["renderer"])


def detect_renderer(file: ExrFile, layers: list[Layer]) -> dict[str, Any]:
    """The entry of the renderer that wrote a file, by its layers, header attributes and file name."""
    return next(
        renderer for renderer in renderers() if any(_holds(condition, file, layers) for condition in renderer["detect"])
    )


def samples_per_pixel(renderer: dict[str, Any], file: ExrFile, view_layer: str) -> float | None:
    """Samples per pixel as the header says; None if it says nothing, or no number above 0.

    Args:
        renderer: entry of the table.
        file: the render.
        view_layer: the one that was chosen: Blender writes one attribute for each.
    """
    for rule in renderer.get("spp", ()):
        found = [match for key in file.metadata if (match := re.search(rule["attribute"], key))]
        if found:
            match = next((match for match in found if view_layer in match.groups()), found[0])
            try:
                spp = float(file.metadata[match.string]) ** rule.get("power", 1)
            except (TypeError, ValueError, OverflowError):
                return None
            return spp if 0 < spp < math.inf else None
    return None


def layer_of_source(renderer: dict[str, Any], file: ExrFile, aov: str) -> str | None:
    """The layer that holds an AOV under another name, as the header says; None if it names none or several.

    Several layers hold the same AOV where lights are split into groups: none of them is the whole.
    """
    rule = re.compile(renderer["source"]) if "source" in renderer else None
    found = {
        match[1]
        for key, value in file.metadata.items()
        if rule and (match := rule.search(key)) and same_spelling(str(value)) == same_spelling(aov)
    }
    return found.pop() if len(found) == 1 else None


def view_layer_of(layer: str, alias: str) -> str | None:
    """The view layer in front of ``alias`` in a layer's name.

    Names are compared without case, spaces, ``_`` and ``-``; ``*`` in the alias matches any text.

    Returns:
        ``ViewLayer`` for ``ViewLayer.Combined`` and the alias ``combined``; empty if the layer has just the alias as
        its name; None if it is another layer.
    """
    name, wanted = same_spelling(layer), same_spelling(alias)
    if name == wanted or ("*" in wanted and fnmatchcase(name, wanted)):
        return ""
    if wanted and name.endswith("." + wanted):
        # Cut the stored name as many dots from its end as the alias takes.
        return layer.rsplit(".", wanted.count(".") + 1)[0]
    return None


def _holds(condition: dict[str, Any], file: ExrFile, layers: list[Layer]) -> bool:
    """Whether all that an entry of ``detect`` asks for is true of a file."""
    for alias in condition.get("layers", ()):
        if all(view_layer_of(layer.name, alias) is None for layer in layers):
            return False
    for key, value in condition.get("attributes", {}).items():
        if not any(re.search(key, k) and re.search(value, str(v)) for k, v in file.metadata.items()):
            return False
    return _holds_by_name(condition, file.path)


def _holds_by_name(condition: dict[str, Any], path: Path) -> bool:
    """Whether all is true that an entry of ``detect`` asks for of a file's name and of what lies beside it."""
    if "sibling" in condition and not siblings_of(path, condition["sibling"])[0].is_file():
        return False
    return bool(re.search(condition.get("file", ""), path.stem))


def siblings_of(path: Path, name: str) -> list[Path]:
    """Where a renderer that writes a file for each AOV may have put one, beside the beauty ``path``: the file that
    belongs to this beauty by its name first."""
    return [path.with_name(f"{stem}.exr") for stem in (f"{path.stem}.{name}", name)]


def sibling_of(path: Path, name: str) -> Path | None:
    """The file of an AOV beside the beauty ``path``, see :func:`siblings_of`; None if there is none."""
    return next((each for each in siblings_of(path, name) if each != path and each.is_file()), None)


def aov_files(path: Path) -> set[Path]:
    """The files of AOVs beside the beauty ``path``, as far as names tell: the beauty is not opened."""
    found = (
        sibling_of(path, name)
        for renderer in renderers()
        if (names := _file_names(renderer)) and any(_holds_by_name(each, path) for each in renderer["detect"])
        for name in names
    )
    return {each for each in found if each is not None}


def _file_names(entry: object) -> set[str]:
    """The AOVs that an entry of the table, or a part of one, reads from files of their own: ``file:AOV``."""
    if isinstance(entry, str):
        return {entry.removeprefix("file:")} if entry.startswith("file:") else set()
    parts = entry.values() if isinstance(entry, dict) else entry if isinstance(entry, list) else ()
    return set().union(*map(_file_names, parts))
