# SPDX-License-Identifier: Apache-2.0
"""Reads the sequences that :mod:`benchmarks.render.sequences` has rendered."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from benchmarks.flicker.temporal import Layers, Motion
from benchmarks.scenes import beauty
from oiio_msspl import map_render, open_exr
from oiio_msspl.arrays import Array
from oiio_msspl.colour import srgb
from oiio_msspl.errors import InputError


@dataclass(frozen=True)
class Sequence:
    """The renders of one scene and camera."""

    scene: str
    camera: str
    lr: list[Layers]
    hr: list[Layers]
    full: list[Layers]
    hr_motion: list[Motion]
    full_motion: list[Motion]
    truth: tuple[Array, Array]
    """Two references with independent noise, sRGB (frames, h, w, 3)."""


def load(folder: Path) -> Sequence:
    """Read a folder ``SCENE/CAMERA``.

    Raises:
        InputError: files are missing.
    """
    paths = {kind: sorted(folder.glob(f"{kind}.*.exr")) for kind in ("lr", "hr", "full", "ref_a", "ref_b")}
    count, references = len(paths["hr"]), 1 if folder.name == "static" else len(paths["hr"])
    if count < 2 or [len(files) for files in paths.values()] != [count] * 3 + [references] * 2:
        raise InputError(f"{folder}: the sequence is not complete; render again to make what is missing")

    def layers(kind: str) -> list[Layers]:
        return [map_render(open_exr(path)).load().layers for path in paths[kind]]

    first, second = (
        srgb(np.stack([beauty(map_render(open_exr(p))) for p in paths[kind]])) for kind in ("ref_a", "ref_b")
    )
    shape = (count, *first.shape[1:])
    return Sequence(
        folder.parent.name,
        folder.name,
        layers("lr"),
        layers("hr"),
        layers("full"),
        [_read_motion(path) for path in paths["hr"]],
        [_read_motion(path) for path in paths["full"]],
        (np.broadcast_to(first, shape), np.broadcast_to(second, shape)),
    )


def _read_motion(path: Path) -> Motion:
    image = oiio.ImageBuf(str(path))
    names = [image.spec().channelnames.index(name) for name in ("motion.X", "motion.Y", "dd.T")]
    values = np.asarray(image.get_pixels(oiio.FLOAT))[..., names]
    return Motion(values[..., :2], values[..., 2])
