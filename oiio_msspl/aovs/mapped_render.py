# SPDX-License-Identifier: Apache-2.0
"""Read a file whose layers are mapped as features, in documented units."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.features import ALBEDO, FEATURES, PAPER_FEATURES, RGB, VARIANCE
from oiio_msspl.aovs.formula import FeatureFormula
from oiio_msspl.aovs.motion import MotionLayers
from oiio_msspl.exr.reader import Channel, ExrFile, adjacent
from oiio_msspl.exr.render import Render, Window
from oiio_msspl.image.arrays import Array, blank, unload
from oiio_msspl.image.colour import REC709, ColourSpace

#: Rows that are read at a time: decoded channels take memory beside the features that are made of them.
ROWS_PER_LOAD = 256


@dataclass
class MappedRender:
    """A file whose layers are mapped, made by :func:`oiio_msspl.aovs.matching.map_render`."""

    file: ExrFile
    renderer: str
    """Name of the renderer in the table, or ``unknown``."""
    view: str
    """View or view layer that was chosen; empty if the file has only one."""
    other_views: list[str]
    """The views and view layers that were not chosen."""
    features: dict[str, FeatureFormula]
    """Formulas of the features that the file has, always ``rgb``."""
    alpha: Channel | None
    spp: float | None
    """Samples per pixel; None if neither the header nor the user says."""
    data_window: Window
    space: ColourSpace = REC709
    """Linear RGB space of the beauty, for the preview. :func:`oiio_msspl.jobs.inputs.map_pair` finds it."""
    additive_sets: list[AdditiveSet] = field(default_factory=list)
    """Layers that may sum to the beauty."""
    motion: MotionLayers = field(default_factory=MotionLayers)
    """Motion vectors and position."""
    notes: list[str] = field(default_factory=list)
    """Sentences for the user about the mapping, which begin with the feature."""
    mapped: frozenset[str] = frozenset()
    """Features that the user has mapped."""

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
        """Header attributes by their OpenImageIO names; those of the beauty's part count, then those of the file."""
        return self.file.metadata | self.file.parts[self.features[RGB].terms[0][0].part].metadata

    @property
    def beauty_channels(self) -> tuple[Channel, ...]:
        """The channels R, G, B and perhaps A, which a fused frame replaces."""
        return (*self.features[RGB].terms[0], *([self.alpha] if self.alpha else []))

    def table(self, read: Collection[str] = FEATURES) -> list[dict[str, str]]:
        """List what features and alpha are read from, for the user. :func:`origin` puts a row into words.

        Args:
            read: the features that the model reads.

        Returns:
            Rows with the keys ``feature``, ``status``, ``source`` (the layers; empty if there is none) and ``note``.
            The status is ``found``, ``computed``, ``default`` (a missing feature), ``unused`` (the file has it, and the
            model does not read it) or, for alpha, ``absent``.
        """
        rows = []
        for feature in (name for name in FEATURES if name in self.features or name in read):
            formula = self.features.get(feature)
            status = "default" if formula is None else "computed" if formula.is_computed else "found"
            text, note = (formula.text, formula.note) if formula else ("", "")
            rows.append((feature, status if feature in read else "unused", text, note))
        rows.append(("alpha", "found", self.alpha.name, "") if self.alpha else ("alpha", "absent", "", ""))
        return [dict(zip(("feature", "status", "source", "note"), row, strict=True)) for row in rows]

    def features_read(self, read: Collection[str], *, alone: bool) -> list[str]:
        """Return the features that a model reads (``read``), and what else is read of a render that is fused alone.

        That is the variance of colours, if there is one: nothing else tells how much noise a pixel has.
        """
        is_read = alone and VARIANCE in self.features and len(self.features[VARIANCE].terms[0]) == 3
        return [*read, *([VARIANCE] if is_read and VARIANCE not in read else [])]

    def for_model(self, read: Collection[str]) -> MappedRender:
        """Return the render without the features that only the paper's network reads, and without notes about them.

        A feature that the model reads (``read``) or that the user has mapped is kept.
        """
        unread = PAPER_FEATURES.difference(read, self.mapped)
        features = {name: formula for name, formula in self.features.items() if name not in unread}
        notes = [note for note in self.notes if note.partition(":")[0] not in unread]
        return replace(self, features=features, notes=notes)

    @property
    def formulas(self) -> dict[str, FeatureFormula]:
        """The features and, if there is one, the alpha."""
        return self.features | ({"alpha": FeatureFormula(((self.alpha,),))} if self.alpha else {})

    def read(self, window: Window, features: Iterable[str] | None = None) -> dict[str, Array]:
        """Return features and ``alpha`` over a rectangle, as :meth:`oiio_msspl.exr.render.Render.read` does.

        Channels are contiguous in memory; features of one file may be views of one array.

        Raises:
            InputError: pixels can't be decoded, because a file is truncated or corrupt.
        """
        return self._read_with(window, features, ())[0]

    def _read_with(
        self, window: Window, features: Iterable[str] | None, more: Sequence[Channel]
    ) -> tuple[dict[str, Array], Array]:
        """Read features and, as they are stored, more channels, (height, width, channels)."""
        available = self.formulas
        names = (*FEATURES, "alpha") if features is None else features
        formulas = {name: available[name] for name in names if name in available}
        needed = [c for formula in formulas.values() for c in formula.channels]
        channels = list(dict.fromkeys([*needed, *more]))
        pixels = self.file.read(channels, window)
        place = {channel: i for i, channel in enumerate(channels)}

        def take(group: Sequence[Channel]) -> Array:
            return pixels[..., adjacent([place[c] for c in group])]

        result: dict[str, Array] = {}
        with np.errstate(all="ignore"):  # the caller repairs and counts NaN and infinities
            for name, formula in formulas.items():
                result[name] = formula.evaluate(take)
        return result, take(more) if more else pixels[..., :0]

    def cache_strips(self, max_bytes: int) -> AbstractContextManager[None]:
        """Keep decoded rows from one :meth:`read` to the next, see :meth:`ExrFile.cache_strips`."""
        return self.file.cache_strips(max_bytes)

    def unload(self) -> None:
        """Do nothing, because pixels are read from the file."""

    def load(self, features: Iterable[str] | None = None, *, on_disk: bool = False) -> Render:
        """Read the whole render into memory, without further channels, see :meth:`load_with`."""
        return self.load_with((), features, on_disk=on_disk)[0]

    def load_with(
        self, channels: Sequence[Channel], features: Iterable[str] | None = None, *, on_disk: bool = False
    ) -> tuple[Render, Array]:
        """Read the whole render into memory, and some channels as they are stored, float32 (height, width, channels).

        Layers of one part are decoded together, so this is faster than reading the channels later. With ``on_disk``,
        the features lie in temporary files.

        Raises:
            InputError: pixels can't be decoded, because a file is truncated or corrupt.
        """
        whole = self.data_window
        layers: dict[str, Array] = {}
        stored = np.empty((len(channels), whole.height, whole.width), np.float32).transpose(1, 2, 0)
        for window in whole.bands(ROWS_PER_LOAD):
            strips, stored[window.slices(whole)] = self._read_with(window, features, channels)
            for name, rows in strips.items():
                if name not in layers:
                    layers[name] = blank((whole.height, whole.width, rows.shape[-1]), on_disk=on_disk)
                layers[name][window.slices(whole)] = rows
                unload(layers[name])
        return Render(layers, whole, self.display_window, self.pixel_aspect, self.metadata, self.name), stored


#: A render that is read by rectangles: a file with its layers mapped, or one in memory.
ReadableRender = MappedRender | Render


def origin(row: Mapping[str, str]) -> str:
    """Say where a feature comes from, by a row of :meth:`MappedRender.table`."""
    status, source = row["status"], row["source"] + (f" ({row['note']})" if row["note"] else "")
    if status == "default":  # features are optional, but without an albedo textures are lost
        hint = "none: expect blur, render an albedo (or name it with --map albedo=LAYER)"
        return hint if row["feature"] == ALBEDO else "none (optional)"
    if status == "unused":
        return f"not read: {source}"
    return "none" if status == "absent" else f"{status}: {source}"
