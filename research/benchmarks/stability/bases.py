# SPDX-License-Identifier: Apache-2.0
"""Render undisturbed pairs with their reference from analytic scenes."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from oiio_msspl.exr.render import Render
from oiio_msspl.image.arrays import Array
from research.benchmarks.stability import analytic


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
    """Return a random generator that is different for every key and the same in every run."""
    return np.random.default_rng(zlib.crc32(repr(key).encode()))


class Base:
    """An analytic scene that gives pairs of any scale and spp."""

    def __init__(self, name: str, scene: analytic.Scene) -> None:
        self.name, self.scene = name, scene
        self._made: dict[tuple[int, int, int | None, bool], Pair] = {}

    def pair(self, scale: int, hr_spp: int = 1, lr_spp: int | None = None, *, nearest: bool = False) -> Pair:
        """Return a pair; equal arguments return the same object.

        Args:
            lr_spp: spp of the LRHS; by default one for every HRLS pixel.
            nearest: an LRHS pixel samples only one of the HRLS pixels that it covers.
        """
        key = (scale, hr_spp, lr_spp, nearest)
        if key not in self._made:
            self._made[key] = self.make(scale, hr_spp, lr_spp, nearest=nearest)
        return self._made[key]

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
        """Render a pair, also with other pixel filters or with another scene in the LRHS."""
        low = analytic.render(
            lr_scene or self.scene,
            lr_spp or scale**2,
            seeded(self.name, "LRHS", scale),
            footprint=analytic.point(scale) if nearest else lr_filter,
            scale=scale,
        )
        high = analytic.render(self.scene, hr_spp, seeded(self.name, "HRLS"), footprint=hr_filter)
        return Pair(low, high, analytic.reference(self.scene, hr_filter))
