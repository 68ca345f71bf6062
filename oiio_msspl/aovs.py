# SPDX-License-Identifier: Apache-2.0
"""From what a renderer calls its layers to the features of :mod:`oiio_msspl.schema`.

The knowledge is data (``aovs.toml``); this module matches it against the layers of a file, and reads features in the
units of the schema: composites by the paper's equations, variances brought to the variance of the pixel's mean
luminance, normals to signed vectors. Whatever it chose is kept as text for the user.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl import schema
from oiio_msspl.errors import InputError
from oiio_msspl.exr import BAND, Channel, ExrFile, open_exr
from oiio_msspl.render import Array, Render, Window
from oiio_msspl.transforms import luminance

FEATURES = tuple(schema.HRLS_FEATURES)
VARIANCE_KINDS = ("mean", "per_sample", "relative", "second_moment", "deviation")
NORMAL_ENCODINGS = ("signed", "unsigned", "auto")

#: Part names that say nothing about a layer: their channels without a prefix are plain R, G, B.
_PLAIN_PART = re.compile(r"(rgba?|main|default|image|part ?\d+|subimage ?\d+)?", re.IGNORECASE)
_COMPONENTS = {"r": "R", "red": "R", "g": "G", "green": "G", "b": "B", "blue": "B", "a": "A", "alpha": "A"}
_COMPONENTS |= {c: c.upper() for c in "xyz"}
_TRIPLES = (("R", "G", "B"), ("X", "Y", "Z"))


@dataclass
class Layer:
    """Channels that belong together: one layer of one view, whatever parts they lie in."""

    name: str
    view: str
    channels: dict[str, Channel] = field(default_factory=dict)
    """By component: ``R``, ``G``, ``B``, ``A``, ``X``, ... or the stored name where it is none of these."""

    def triple(self) -> tuple[Channel, ...] | None:
        for names in _TRIPLES:
            if all(n in self.channels for n in names):
                return tuple(self.channels[n] for n in names)
        return None

    def scalar(self) -> tuple[Channel, ...] | None:
        return tuple(self.channels.values()) if len(self.channels) == 1 else None


@dataclass(frozen=True)
class Source:
    """How one feature is computed from channels: ``(sum of terms) * factor``, then a conversion."""

    terms: tuple[tuple[Channel, ...], ...]
    factor: tuple[Channel, ...] | None = None
    kind: str = "mean"
    """Of a variance: one of ``VARIANCE_KINDS``, or ``halves``."""
    encoding: str = "signed"
    """Of a normal: ``signed`` or ``unsigned``."""
    text: str = ""
    """What the user is told: the layers, as stored."""
    note: str = ""

    @property
    def channels(self) -> list[Channel]:
        return [c for group in (*self.terms, self.factor or ()) for c in group]


@dataclass
class Resolution:
    """A file with its layers mapped: reads as features. Made by :func:`resolve`."""

    file: ExrFile
    renderer: str
    view: str
    """View or view layer that was chosen; empty where the file has only one."""
    other_views: list[str]
    features: dict[str, Source]
    """What was found. Optional features that are absent have no entry."""
    alpha: Channel | None
    spp: float | None
    data_window: Window
    notes: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return str(self.file.path)

    @property
    def display_window(self) -> Window:
        return self.file.display_window

    @property
    def pixel_aspect(self) -> float:
        return self.file.pixel_aspect

    @property
    def metadata(self) -> dict[str, Any]:
        return self.file.metadata

    def table(self) -> list[dict[str, str]]:
        """One row a feature: what was found, where, what was computed, what is defaulted."""
        rows = []
        for feature in FEATURES:
            source = self.features.get(feature)
            if source is None:
                row = {"feature": feature, "status": "default", "source": _default_text(feature), "note": ""}
            else:
                computed = len(source.terms) > 1 or source.factor is not None
                computed |= feature == schema.VARIANCE and source.kind != "mean"
                status = "computed" if computed else "found"
                row = {"feature": feature, "status": status, "source": source.text, "note": source.note}
            rows.append(row)
        alpha = {"feature": "alpha", "status": "found" if self.alpha else "absent", "source": "", "note": ""}
        alpha["source"] = self.alpha.name if self.alpha else ""
        return [*rows, alpha]

    def read(self, window: Window, features: Iterable[str] | None = None) -> dict[str, Array]:
        """Features (and ``alpha``) over a rectangle, float32 (height, width, channels), in the units of the schema.

        Values are as the renderer wrote them: NaN and infinities are still in it.
        """
        wanted = [f for f in (features or (*FEATURES, "alpha")) if f in self.features or (f == "alpha" and self.alpha)]
        channels: list[Channel] = []
        for name in wanted:
            channels += [self.alpha] if name == "alpha" and self.alpha else self.features[name].channels
        if schema.VARIANCE in wanted and schema.RGB not in wanted:
            channels += self.features[schema.RGB].channels
        unique = list(dict.fromkeys(channels))
        pixels = self.file.read(unique, window)
        place = {channel: i for i, channel in enumerate(unique)}

        def take(group: Sequence[Channel]) -> Array:
            return pixels[..., [place[c] for c in group]]

        result: dict[str, Array] = {}
        with np.errstate(all="ignore"):  # NaN and Inf are repaired, and counted, by whoever uses the pixels
            for name in wanted:
                if name == "alpha" and self.alpha:
                    result[name] = take([self.alpha])
                elif name == schema.VARIANCE:
                    mean = take(self.features[schema.RGB].terms[0])
                    result[name] = _variance_of_mean(self.features[name], take, mean, self.spp)
                else:
                    source = self.features[name]
                    value = take(source.terms[0])
                    for term in source.terms[1:]:
                        value = value + take(term)
                    if source.factor is not None:
                        value = value * take(source.factor)
                    if source.encoding == "unsigned":
                        value = value * 2 - 1
                    result[name] = value
        return result

    def load(self) -> Render:
        """The whole render in memory; read in bands, as decoded channels stand beside the features made of them."""
        whole = self.data_window
        layers: dict[str, Array] = {}
        for y0 in range(whole.y0, whole.y1, 4 * BAND):
            band = Window(whole.x0, y0, whole.x1, min(y0 + 4 * BAND, whole.y1))
            for name, rows in self.read(band).items():
                if name not in layers:
                    layers[name] = np.empty((whole.height, whole.width, rows.shape[-1]), dtype=np.float32)
                layers[name][band.slices(whole)] = rows
        return Render(
            layers,
            self.data_window,
            self.display_window,
            self.pixel_aspect,
            self.metadata,
            self.name,
        )


def _default_text(feature: str) -> str:
    return (
        "HRLS alone has no variance: constant, as in the paper's Gharbi case"
        if feature == schema.VARIANCE
        else "constant"
    )


def _variance_of_mean(source: Source, take: Any, mean: Array, spp: float | None) -> Array:
    """Variance of the pixel's mean luminance, (h, w, 1), from what the file holds.

    Colour variances are summed as if the channels' noise were fully correlated, which Monte Carlo noise nearly is (one
    path carries all three): sigma_Y = sum of w_c sigma_c.
    """
    if source.kind == "halves":
        # Two independent halves of the samples: the mean's variance is (a - b)^2 / 4.
        difference = (take(source.terms[0]) - take(source.terms[1])) / 2
        return np.square(luminance(difference))[..., None]
    value = take(source.terms[0])
    if source.kind == "second_moment":
        value = (value - np.square(mean)) / spp
    elif source.kind == "relative":
        value = value * (mean if value.shape[-1] == 3 else luminance(mean)[..., None]) / spp
    elif source.kind == "per_sample":
        value = value / spp
    elif source.kind == "deviation":
        value = np.square(value)
    if value.shape[-1] == 1:
        return value
    return np.square(luminance(np.sqrt(np.maximum(value, 0))))[..., None]


# ---------------------------------------------------------------------------------------------- layers of a file


def layers_of(file: ExrFile) -> list[Layer]:
    """Group a file's channels into layers, in file order.

    OpenEXR's rule is that the layer comes from the channel's name; Karma and Nuke put it in the part's name alone;
    Blender 5 writes both. So: the channel's prefix where there is one, the part's name otherwise, without the view.
    """
    multi_view = file.metadata.get("multiView") or ()
    views = [str(v) for v in multi_view] if not isinstance(multi_view, str) else [multi_view]
    layers: dict[tuple[str, str], Layer] = {}
    for part in file.parts:
        for channel in part.channels:
            prefix, _, component = channel.name.rpartition(".")
            view = part.view or (views[0] if views else "")
            if views and prefix.rpartition(".")[2] in views:
                prefix, _, view = prefix.rpartition(".")
            name = prefix or _part_layer(part.name, part.view)
            layer = layers.setdefault((view, name), Layer(name, view))
            layer.channels.setdefault(_COMPONENTS.get(component.lower(), component), channel)
    return list(layers.values())


def _part_layer(name: str, view: str) -> str:
    if view:
        name = re.sub(rf"[._ -]?{re.escape(view)}$", "", name)
    return "" if _PLAIN_PART.fullmatch(name) else name


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
    text = resources.files("oiio_msspl").joinpath("aovs.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["renderer"])


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
    """Return a mapping whose entries all have a form that :func:`resolve` understands.

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
        return "the beauty must be a layer of the render itself" if feature == schema.RGB and is_file else None
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
    if feature == schema.RGB and (forms[0] != "layer" or "times" in candidate):
        return "the beauty is replaced by the result, so it must be a single layer"
    if feature == schema.VARIANCE and (forms[0] == "sum" or "times" in candidate):
        return "variances don't add up layer by layer; give one layer, or two halves"
    if forms[0] == "halves" and (feature != schema.VARIANCE or len(names) != 2):
        return "halves are the two half buffers of a variance"
    if forms[0] == "channels" and len(names) not in ((1, 3) if feature == schema.VARIANCE else (3,)):
        return f"has {len(names)} channels, not 3"
    if "kind" in candidate and (feature != schema.VARIANCE or candidate["kind"] not in VARIANCE_KINDS):
        return f"kind {candidate['kind']!r}: of a variance, use one of {', '.join(VARIANCE_KINDS)}"
    if "encoding" in candidate and (feature != schema.NORMAL or candidate["encoding"] not in NORMAL_ENCODINGS):
        return f"encoding {candidate['encoding']!r}: of a normal, use one of {', '.join(NORMAL_ENCODINGS)}"
    return None


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

    def source(self, feature: str, candidate: Any, problems: list[str]) -> Source | None:
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
            group = layer.triple() or (layer.scalar() if feature == schema.VARIANCE else None)
            if group is None:
                wanted = "R, G, B (or X, Y, Z)" + (" or a single channel" if feature == schema.VARIANCE else "")
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
        return Source(tuple(groups), factor, kind, encoding, text, entry.get("note", ""))

    def _by_channel_names(self, entry: dict[str, Any]) -> Source | None:
        stored = {c.name: c for part in self.file.parts for c in part.channels}
        names = entry["channels"]
        if not all(n in stored for n in names):
            return None
        group = tuple(stored[n] for n in names)
        return Source(
            (group,), encoding=entry.get("encoding", "signed"), text=" ".join(names), note=entry.get("note", "")
        )


def resolve(
    file: ExrFile,
    mapping: Mapping[str, Any] | None = None,
    *,
    view: str | None = None,
    spp: float | None = None,
    features: Sequence[str] = schema.OPTIONAL_FEATURES,
) -> Resolution:
    """Find the features of :mod:`oiio_msspl.schema` among a file's layers.

    Args:
        file: from :func:`oiio_msspl.exr.open_exr`.
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
    if "not_beauty" in renderer and re.search(renderer["not_beauty"], file.path.stem) and schema.RGB not in mapping:
        raise InputError(
            f"{file.path}: holds {renderer['name']}'s {file.path.stem} alone, no beauty; give the RGB file beside it "
            "(or say --map rgb=... to take it all the same)"
        )

    beauties = _beauties(layers, [mapping[schema.RGB]] if schema.RGB in mapping else renderer["rgb"])
    if not beauties:
        seen = ", ".join(sorted({layer.name or " ".join(layer.channels) for layer in layers})[:12])
        raise InputError(f"{file.path}: no beauty (R, G, B) found among: {seen}; name it with --map rgb=LAYER")
    chosen_view, group, beauty = _choose(file, beauties, view)
    labels = list(dict.fromkeys(_label(v, g) for v, g, _ in beauties))

    matcher = _Matcher(file, layers, chosen_view, group)
    rgb = beauty.triple()
    assert rgb is not None
    found_features = {schema.RGB: Source((rgb,), text=beauty.name or " ".join(c.name for c in rgb))}
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

    resolution = Resolution(
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


def _check_variance(resolution: Resolution) -> None:
    source = resolution.features.get(schema.VARIANCE)
    if source is None:
        return
    if source.kind in ("per_sample", "relative", "second_moment") and not resolution.spp:
        del resolution.features[schema.VARIANCE]
        resolution.notes.append(
            f"variance: '{source.text}' is {source.kind.replace('_', ' ')}, which needs the samples per pixel; "
            "the header does not say, so it is defaulted (give --hr-spp)"
        )


def _decide_normal_encoding(resolution: Resolution) -> None:
    """Look into the pixels where the table can't say whether normals are signed or n * 0.5 + 0.5."""
    source = resolution.features.get(schema.NORMAL)
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
    resolution.features[schema.NORMAL] = replace(source, encoding="unsigned" if unsigned else "signed")


def explain_unused(file: ExrFile, resolution: Resolution) -> list[str]:
    """Names of the layers, or single channels, that the network does not read: they pass through."""
    used = {c for source in resolution.features.values() for c in source.channels} | {resolution.alpha}
    names = []
    for layer in layers_of(file):
        rest = [c for c in layer.channels.values() if c not in used]
        if len(rest) == len(layer.channels) and layer.name:
            names.append(layer.name)
        else:
            names += [c.name for c in rest]
    return names
