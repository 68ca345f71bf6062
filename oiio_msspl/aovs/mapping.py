# SPDX-License-Identifier: Apache-2.0
"""Read and check the user's own mapping of layers to features: ``--map`` options and TOML files.

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

#: Encodings of normal layers; ``auto`` decides by the pixels.
NORMAL_ENCODINGS = ("signed", "unsigned", "auto")

#: Keys that say which layers a candidate reads, and whether their value is a list of names. A candidate has one.
_FORMS = {"layer": False, "sum": True, "channels": True}
#: Further keys of a candidate.
_EXTRAS = {"times", "encoding", "note", "of"}
#: What a variance may be of, if it is not that of the pixel's mean.
SAMPLES = "samples"


def read_map_file(path: str | Path) -> dict[str, Any]:
    """Read a user's mapping, candidates by feature: a TOML file with lines ``feature = candidate``.

    Its EXR files (``file:masks/albedo.exr``) are relative to the folder of the TOML file; the result has full paths.
    """
    path = Path(path)
    try:
        if not path.is_file():  # devices such as /dev/zero never end
            problem = "is a folder" if path.is_dir() else "is no ordinary file" if path.exists() else "no such file"
            raise InputError(f"{path}: {problem}; name a TOML file with a line for each feature")
        mapping = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:  # text that is not UTF-8, a mistake in the TOML, a number of 5,000 digits
        raise InputError(f"{path}: can't be read as a mapping ({error})") from error
    except RecursionError as error:
        raise InputError(f"{path}: can't be read as a mapping (its tables are nested too deeply)") from error
    return _full_paths(check_mapping(mapping, str(path)), path.absolute().parent)


def parse_map_options(options: Iterable[str]) -> dict[str, Any]:
    """Parse ``--map feature=layer`` options into candidates by feature.

    ``layer`` may be a sum (``lighting+GI``), an EXR (``a.exr``) or a layer of it (``a.exr:albedo``). Paths become full
    paths, because a farm's worker reads them in another folder.
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
    """Split ``other.exr:albedo`` into file and layer. The file is empty if no EXR is named, the layer if none is."""
    match = re.fullmatch(r"(.*?\.exr)(?::(.*))?", text, re.IGNORECASE | re.DOTALL)
    return (match[1], match[2] or "") if match else ("", text)


def is_exr(text: str) -> bool:
    """Return whether ``text`` names an EXR, perhaps with a layer of it."""
    return bool(split_exr(text)[0])


def check_mapping(mapping: dict[str, Any], where: str) -> dict[str, Any]:
    """Return a mapping, or raise InputError if a feature is unknown or can't be read from its candidate.

    ``where`` is the beginning of the message, such as the path of the file.
    """
    for feature, candidate in mapping.items():
        if feature not in FEATURES:
            raise InputError(f"{where}: {feature!r} is not a feature; use one of {', '.join(FEATURES)}")
        if problem := _problem(feature, candidate):
            raise InputError(f"{where}: {feature}: {problem}")
    return mapping


def _full_paths(value: Any, folder: Path) -> Any:
    """Make the paths of EXRs in a mapping, which are relative to ``folder``, absolute."""
    if isinstance(value, dict):
        return {key: _full_paths(element, folder) for key, element in value.items()}
    if isinstance(value, list):
        return [_full_paths(element, folder) for element in value]
    if isinstance(value, str) and value.startswith("file:") and is_exr(value):
        return f"file:{folder / value.removeprefix('file:')}"
    return value


def _problem(feature: str, candidate: Any) -> str | None:
    """Say why a feature can't be read from a candidate, or return None."""
    if isinstance(candidate, str):
        if candidate.startswith("file:"):
            return "the beauty must be a layer of the render itself" if feature == RGB else None
        # Wildcards are for the table of renderers.
        return f"{candidate!r} is a pattern; name one layer" if set("*?") & set(candidate) else None
    if not isinstance(candidate, dict):
        return f"{str(candidate)[:80]} is neither a layer's name nor a table such as {{ sum = ['a', 'b'] }}"
    return _problem_of_form(candidate) or _problem_of_feature(feature, candidate)


def _problem_of_form(candidate: dict[str, Any]) -> str | None:
    """Check the keys of a candidate and the types of their values."""
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
    for key, kind in (("times", "name"), ("note", "text")):
        if not isinstance(candidate.get(key, ""), str):
            return f"{key} must be a {kind}"
    return None


def _problem_of_feature(feature: str, candidate: dict[str, Any]) -> str | None:
    """Check whether a feature can be read from a candidate of valid form."""
    form = next(key for key in candidate if key in _FORMS)
    count = len(candidate[form])
    encoding = candidate.get("encoding")
    if feature == RGB and (form != "layer" or "times" in candidate):
        return "the result replaces the beauty, so it must be a single layer"
    if feature == VARIANCE and (form == "sum" or "times" in candidate):
        return "variances don't add up layer by layer; give one layer"
    if form == "channels" and count not in ((1, 3) if feature == VARIANCE else (3,)):
        return f"has {count} channels, not 3"
    if "of" in candidate and (feature != VARIANCE or candidate["of"] != SAMPLES):
        return f"of {candidate['of']!r}: only a variance may be of {SAMPLES!r}"
    if "encoding" in candidate and (feature != NORMAL or encoding not in NORMAL_ENCODINGS):
        return f"encoding {encoding!r}: only a normal has an encoding, one of {', '.join(NORMAL_ENCODINGS)}"
    return None
