# SPDX-License-Identifier: Apache-2.0
"""Weighted means of frames, summed up in the arrays that hold the result."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from oiio_msspl.aovs.features import VARIANCE
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.parallel import for_row_blocks


class WeightedSum:
    """A sum of weighted features, in the images that hold the result.

    Args:
        images: (h, w, c) by feature; they count with a weight of 1, and are changed.
    """

    def __init__(self, images: dict[str, Array]) -> None:
        self._images = images
        height, width = next(iter(images.values())).shape[:2]
        self._weights: Array = np.ones((height, width), np.float32)
        self._squares = np.ones_like(self._weights)
        self._row_size = width * sum(image.shape[-1] for image in images.values())

    def add(self, feature: Callable[[str, slice], Array], weight: Array) -> None:
        """Add features with a weight (h, w).

        Args:
            feature: takes a name and rows, and returns the feature's pixels there (n, w, c), which are finite.
        """

        def work(rows: slice) -> None:
            part = weight[rows]
            squares = np.square(part)
            self._weights[rows] += part
            self._squares[rows] += squares
            with np.errstate(over="ignore", invalid="ignore"):  # the frame's own pixels may be NaN or infinite
                for name, image in self._images.items():
                    image[rows] += _of(name, part, squares) * feature(name, rows)

        for_row_blocks(work, len(self._weights), self._row_size)

    def divide(self) -> Array:
        """Turn the sums into means.

        Returns:
            (h, w, 1): the number of images with equal weight whose mean would have the same noise, at least 1.
        """

        def work(rows: slice) -> None:
            weights = self._weights[rows]
            squares = np.square(weights)
            with np.errstate(over="ignore", invalid="ignore"):
                for name, image in self._images.items():
                    image[rows] /= _of(name, weights, squares)

        for_row_blocks(work, len(self._weights), self._row_size)
        return np.divide(np.square(self._weights), self._squares, dtype=np.float32)[..., None]


def _of(feature: str, weights: Array, squares: Array) -> Array:
    """Return the weights of a feature: the variance of a mean is a mean with squared weights."""
    return (squares if feature == VARIANCE else weights)[..., None]
