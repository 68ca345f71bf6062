# SPDX-License-Identifier: Apache-2.0
"""Read the table of renderers (``renderers.toml``): which renderer wrote a file, and how it names its layers."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import ALBEDO, NORMAL, OPTIONAL_FEATURES, PAPER_FEATURES
from oiio_msspl.exr.layers import Layer, same_spelling
from oiio_msspl.exr.reader import ExrFile

#: The words of a file's or folder's name that mean the beauty, where every AOV has a file of its own.
_BEAUTY_WORD = re.compile(r"(?<![^\W_])(beauty|rgba?|combined|main|c|ci|image)(?![^\W_])", re.IGNORECASE)
#: The end of a file's stem from its frame number on.
_FRAME_NUMBER = re.compile(r"([._ -]-?\d+)?$")


@lru_cache(maxsize=1)
def renderers() -> list[dict[str, Any]]:
    """Return the entries of ``renderers.toml``, most specific renderer first; the last one matches every file."""
    text = resources.files("oiio_msspl.aovs").joinpath("renderers.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["renderer"])


def detect_renderer(file: ExrFile, layers: list[Layer]) -> dict[str, Any]:
    """Find the entry of the renderer that wrote a file, by layers, header attributes and file name."""
    return next(entry for entry in renderers() if any(_holds(rule, file, layers) for rule in entry["detect"]))


def candidates_of(renderer: Mapping[str, Any], feature: str) -> list[Any]:
    """Return the candidates of a feature: those of the renderer, and then the names that mean the same nearly anywhere.

    Light passes and variances have no such names: V-Ray's ``diffuse`` is the colour of the surface.
    """
    own, common = renderer.get(feature, []), renderers()[-1]
    return own if feature in PAPER_FEATURES or renderer is common else [*own, *common[feature]]


def known_as_other(renderer: Mapping[str, Any]) -> Callable[[str], bool]:
    """Return what tells by the table whether a layer of a name is something else than a beauty."""
    keys = (*OPTIONAL_FEATURES, "sets", "motion", "position", "data")
    entries = [entry.get(key, []) for entry in (renderer, renderers()[-1]) for key in keys]
    names = {same_spelling(name) for entry in entries for name in _names_in(entry)}
    patterns = [name for name in names if "*" in name]

    def is_known(layer: str) -> bool:
        name = same_spelling(layer.removesuffix(".000"))
        words = name.split(".")
        ends = (".".join(words[start:]) for start in range(len(words)))  # a view layer may stand in front
        return not names.isdisjoint(ends) or any(fnmatchcase(name, pattern) for pattern in patterns)

    return is_known


def _names_in(entry: object) -> Iterator[str]:
    """Yield the names and patterns of layers in a candidate, or in a list of candidates."""
    if isinstance(entry, str):
        yield entry
    elif isinstance(entry, Mapping | list):
        keys = ("layer", "layers", "sum", "times")
        for element in [entry.get(key, []) for key in keys] if isinstance(entry, Mapping) else entry:
            yield from _names_in(element)


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


def names_of_aov(renderer: Mapping[str, Any], file: ExrFile, aov: str) -> list[str]:
    """Return the names that the layer of an AOV may have: its own one, and that which the header gives.

    V-Ray's header tells the type of every layer, so it comes first. Elsewhere a layer that is called like the AOV does.
    Several layers hold one AOV if lights are split into groups: none of the layers is the whole AOV.
    """
    if (number := renderer.get("types", {}).get(aov)) is not None:
        typed: list[str] = []
        with suppress(ValueError, AttributeError, RecursionError):  # no such attribute, or other contents
            elements = json.loads(str(file.metadata.get(renderer["types"]["attribute"])))
            typed = [name for name, element in elements.items() if element.get("alias") == number]
        return [*typed, aov] if len(typed) == 1 else [aov]
    if "source" not in renderer:
        return [aov]
    named = (key for key, value in file.metadata.items() if same_spelling(str(value)) == same_spelling(aov))
    layers = {match[1] for key in named if (match := re.search(renderer["source"], key))}
    return [aov, *layers] if len(layers) == 1 else [aov]


def view_layer_of(layer: str, alias: str) -> str | None:
    """Return the view layer in front of ``alias`` in the name of an EXR layer; None if it means another layer.

    It is ``ViewLayer`` for the layer ``ViewLayer.Combined`` and the alias ``combined``, and empty if the alias is the
    whole name. Names are compared without case, spaces, ``_`` and ``-``; ``*`` in the alias matches any text. 3Delight
    puts ``.000`` behind a layer's name.
    """
    layer = layer.removesuffix(".000")
    name, wanted = same_spelling(layer), same_spelling(alias)
    if name == wanted or ("*" in wanted and fnmatchcase(name, wanted)):
        return ""
    if wanted and name.endswith("." + wanted):
        # Cut as many dots from the end of the stored name as the alias takes.
        return layer.rsplit(".", wanted.count(".") + 1)[0]
    return None


def best_spelled(layers: Iterable[Layer], alias: str) -> Layer | None:
    """Return the layer that has exactly the spelling of an alias, or else the first one; None if there are none."""
    return min(layers, key=lambda layer: not layer.name.endswith(alias), default=None)


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
    return [path.with_name(f"{path.stem}.{aov}.exr"), path.with_name(f"{aov}.exr")]


def sibling_of(path: Path, aov: str) -> Path | None:
    """Return the file of an AOV beside the beauty ``path``; None if it does not exist."""
    return next((file for file in siblings_of(path, aov) if file != path and file.is_file()), None)


def file_beside(path: Path, aov: str) -> Path | None:
    """Return the file of an AOV whose name, or whose folder's, differs from that of the beauty ``path`` by one word.

    Beside ``beauty/shot_beauty.1001.exr`` it is ``albedo/shot_albedo.1001.exr`` or the like, beside ``shot.1001.exr``
    it is ``shot_albedo.1001.exr`` or ``shot.albedo.1001.exr``. None if there is no such file.
    """
    folder, head = path.parent.absolute(), _FRAME_NUMBER.sub("", path.stem)
    folders = [folder, *(folder.with_name(name) for name in _with_word(folder.name, aov))]
    stems = [*_with_word(path.stem, aov), path.stem]
    files = [place / f"{stem}.exr" for place in folders for stem in stems]
    files += [folder / f"{head}{sign}{aov}{path.stem[len(head) :]}.exr" for sign in "_." if head]
    return next((file for file in files if file != path.absolute() and file.is_file()), None)


def _with_word(name: str, aov: str) -> list[str]:
    """Return a name with an AOV in the place of each word that means the beauty."""
    return [name[: word.start()] + aov + name[word.end() :] for word in _BEAUTY_WORD.finditer(name)]


def aov_files(path: Path) -> set[Path]:
    """Find the files of AOVs beside the beauty ``path`` by names, without opening the beauty."""
    by_name = [entry for entry in renderers() if any(_holds_by_name(rule, path) for rule in entry["detect"])]
    siblings = {sibling_of(path, name) for entry in by_name for name in file_names(entry)}
    common = renderers()[-1]
    layers = [entry_of(candidate).get("layer", "") for candidate in [*common[ALBEDO], *common[NORMAL]]]
    beside = {file_beside(path, name.removeprefix("beside:")) for name in layers if name.startswith("beside:")}
    return {file for file in siblings | beside if file}


def file_names(entry: Mapping[str, Any]) -> list[str]:
    """Return NAME for every ``file:NAME`` in a mapping, or in an entry of the table."""
    return [name.removeprefix("file:") for name in _names_in([*entry.values()]) if name.startswith("file:")]
