# SPDX-License-Identifier: Apache-2.0
"""Map a file: find the layers that are the features of :mod:`oiio_msspl.aovs.features`.

The names of layers are data in ``renderers.toml``. The choice is kept as text for the user.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from oiio_msspl.aovs.additive_sets import find_additive_sets
from oiio_msspl.aovs.candidates import LayerFinder, missing, wrong_channels
from oiio_msspl.aovs.features import NORMAL, OPTIONAL_FEATURES, RGB
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.mapping import check_mapping
from oiio_msspl.aovs.motion import find_motion_layers
from oiio_msspl.aovs.renderers import (
    candidates_of,
    detect_renderer,
    entry_of,
    known_as_other,
    names_of_aov,
    samples_per_pixel,
    view_layer_of,
)
from oiio_msspl.aovs.views import Beauty, choose_beauty, find_alpha, find_beauties, only_colour
from oiio_msspl.errors import InputError
from oiio_msspl.exr.layers import Layer, layers_of
from oiio_msspl.exr.reader import ExrFile
from oiio_msspl.exr.render import Window
from oiio_msspl.image.arrays import Array

#: Bands of rows that tell whether normals are signed, and rows of a band.
_BANDS_OF_NORMALS, _ROWS_PER_BAND = 8, 8


def map_render(
    file: ExrFile,
    mapping: Mapping[str, Any] | None = None,
    *,
    view: str | None = None,
    spp: float | None = None,
    features: Sequence[str] = OPTIONAL_FEATURES,
    sums: Sequence[str] = (),
) -> MappedRender:
    """Find the features of :mod:`oiio_msspl.aovs.features` among a file's layers.

    Args:
        mapping: the user's candidates by feature. They replace those of the table, and their layers must exist.
        view: view (``left``) or view layer (``ViewLayer``) to take; the file's first if None.
        spp: samples per pixel, if the header does not say or is wrong.
        features: features to look for beside the beauty.
        sums: the user's additive sets, see :func:`oiio_msspl.aovs.additive_sets.find_additive_sets`.

    Raises:
        InputError: the mapping or a sum has a mistake; the file has only deep data, no beauty or no such view; or a
            layer of the mapping is missing or has the wrong channels.
    """
    if all(part.deep for part in file.parts):
        raise InputError(
            f"{file.path}: holds deep data only; flatten it first (a deep pixel has no single colour to fuse)"
        )
    layers = layers_of(file)
    mapping = check_mapping(dict(mapping or {}), "mapping")
    renderer = detect_renderer(file, layers)
    beauties = _beauties(file, layers, renderer, mapping.get(RGB))
    beauty = choose_beauty(file, beauties, view)
    rgb = beauty.layer.triple()
    assert rgb is not None
    notes: list[str] = []
    formulas = {RGB: FeatureFormula((rgb,), text=beauty.layer.name or " ".join(c.name for c in rgb))}
    spp = spp if spp is not None else samples_per_pixel(renderer, file, beauty.view_layer)
    finder = LayerFinder(file, layers, renderer, beauty.view, beauty.view_layer, spp)
    for feature in features:
        problems: list[str] = []
        if feature not in mapping:
            candidates = (finder.formula(feature, candidate, notes) for candidate in candidates_of(renderer, feature))
            if formula := next(filter(None, candidates), None):
                formulas[feature] = formula
        elif formula := finder.formula(feature, mapping[feature], problems):
            formulas[feature] = formula
        else:
            raise InputError(f"{file.path}: {problems[0] if problems else missing(feature, mapping[feature], file)}")
    labels = dict.fromkeys(candidate.label for candidate in beauties)
    render = MappedRender(
        file=file,
        renderer=renderer["name"],
        view=beauty.label,
        other_views=[label for label in labels if label != beauty.label],
        features=formulas,
        alpha=find_alpha(layers, beauty),
        spp=spp,
        data_window=file.parts[formulas[RGB].terms[0][0].part].data_window,
        additive_sets=find_additive_sets(renderer, layers, beauty, sums, file),
        motion=find_motion_layers(renderer, layers, beauty, [c for f in formulas.values() for c in f.channels]),
        notes=list(dict.fromkeys(notes)),
        mapped=frozenset(mapping),
    )
    _decide_normal_encoding(render)
    render.notes += _small_windows(render)
    return render


def _beauties(file: ExrFile, layers: list[Layer], renderer: dict[str, Any], mapped: Any) -> list[Beauty]:
    """Return the beauties of all views, by what the user has ``mapped`` or else by the table, or raise InputError."""
    if mapped is not None:
        beauties = find_beauties(file, layers, [mapped])
    elif "not_beauty" in renderer and re.search(renderer["not_beauty"], file.path.stem):
        raise InputError(
            f"{file.path}: holds {renderer['name']}'s {file.path.stem} alone, no beauty; give the RGB file beside it "
            "(or pass --map rgb=LAYER to use this one)"
        )
    else:
        named = [name for name in names_of_aov(renderer, file, RGB) if name != RGB]  # in the header
        beauties = find_beauties(file, layers, [*named, *candidates_of(renderer, RGB)])
        beauties = beauties or find_beauties(file, layers, only_colour(layers, known_as_other(renderer)))
    if not beauties:
        raise _no_beauty(file, layers, mapped)
    return beauties


def _small_windows(render: MappedRender) -> list[str]:
    """Return a note on each feature whose part does not cover the beauty's data window."""
    notes, whole = [], render.data_window
    for name, formula in render.formulas.items():
        owners = [render.file.siblings.get(c.path, render.file).parts[c.part] for c in formula.channels]
        if small := next((part for part in owners if whole.intersect(part.data_window) != whole), None):
            window = small.data_window
            notes.append(
                f"{name}: its part '{small.name}' covers only {window} of {whole}, so it counts as 0 elsewhere"
            )
    return notes


def _no_beauty(file: ExrFile, layers: list[Layer], mapped: Any) -> InputError:
    """Return the error for a file without the table's beauty, or without the one that the user has ``mapped``."""
    if mapped is not None:
        alias = entry_of(mapped).get("layer", "")
        for layer in layers:
            if alias and view_layer_of(layer.name, alias) is not None:
                return InputError(f"{file.path}: {wrong_channels(RGB, layer)}")
        return InputError(f"{file.path}: {missing(RGB, mapped, file)}; a mapping of rgb applies to every file")
    names = ", ".join(sorted({layer.name or " ".join(layer.channels) for layer in layers})[:12])
    if not any(layer.triple() for layer in layers):
        return InputError(
            f"{file.path}: no beauty, no layer with R, G, B among: {names}; write the beauty as RGB, half or float, or "
            "name three channels in a --map-file"
        )
    return InputError(f"{file.path}: no beauty (R, G, B) found among: {names}; name it with --map rgb=LAYER")


def _decide_normal_encoding(render: MappedRender) -> None:
    """Decide by the pixels whether normals are signed or n * 0.5 + 0.5 if the table can't say."""
    formula = render.features.get(NORMAL)
    if formula is None or formula.encoding != "auto":
        return
    window, bands = render.data_window, [render.data_window]
    last = window.height - _ROWS_PER_BAND
    if window.height > _BANDS_OF_NORMALS * _ROWS_PER_BAND:
        tops = (window.y0 + last * i // (_BANDS_OF_NORMALS - 1) for i in range(_BANDS_OF_NORMALS))
        bands = [Window(window.x0, top, window.x1, top + _ROWS_PER_BAND) for top in tops]
    normal = np.concatenate([render.file.read(formula.terms[0], band).reshape(-1, 3) for band in bands])
    normal = normal[np.isfinite(normal).all(axis=1) & (np.abs(normal).max(axis=1) > 0)]
    unsigned = len(normal) > 0 and normal.min() >= 0 and _unit_fraction(normal * 2 - 1) > _unit_fraction(normal)
    render.features[NORMAL] = replace(formula, encoding="unsigned" if unsigned else "signed")


def _unit_fraction(vectors: Array) -> float:
    """Return the fraction of the vectors (n, 3) whose length is 1 +- 0.1."""
    return float(np.mean(np.abs(np.linalg.norm(vectors, axis=1) - 1) < 0.1)) if len(vectors) else 0.0
