# SPDX-License-Identifier: Apache-2.0
"""Compute a feature from the channels of a file.

Composites follow the paper's equations, and normals become signed vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from oiio_msspl.exr.reader import Channel
from oiio_msspl.image.arrays import Array

#: Gives the pixels of some channels, (height, width, len(channels)).
Take = Callable[[Sequence[Channel]], Array]


@dataclass(frozen=True)
class FeatureFormula:
    """How one feature is computed: ``(sum of terms) * factor / samples``, then a conversion to the feature's unit."""

    terms: tuple[tuple[Channel, ...], ...]
    """Groups of channels, three each, or one each for a variance in luminance."""
    factor: tuple[Channel, ...] | None = None
    samples: float = 1.0
    """spp, if a layer holds the variance of single samples."""
    encoding: str = "signed"
    """Of a normal: ``signed`` or ``unsigned`` (n * 0.5 + 0.5)."""
    text: str = ""
    """The layers as stored, for the user."""
    note: str = ""
    """What else the user should know, e.g. ``camera space``."""

    @property
    def channels(self) -> list[Channel]:
        """All channels that the formula reads."""
        return [c for group in (*self.terms, self.factor or ()) for c in group]

    @property
    def is_computed(self) -> bool:
        """Whether the feature is computed, rather than read from a layer that holds just this."""
        return len(self.terms) > 1 or self.factor is not None

    def evaluate(self, take: Take) -> Array:
        """Return the feature: float32 (height, width, channels), in the units of the features."""
        value = reduce(np.add, map(take, self.terms))
        if self.factor is not None:
            value = value * take(self.factor)
        if self.samples != 1:
            value = value / np.float32(self.samples)
        if self.encoding != "unsigned":
            return value
        normal = value * 2 - 1
        normal[~value.any(axis=-1)] = 0  # renderers store an empty background as 0, which no normal is
        return normal
