# SPDX-License-Identifier: Apache-2.0
"""The shape of Open Image Denoise's U-Nets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar


@dataclass(frozen=True)
class Shape:
    """Names of a U-Net's convolutions, all 3 x 3 and followed by a ReLU: of each level down, at the bottom, of each
    level up (which reads the level below, enlarged, and what went into the level down), and the one that makes colour.
    """

    down: list[list[str]]
    bottom: list[str]
    up: list[list[str]]
    last: str


SMALLER = Shape(
    [["enc_conv0", "enc_conv1"], ["enc_conv2"], ["enc_conv3"], ["enc_conv4"]],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv0",
)
LARGER = Shape(
    [[f"enc_conv{level}{part}" for part in "ab"] for level in (1, 2, 3, 4)],
    ["enc_conv5a", "enc_conv5b"],
    [[f"dec_conv{level}{part}" for part in "ab"] for level in (4, 3, 2, 1)],
    "dec_conv1c",
)

T = TypeVar("T")


def walk(
    shape: Shape,
    pictures: Sequence[T],
    conv: Callable[[str, T], T],
    halve: Callable[[T], T],
    double: Callable[[T], T],
    join: Callable[[T, T], T],
) -> T:
    """A U-Net on anything: tensors, lists of them, names of a graph.

    Args:
        pictures: what it reads, by level: the whole size, a half of it ... The first level has one.
        join: of the same size, by channels.
    """
    values, *smaller = pictures
    skipped = []
    for level in shape.down:
        skipped.append(values)
        for name in level:
            values = conv(name, values)
        values = halve(values)
        if smaller:
            values = join(values, smaller.pop(0))
    for name in shape.bottom:
        values = conv(name, values)
    for level in shape.up:
        values = join(double(values), skipped.pop())
        for name in level:
            values = conv(name, values)
    return conv(shape.last, values)
