# SPDX-License-Identifier: Apache-2.0
"""Weighted means of frames, summed up in the arrays that hold the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from oiio_msspl.aovs.features import VARIANCE
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.parallel import for_row_blocks

#: Takes a name and rows, and returns the image there, (n, w, c).
Rows = Callable[[str, slice], Array]


class WeightedSum:
    """Adds weighted features to images, in place, and then divides these by the sum of the weights."""

    def __init__(self, images: dict[str, Array]) -> None:
        """``images`` (h, w, c) count with a weight of 1."""
        # NumPy takes longer for a part of an image in a temporary file than for one of any other.
        self._images = {name: np.asarray(image) for name, image in images.items()}
        self._weights: Array = np.ones(next(iter(images.values())).shape[:2], np.float32)
        self._squares = np.ones_like(self._weights)

    def add(self, feature: Rows, weight: Array) -> None:
        """Add features with a weight (h, w).

        Args:
            feature: the features that are added; finite.
        """

        def work(rows: slice) -> None:
            part = _Weights(weight[rows])
            self._weights[rows] += part.weights
            self._squares[rows] += part.squares
            with np.errstate(over="ignore", invalid="ignore"):  # the frame's own pixels may be NaN or infinite
                for name, image in self._images.items():
                    values = feature(name, rows)
                    image[rows] += part.of(name, values) * values

        self._for_blocks(work)

    def divide(self) -> Array:
        """Turn the sums into means.

        Returns:
            (h, w, 1): the number of images with equal weight whose mean would have as little noise, 1 where nothing
            was added.
        """

        def work(rows: slice) -> None:
            weights = _Weights(self._weights[rows])
            with np.errstate(over="ignore", invalid="ignore"):
                for name, image in self._images.items():
                    image[rows] /= weights.of(name, image[rows])

        self._for_blocks(work)
        return np.divide(np.square(self._weights), self._squares, dtype=np.float32)[..., None]

    def _for_blocks(self, work: Callable[[slice], None]) -> None:
        width = sum(image.shape[-1] for image in self._images.values())
        for_row_blocks(work, len(self._weights), self._weights.shape[1] * width)


class _Weights:
    """Weights of some rows (n, w), and the same for images with several channels."""

    def __init__(self, weights: Array) -> None:
        self.weights, self.squares = weights, np.square(weights)
        self._repeated: dict[int, Array] = {}

    def of(self, feature: str, values: Array) -> Array:
        """The weights for the values (n, w, c) of a feature.

        They are repeated for channels that lie beside each other. NumPy takes twice as long for an axis of a few
        channels.
        """
        if feature == VARIANCE:
            return self.squares[..., None]  # the variance of a mean is a mean with squared weights
        channels = values.shape[-1]
        if channels == 1 or values.strides[-1] != values.itemsize:
            return self.weights[..., None]
        if channels not in self._repeated:
            self._repeated[channels] = self.weights.repeat(channels, axis=1).reshape(*self.weights.shape, channels)
        return self._repeated[channels]


def rows_of(images: Mapping[str, Array]) -> Rows:
    """What :meth:`WeightedSum.add` takes, of images in memory."""
    return lambda name, rows: images[name][rows]
