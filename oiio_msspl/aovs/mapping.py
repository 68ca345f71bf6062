# SPDX-License-Identifier: Apache-2.0
"""The user's own mapping of layers to features: ``--map`` options and TOML files, and checking them.

A mapping gives one candidate for each feature, written as in ``renderers.toml``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import FEATURES, NORMAL, RGB, VARIANCE
from oiio_msspl.errors import InputError

#: What a variance layer may hold; ``renderers.toml`` explains each.
VARIANCE_KINDS = ("mean", "per_sample", "relative", "second_moment", "deviation")
#: How a normal layer may be stored; ``auto`` decides by the pixels.
NORMAL_ENCODINGS = ("signed", "unsigned", "auto")

#: Bytes of the largest file that is read as a mapping.
LARGEST_MAP_FILE = 1 << 20

#: Keys that say which layers a candidate reads, and whether their value is a list of names. A candidate has one.
_FORMS = {"layer": False, "sum": True, "halves": True, "channels": True}
#: Keys that a candidate may have beside one of these.
_EXTRAS = {"times", "kind", "encoding", "note"}


def read_map_file(path: str | Path) -> dict[str, Any]:
    """Read a user's mapping: a TOML file with lines ``feature = candidate``.

    EXR files in it (``file:masks/albedo.exr``) are relative to the folder of the TOML file.

    Returns:
        Candidates by feature, with full paths.

    Raises:
        InputError: the file can't be read, or an entry is not a candidate.
    """
    try:
        mapping = tomllib.loads(_read_text(Path(path)))
    except (OSError, ValueError) as error:  # text that is not UTF-8, a mistake in the TOML, a number of 5,000 digits
        raise InputError(f"{path}: can't be read as a mapping ({error})") from error
    except RecursionError as error:
        raise InputError(f"{path}: can't be read as a mapping (its tables are nested too deeply)") from error
    folder = Path(path).absolute().parent
    return {name: _full_paths(each, folder) for name, each in check_mapping(mapping, str(path)).items()}


def _read_text(path: Path) -> str:
    """The text of a small file. Devices such as /dev/zero never end."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size > LARGEST_MAP_FILE:
        raise InputError(f"{path}: is too large for a mapping; name a TOML file with a line for each feature")
    return path.read_text(encoding="utf-8")


def parse_map_options(options: Iterable[str]) -> dict[str, Any]:
    """Parse ``--map feature=layer`` options. ``layer`` may also be a sum (``lighting+GI``), an EXR file
    (``other.exr``) or a layer of one (``other.exr:albedo``).

    Returns:
        Candidates by feature, with full paths: a farm's worker reads them in another folder.

    Raises:
        InputError: there is no ``=`` or no such feature, or the feature can't be read in this form.
    """
    mapping: dict[str, Any] = {}
    for option in options:
        feature, equals, layer = option.partition("=")
        if not equals or not layer:
            raise InputError(f"--map {option!r}: write it as feature=layer, e.g. --map albedo=my_albedo")
        if feature in mapping:
            raise InputError(f"--map {option!r}: {feature} is mapped twice; give one layer, or a sum such as a+b")
        if is_exr(layer):
            mapping[feature] = f"file:{Path(layer).absolute()}"
        else:
            mapping[feature] = {"sum": layer.split("+")} if "+" in layer else layer
    return check_mapping(mapping, "--map")


def split_exr(text: str) -> tuple[str, str]:
    """The file and the layer of ``other.exr:albedo``; the layer is empty if none is named.

    The file is empty if ``text`` names no EXR.
    """
    match = re.fullmatch(r"(.*?\.exr)(?::(.*))?", text, re.IGNORECASE | re.DOTALL)
    return (match[1], match[2] or "") if match else ("", text)


def is_exr(text: str) -> bool:
    """Whether ``text`` names an EXR, perhaps with a layer of it."""
    return bool(split_exr(text)[0])


def check_mapping(mapping: dict[str, Any], where: str) -> dict[str, Any]:
    """Check that all entries of a mapping are candidates that their features can be read from.

    Args:
        mapping: candidates by feature.
        where: what the message starts with, such as the path of the file.

    Returns:
        ``mapping``.

    Raises:
        InputError: one of the entries is not.
    """
    for feature, candidate in mapping.items():
        if feature not in FEATURES:
            raise InputError(f"{where}: {feature!r} is not a feature; use one of {', '.join(FEATURES)}")
        problem = _problem(feature, candidate)
        if problem:
            raise InputError(f"{where}: {feature}: {problem}")
    return mapping


def _full_paths(candidate: Any, folder: Path) -> Any:
    """A candidate with its EXR files, which are relative to ``folder``, as full paths."""
    if isinstance(candidate, dict):
        return {key: _full_paths(value, folder) for key, value in candidate.items()}
    if isinstance(candidate, list):
        return [_full_paths(each, folder) for each in candidate]
    if isinstance(candidate, str) and candidate.startswith("file:") and is_exr(candidate):
        return f"file:{folder / candidate.removeprefix('file:')}"
    return candidate


def _problem(feature: str, candidate: Any) -> str | None:
    """What is wrong with a candidate, or None."""
    if isinstance(candidate, str):
        is_file = candidate.startswith("file:")
        if feature == RGB and is_file:
            return "the beauty must be a layer of the render itself"
        return None if is_file else _problem_of_name(candidate)
    if not isinstance(candidate, dict):
        return f"{str(candidate)[:80]} is neither a layer's name nor a table such as {{ sum = ['a', 'b'] }}"
    return _problem_of_form(candidate) or _problem_of_feature(feature, candidate)


def _problem_of_name(name: str) -> str | None:
    """What is wrong with a layer's name, or None. Wildcards are for the table of renderers."""
    return f"{name!r} is a pattern; name one layer" if set("*?") & set(name) else None


def _problem_of_form(candidate: dict[str, Any]) -> str | None:
    """What is wrong with the keys of a candidate and the types of their values, or None."""
    forms = [key for key in candidate if key in _FORMS]
    unknown = candidate.keys() - _FORMS.keys() - _EXTRAS
    if len(forms) != 1 or unknown:
        return (
            f"has {', '.join(candidate) or 'nothing'}; give one of {', '.join(_FORMS)}, "
            f"and perhaps {', '.join(sorted(_EXTRAS))}"
        )
    form = forms[0]
    names = candidate[form]
    is_list = isinstance(names, list) and len(names) > 0 and all(isinstance(n, str) for n in names)
    if _FORMS[form] != is_list or not (is_list or isinstance(names, str)):
        return f"{form} must be {'a list of names' if _FORMS[form] else 'a name'}"
    if not isinstance(candidate.get("times", ""), str):
        return "times must be a name"
    if not isinstance(candidate.get("note", ""), str):
        return "note must be a text"
    return None


def _problem_of_feature(feature: str, candidate: dict[str, Any]) -> str | None:
    """Why a feature can't be read from a candidate of valid form, or None."""
    form = next(key for key in candidate if key in _FORMS)
    count = len(candidate[form])
    kind, encoding = candidate.get("kind"), candidate.get("encoding")
    if feature == RGB and (form != "layer" or "times" in candidate):
        return "the result replaces the beauty, so it must be a single layer"
    if feature == VARIANCE and (form == "sum" or "times" in candidate):
        return "variances don't add up layer by layer; give one layer, or two halves"
    if form == "halves" and (feature != VARIANCE or count != 2):
        return "halves are the two half buffers of a variance"
    if form == "channels" and count not in ((1, 3) if feature == VARIANCE else (3,)):
        return f"has {count} channels, not 3"
    if "kind" in candidate and (feature != VARIANCE or kind not in VARIANCE_KINDS):
        return f"kind {kind!r}: only a variance has a kind, one of {', '.join(VARIANCE_KINDS)}"
    if "encoding" in candidate and (feature != NORMAL or encoding not in NORMAL_ENCODINGS):
        return f"encoding {encoding!r}: only a normal has an encoding, one of {', '.join(NORMAL_ENCODINGS)}"
    return None
