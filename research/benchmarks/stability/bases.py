# SPDX-License-Identifier: Apache-2.0
"""Undisturbed pairs with their reference, from analytic scenes or from rendered views."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from oiio_msspl.aovs.features import RGB, VARIANCE
from oiio_msspl.exr.render import Render
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import luminance
from research.benchmarks.stability import analytic
from research.datagen import views as rendered_views
from research.datagen.views import Folder, as_float32, mean_lrhs, read_hrls, split_features


@dataclass(frozen=True, eq=False)
class Pair:
    """An LRHS, an HRLS and the reference (h, w, 3)."""

    lr: Render
    hr: Render
    reference: Array

    @property
    def scale(self) -> int:
        return self.hr.data_window.width // self.lr.data_window.width


def seeded(*key: object) -> np.random.Generator:
    """A random generator that is different for every key and the same in every run."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))


class Base:
    """A scene that gives pairs of any scale and spp."""

    name: str

    def __init__(self) -> None:
        self._made: dict[tuple[int, int, int | None, bool], Pair] = {}

    def pair(self, scale: int, hr_spp: int = 1, lr_spp: int | None = None, *, nearest: bool = False) -> Pair:
        """A pair; the same arguments return the same object.

        Args:
            lr_spp: spp of the LRHS; by default one for every HRLS pixel.
            nearest: an LRHS pixel samples only one of the HRLS pixels that it covers.

        Raises:
            LookupError: this base has no such pair.
        """
        key = (scale, hr_spp, lr_spp, nearest)
        if key not in self._made:
            self._made[key] = self.make(scale, hr_spp, lr_spp, nearest=nearest)
        return self._made[key]

    def make(self, scale: int, hr_spp: int = 1, lr_spp: int | None = None, *, nearest: bool = False) -> Pair:
        raise NotImplementedError


class Analytic(Base):
    """An analytic scene."""

    def __init__(self, name: str, scene: analytic.Scene) -> None:
        super().__init__()
        self.name, self.scene = name, scene

    def make(
        self,
        scale: int,
        hr_spp: int = 1,
        lr_spp: int | None = None,
        *,
        nearest: bool = False,
        lr_filter: analytic.Footprint | None = None,
        hr_filter: analytic.Footprint | None = None,
        lr_scene: analytic.Scene | None = None,
    ) -> Pair:
        """As :meth:`pair`, also with other pixel filters or with another scene in the LRHS."""
        low = analytic.render(
            lr_scene or self.scene,
            lr_spp or scale**2,
            seeded(self.name, "LRHS", scale),
            footprint=analytic.point(scale) if nearest else lr_filter,
            scale=scale,
        )
        high = analytic.render(self.scene, hr_spp, seeded(self.name, "HRLS"), footprint=hr_filter)
        return Pair(low, high, analytic.reference(self.scene, hr_filter))


class View(Base):
    """A rendered view in the format of :mod:`research.datagen.views`."""

    def __init__(self, view: rendered_views.View) -> None:
        super().__init__()
        self.name, self.view = view.path.stem, view

    def make(self, scale: int, hr_spp: int = 1, lr_spp: int | None = None, *, nearest: bool = False) -> Pair:
        wanted = 1 if lr_spp is None else lr_spp / scale**2
        found = [p for p, spp in enumerate(self.view.lr_spp) if spp == wanted]
        if hr_spp > len(self.view.hr) or not found:
            raise LookupError(f"{self.name} has no HRLS of {hr_spp} spp with an LRHS of {lr_spp}")
        height, width = (n // scale * scale for n in self.view.ref.shape[:2])
        low = mean_lrhs(self.view, found[:1], scale, nearest=nearest)[: height // scale, : width // scale]
        samples = read_hrls(self.view, list(range(hr_spp)), slice(0, height), slice(0, width))
        features = split_features(samples)
        layers = {name: values.mean(axis=0) for name, values in features.items()}
        if hr_spp > 1:
            grey = luminance(features[RGB])
            layers[VARIANCE] = grey.var(axis=0, ddof=1)[..., None] / hr_spp
        high = Render.from_arrays("HRLS", **layers)
        return Pair(Render.from_arrays("LRHS", rgb=low), high, as_float32(self.view.ref[:height, :width]))


def views(folder: Path) -> list[View]:
    """The first held-out view of every scene in a folder.

    Raises:
        SystemExit: there is none.
    """
    scenes = {view.scene: view for view in reversed(Folder(folder).split("test"))}
    if not scenes:
        raise SystemExit(f"{folder}: holds no view of the split 'test' (see research/datagen/views.py)")
    return [View(view) for _, view in sorted(scenes.items())]
