# SPDX-License-Identifier: Apache-2.0
"""From what a renderer calls its layers to the features of :mod:`oiio_msspl.aovs.features`.

The knowledge is data (``aovs.toml``); this module matches it against the layers of a file, and reads features in the
units of the schema: composites by the paper's equations, variances brought to the variance of the pixel's mean
luminance, normals to signed vectors. Whatever it chose is kept as text for the user.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from oiio_msspl.aovs.features import FEATURES, RGB, VARIANCE
from oiio_msspl.arrays import Array
from oiio_msspl.colour import luminance
from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import ROWS_PER_READ, Channel, ExrFile
from oiio_msspl.exr.render import Render, Window


@dataclass(frozen=True)
class FeatureFormula:
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
class MappedRender:
    """A file with its layers mapped: reads as features. Made by :func:`map_render`."""

    file: ExrFile
    renderer: str
    view: str
    """View or view layer that was chosen; empty where the file has only one."""
    other_views: list[str]
    features: dict[str, FeatureFormula]
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
                computed |= feature == VARIANCE and source.kind != "mean"
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
        if VARIANCE in wanted and RGB not in wanted:
            channels += self.features[RGB].channels
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
                elif name == VARIANCE:
                    mean = take(self.features[RGB].terms[0])
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
        for y0 in range(whole.y0, whole.y1, 4 * ROWS_PER_READ):
            band = Window(whole.x0, y0, whole.x1, min(y0 + 4 * ROWS_PER_READ, whole.y1))
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
    return "HRLS alone has no variance: constant, as in the paper's Gharbi case" if feature == VARIANCE else "constant"


def _variance_of_mean(source: FeatureFormula, take: Any, mean: Array, spp: float | None) -> Array:
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


def unread_layers(file: ExrFile, resolution: MappedRender) -> list[str]:
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
