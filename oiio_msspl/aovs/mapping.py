# SPDX-License-Identifier: Apache-2.0
"""From what a renderer calls its layers to the features of :mod:`oiio_msspl.aovs.features`.

The knowledge is data (``aovs.toml``); this module matches it against the layers of a file, and reads features in the
units of the schema: composites by the paper's equations, variances brought to the variance of the pixel's mean
luminance, normals to signed vectors. Whatever it chose is kept as text for the user.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import FEATURES, NORMAL, RGB, VARIANCE
from oiio_msspl.errors import InputError

VARIANCE_KINDS = ("mean", "per_sample", "relative", "second_moment", "deviation")
NORMAL_ENCODINGS = ("signed", "unsigned", "auto")


def read_map_file(path: str | Path) -> dict[str, Any]:
    """A user's mapping: a TOML file with ``feature = candidate`` lines, as in the table.

    A full name in it (``file:masks/albedo.exr``) begins at the TOML file's own folder.

    Raises:
        InputError: unreadable, or an entry that is no candidate.
    """
    try:
        mapping = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: can't be read as a mapping ({error})") from error
    folder = Path(path).absolute().parent
    return {name: _full_paths(each, folder) for name, each in check_mapping(mapping, str(path)).items()}


def parse_map_options(options: Iterable[str]) -> dict[str, Any]:
    """``--map feature=layer`` options; ``layer`` may be a sum (``lighting+GI``) or another EXR file.

    Raises:
        InputError: no ``=``, no such feature, or a form that the feature can't take.
    """
    mapping: dict[str, Any] = {}
    for option in options:
        feature, equals, layer = option.partition("=")
        if not equals or not layer:
            raise InputError(f"--map {option!r}: write it as feature=layer, e.g. --map albedo=my_albedo")
        if layer.lower().endswith(".exr"):
            mapping[feature] = f"file:{Path(layer).absolute()}"  # a farm's worker reads it in another folder
        else:
            mapping[feature] = {"sum": layer.split("+")} if "+" in layer else layer
    return check_mapping(mapping, "--map")


def _full_paths(candidate: Any, folder: Path) -> Any:
    """A candidate whose EXRs are named from a folder, with their full paths."""
    if isinstance(candidate, dict):
        return {key: _full_paths(value, folder) for key, value in candidate.items()}
    if isinstance(candidate, list):
        return [_full_paths(each, folder) for each in candidate]
    is_exr = isinstance(candidate, str) and candidate.startswith("file:") and candidate.lower().endswith(".exr")
    return f"file:{folder / candidate.removeprefix('file:')}" if is_exr else candidate


#: Keys of a candidate, and whether their value is a list of names.
_FORMS = {"layer": False, "sum": True, "halves": True, "channels": True}
_EXTRAS = {"times", "kind", "encoding", "note"}


def check_mapping(mapping: dict[str, Any], where: str) -> dict[str, Any]:
    """Return a mapping whose entries all have a form that :func:`map_render` understands.

    Raises:
        InputError: one has not; the message starts with ``where``.
    """
    for feature, candidate in mapping.items():
        if feature not in FEATURES:
            raise InputError(f"{where}: {feature!r} is no feature; use one of {', '.join(FEATURES)}")
        problem = _problem(feature, candidate)
        if problem:
            raise InputError(f"{where}: {feature}: {problem}")
    return mapping


def _problem(feature: str, candidate: Any) -> str | None:
    """What is wrong with a candidate, or None."""
    if isinstance(candidate, str):
        is_file = candidate.startswith("file:")
        return "the beauty must be a layer of the render itself" if feature == RGB and is_file else None
    if not isinstance(candidate, dict):
        return f"{candidate!r} is neither a layer's name nor a table such as {{ sum = ['a', 'b'] }}"
    forms = [key for key in candidate if key in _FORMS]
    unknown = candidate.keys() - _FORMS.keys() - _EXTRAS
    if len(forms) != 1 or unknown:
        return f"has {', '.join(candidate) or 'nothing'}; give one of {', '.join(_FORMS)}, and {', '.join(_EXTRAS)}"
    names = candidate[forms[0]]
    is_list = isinstance(names, list) and len(names) > 0 and all(isinstance(n, str) for n in names)
    if _FORMS[forms[0]] != is_list or not (is_list or isinstance(names, str)):
        return f"{forms[0]} must be {'a list of names' if _FORMS[forms[0]] else 'a name'}"
    if not isinstance(candidate.get("times", ""), str):
        return "times must be a name"
    if feature == RGB and (forms[0] != "layer" or "times" in candidate):
        return "the beauty is replaced by the result, so it must be a single layer"
    if feature == VARIANCE and (forms[0] == "sum" or "times" in candidate):
        return "variances don't add up layer by layer; give one layer, or two halves"
    if forms[0] == "halves" and (feature != VARIANCE or len(names) != 2):
        return "halves are the two half buffers of a variance"
    if forms[0] == "channels" and len(names) not in ((1, 3) if feature == VARIANCE else (3,)):
        return f"has {len(names)} channels, not 3"
    if "kind" in candidate and (feature != VARIANCE or candidate["kind"] not in VARIANCE_KINDS):
        return f"kind {candidate['kind']!r}: of a variance, use one of {', '.join(VARIANCE_KINDS)}"
    if "encoding" in candidate and (feature != NORMAL or candidate["encoding"] not in NORMAL_ENCODINGS):
        return f"encoding {candidate['encoding']!r}: of a normal, use one of {', '.join(NORMAL_ENCODINGS)}"
    return None
