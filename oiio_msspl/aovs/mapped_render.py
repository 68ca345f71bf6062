# SPDX-License-Identifier: Apache-2.0
"""A file whose layers are mapped to features: it reads as features, in documented units."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, FEATURES, RGB, VARIANCE
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.motion import MotionLayers
from oiio_msspl.exr.layers import layers_of
from oiio_msspl.exr.reader import Channel, ExrFile
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.image.arrays import Array, blank, unload
from oiio_msspl.image.colour import REC709, ColourSpace

#: Rows that :meth:`MappedRender.load` reads at a time: the decoded channels stand beside the features made of them.
ROWS_PER_LOAD = 256


@dataclass
class MappedRender:
    """A file whose layers are mapped. :func:`oiio_msspl.aovs.matching.map_render` makes it."""

    file: ExrFile
    renderer: str
    """Name of the renderer in the table, or ``unknown``."""
    view: str
    """View or view layer that was chosen; empty where the file has only one."""
    other_views: list[str]
    """The views and view layers that were not chosen."""
    features: dict[str, FeatureFormula]
    """The features that were found; ``rgb`` always is."""
    alpha: Channel | None
    spp: float | None
    """Samples per pixel; None if neither the header nor the user says."""
    data_window: Window
    space: ColourSpace = REC709
    """Linear RGB space of the beauty, for the preview. :func:`oiio_msspl.jobs.inputs.map_pair` finds it."""
    additive_sets: list[AdditiveSet] = field(default_factory=list)
    """Layers that may sum to the beauty."""
    motion: MotionLayers = field(default_factory=MotionLayers)
    """Motion vectors, position and depth."""
    notes: list[str] = field(default_factory=list)
    """What the user should know about the mapping, one sentence each."""

    @property
    def name(self) -> str:
        """Path of the file."""
        return str(self.file.path)

    @property
    def display_window(self) -> Window:
        """The frame: what the camera shows."""
        return self.file.display_window

    @property
    def pixel_aspect(self) -> float:
        """Width of a pixel divided by its height."""
        return self.file.pixel_aspect

    @property
    def metadata(self) -> dict[str, Any]:
        """Header attributes by their OpenImageIO names. Those of the beauty's part count more than those of others,
        which may belong to another view."""
        return self.file.metadata | self.file.parts[self.features[RGB].terms[0][0].part].metadata

    @property
    def beauty_channels(self) -> tuple[Channel, ...]:
        """The channels R, G, B and, if there is one, A: those that a fused frame replaces."""
        return (*self.features[RGB].terms[0], *([self.alpha] if self.alpha else []))

    def table(self, read: Collection[str] = FEATURES) -> list[dict[str, str]]:
        """What each feature and the alpha are read from, for the user. :func:`origin` puts a row into words.

        Args:
            read: the features that the model reads.

        Returns:
            Rows with the keys ``feature``, ``status``, ``source`` (the layers; empty if there is none) and ``note``.
            The status is ``found``, ``computed``, ``default`` (a missing feature), ``unused`` (the model does not read
            it) or, for alpha, ``absent``.
        """
        rows = []
        for feature in FEATURES:
            formula = self.features.get(feature)
            status = "default" if formula is None else "computed" if formula.is_computed else "found"
            text, note = (formula.text, formula.note) if formula else ("", "")
            rows.append(_row(feature, status if feature in read else "unused", text, note))
        rows.append(_row("alpha", "found", self.alpha.name) if self.alpha else _row("alpha", "absent"))
        return rows

    def unused_layers(self, others: Sequence[MappedRender], fused: Iterable[AdditiveSet]) -> list[str]:
        """Names of the flat layers, or of single channels, that no feature is read from, in this view or in one of
        ``others``, and that are in none of the ``fused`` sets. Those of another view than the chosen one are followed
        by the view in brackets."""
        used = {c for each in (self, *others) for formula in each.features.values() for c in formula.channels}
        used |= {channel for each in fused for layer in each.layers for channel in layer.channels}
        used |= {each.alpha for each in (self, *others) if each.alpha}
        names = []
        for layer in layers_of(self.file):
            rest = [c for c in layer.channels.values() if c not in used]
            whole = len(rest) == len(layer.channels) and layer.name
            view = f" ({layer.view})" if layer.view and layer.view not in self.view.split("/") else ""
            names += [name + view for name in ([layer.name] if whole else [c.name for c in rest])]
        return names

    def read(self, window: Window, features: Iterable[str] | None = None) -> dict[str, Array]:
        """Features over a rectangle: float32 (height, width, channels), in the units of the features.

        Each channel is contiguous in memory. Features that are read from one file may share the memory of all of them.
        Values are as the renderer wrote them: NaN and infinities may be among them.

        Args:
            window: a rectangle inside the data window.
            features: names of features, and ``alpha``; all if None. Those that the render lacks are left out.

        Raises:
            InputError: pixels can't be decoded, because a file is truncated or corrupt.
        """
        return self._read_with(window, features, ())[0]

    def _read_with(
        self, window: Window, features: Iterable[str] | None, more: Sequence[Channel]
    ) -> tuple[dict[str, Array], Array]:
        """What :meth:`read` returns, and more channels as they are stored, (height, width, channels)."""
        names = (*FEATURES, "alpha") if features is None else features
        wanted = [f for f in names if f in self.features or (f == "alpha" and self.alpha)]
        channels = list(dict.fromkeys([*self._channels(wanted), *more]))
        pixels = self.file.read(channels, window)
        place = {channel: i for i, channel in enumerate(channels)}

        def take(group: Sequence[Channel]) -> Array:
            places = [place[c] for c in group]
            adjacent = places == list(range(places[0], places[-1] + 1))
            return pixels[..., places[0] : places[-1] + 1] if adjacent else pixels[..., places]

        result: dict[str, Array] = {}
        with np.errstate(all="ignore"):  # the caller repairs and counts NaN and infinities
            for name in wanted:
                if name == "alpha" and self.alpha:
                    result[name] = take([self.alpha])
                elif name == VARIANCE:
                    mean = take(self.features[RGB].terms[0])
                    result[name] = self.features[name].evaluate_variance(take, mean, self.spp)
                else:
                    result[name] = self.features[name].evaluate(take)
        return result, take(more) if more else pixels[..., :0]

    def _channels(self, names: list[str]) -> list[Channel]:
        """The channels that some features, or ``alpha``, are computed from; each once."""
        channels: list[Channel] = []
        for name in names:
            channels += [self.alpha] if name == "alpha" and self.alpha else self.features[name].channels
        if VARIANCE in names:
            channels += self.features[RGB].channels
        return list(dict.fromkeys(channels))

    def cache_strips(self, max_bytes: int) -> AbstractContextManager[None]:
        """Keep decoded rows between reads, see :meth:`oiio_msspl.exr.reader.ExrFile.cache_strips`."""
        return self.file.cache_strips(max_bytes)

    def unload(self) -> None:
        """Nothing to do: pixels are read from the file."""

    def load(self, features: Iterable[str] | None = None, *, on_disk: bool = False) -> Render:
        """The whole render in memory.

        Args:
            features: as for :meth:`read`.
            on_disk: in temporary files instead.

        Raises:
            InputError: pixels can't be decoded, because a file is truncated or corrupt.
        """
        return self.load_with((), features, on_disk=on_disk)[0]

    def load_with(
        self, channels: Sequence[Channel], features: Iterable[str] | None = None, *, on_disk: bool = False
    ) -> tuple[Render, Array]:
        """The whole render, as :meth:`load` returns it, and some channels as they are stored, float32 (height, width,
        channels).

        Layers of one part are decoded together, so this is faster than to read the channels later.

        Args:
            features, on_disk: as for :meth:`load`.

        Raises:
            InputError: pixels can't be decoded, because a file is truncated or corrupt.
        """
        whole = self.data_window
        layers: dict[str, Array] = {}
        stored = np.empty((len(channels), whole.height, whole.width), np.float32).transpose(1, 2, 0)
        for window in self._bands():
            strips, stored[window.slices(whole)] = self._read_with(window, features, channels)
            for name, rows in strips.items():
                if name not in layers:
                    layers[name] = blank((whole.height, whole.width, rows.shape[-1]), on_disk=on_disk)
                layers[name][window.slices(whole)] = rows
                unload(layers[name])
        return Render(layers, whole, self.display_window, self.pixel_aspect, self.metadata, self.name), stored

    def check_pixels(self, channels: Sequence[Channel], features: Iterable[str]) -> None:
        """Decode what :meth:`load_with` would keep, and keep nothing.

        Raises:
            InputError: as there.
        """
        for window in self._bands():
            self._read_with(window, features, channels)

    def _bands(self) -> Iterator[Window]:
        """The data window in bands of rows that are read together."""
        whole = self.data_window
        for y0 in range(whole.y0, whole.y1, ROWS_PER_LOAD):
            yield Window(whole.x0, y0, whole.x1, min(y0 + ROWS_PER_LOAD, whole.y1))


def _row(feature: str, status: str, source: str = "", note: str = "") -> dict[str, str]:
    return {"feature": feature, "status": status, "source": source, "note": note}


def origin(row: Mapping[str, str]) -> str:
    """Where a feature comes from, in words.

    Args:
        row: of :meth:`MappedRender.table`.
    """
    status, source = row["status"], row["source"] + (f" ({row['note']})" if row["note"] else "")
    if status == "default":
        # All features but the beauty are optional, but without an albedo textures are lost.
        return (
            "none: expect blur, render an albedo (or name it with --map albedo=LAYER)"
            if row["feature"] == ALBEDO
            else "none (optional)"
        )
    if status == "unused":
        return f"found: {source}; this model does not read it" if source else "none; this model does not read it"
    return "none" if status == "absent" else f"{status}: {source}"
