# SPDX-License-Identifier: Apache-2.0
"""Read the references of a sequence, and find where averaging over time is hard.

:mod:`research.benchmarks.render.sequences` and :mod:`research.datagen.cycles.sequence` render the files.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import OpenEXR

from oiio_msspl import map_render, open_exr
from oiio_msspl.errors import InputError
from oiio_msspl.fusion.motion.source import MotionFrame, find_motion
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import srgb
from oiio_msspl.image.filters import blurred
from oiio_msspl.image.sampling import sample_cubic
from research.benchmarks.render.sequences import MOTION, STATIC
from research.benchmarks.scenes import beauty
from research.benchmarks.shots.measures import Mask

#: A surface is hidden in a neighbour if the way there and back ends further away than this, in pixels.
ROUND_TRIP = 1.0
#: The light has changed where the reference differs from its neighbour by this, in sRGB values, after the squares were
#: blurred so often.
CHANGED, BLURS = 0.02, 4


@dataclass(frozen=True)
class Sequence:
    """A sequence without what is to be measured."""

    folder: Path
    numbers: list[int]
    """The frames."""
    truth: tuple[Array, Array]
    """Two references with independent noise, linear (frames, h, w, 3)."""
    masks: dict[str, Mask]
    """Name -> (frames, h, w), of the masks that are not empty: ``disocclusion``, surfaces that a neighbouring frame
    hides, and ``light`` that changes."""

    @property
    def name(self) -> str:
        """``SCENE/KIND``."""
        return f"{self.folder.parent.name}/{self.folder.name}"


def load(folder: Path, motion_format: str | None = None) -> Sequence:
    """Read a folder ``SCENE/KIND``. ``motion_format`` is that of `msspl-fuse`.

    Raises:
        InputError: files are missing.
    """
    numbers = sorted(int(path.suffixes[0][1:]) for path in folder.glob("hr.*.exr"))
    of_references = numbers[:1] if folder.name == STATIC else numbers
    names = [f"{kind}.{n:04d}.exr" for kind in ("full", "lr_x2", "lr_x4") for n in numbers]
    names += [f"ref_{half}.{n:04d}.exr" for half in "ab" for n in of_references]
    missing = [name for name in names if not (folder / name).exists()]
    if len(numbers) < 2 or missing:
        raise InputError(f"{folder}: {', '.join(missing[:3]) or 'hr.*.exr'} is missing; render the sequence again")
    halves = [np.stack([beauty(map_render(open_exr(folder / f"ref_{half}.{n:04d}.exr"))) for n in of_references])
              for half in "ab"]  # fmt: skip
    truth = tuple(np.broadcast_to(half, (len(numbers), *half.shape[1:])) for half in halves)
    back, forth = _motion(folder, numbers, motion_format)
    seen = [_returns(forth[t], back[t + 1]) for t in range(len(numbers) - 1)]
    seen_before = [_returns(back[t + 1], forth[t]) for t in range(len(numbers) - 1)]
    everywhere = np.ones((1, *seen[0].shape), bool)
    hidden = ~np.concatenate([seen, everywhere]) | ~np.concatenate([everywhere, seen_before])
    pictures = srgb(truth[0]), srgb(truth[1])
    light = np.zeros_like(hidden)
    for t in range(len(numbers) - 1):
        light[t] |= seen[t] & _differs(pictures, t, t + 1, forth[t])
        light[t + 1] |= seen_before[t] & _differs(pictures, t + 1, t, back[t + 1])
    masks = {name: mask for name, mask in (("disocclusion", hidden), ("light", light)) if mask.any()}
    return Sequence(folder, numbers, (truth[0], truth[1]), masks)


def without_vectors(sequence: Sequence, folder: Path) -> Sequence:
    """Write a sequence without motion vectors into a folder: link its files, except the HRLS."""
    target = folder / sequence.name
    target.mkdir(parents=True)
    for path in sequence.folder.iterdir():
        if not path.name.startswith("hr."):
            (target / path.name).symlink_to(path.resolve())
            continue
        with OpenEXR.File(str(path), separate_channels=True) as file:
            kept = {name: c.pixels for name, c in file.channels().items() if name not in MOTION}
            with OpenEXR.File(file.header(), kept) as written:
                written.write(str(target / path.name))
    return replace(sequence, folder=target)


def write_one_render(sequence: Sequence, number: int, path: Path) -> None:
    """Write the full-resolution render of a frame, with the layers of its HRLS that it lacks, such as vectors."""
    files = [str(sequence.folder / f"{kind}.{number:04d}.exr") for kind in ("full", "hr")]
    with OpenEXR.File(files[0], separate_channels=True) as full, OpenEXR.File(files[1], separate_channels=True) as hr:
        pixels = {name: channel.pixels for name, channel in (hr.channels() | full.channels()).items()}
        with OpenEXR.File(full.header(), pixels) as written:
            written.write(str(path))


def _channels(path: Path) -> dict[str, Array]:
    """Return all channels (h, w) of a file, by name."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def _motion(folder: Path, numbers: list[int], motion_format: str | None) -> tuple[list[Array], list[Array]]:
    """Return vectors (h, w, 2) from each frame to the previous and the next one: exact ones, or the renderer's."""
    renders = [_channels(folder / f"hr.{n:04d}.exr") for n in numbers]
    if MOTION[0] in renders[0]:
        stored = [np.stack([render[name] for name in MOTION], axis=-1, dtype=np.float32) for render in renders]
        return [vectors[..., :2] for vectors in stored], [vectors[..., 2:] for vectors in stored]
    frames = [MotionFrame(map_render(open_exr(folder / f"hr.{n:04d}.exr"))) for n in numbers]
    source = find_motion(frames[0].hr, frames[1].hr, motion_format, required=True)
    back = [source.read(here, there, -1)[0] for there, here in itertools.pairwise(frames)]
    forth = [source.read(here, there, 1)[0] for here, there in itertools.pairwise(frames)]
    return [np.zeros_like(back[0]), *back], [*forth, np.zeros_like(forth[0])]


def _returns(vectors: Array, back: Array) -> Mask:
    """Return where a vector leads into the picture, and the other frame's vector leads back."""
    height, width = vectors.shape[:2]
    y, x = np.mgrid[0:height, 0:width] + np.moveaxis(vectors, -1, 0)[::-1]
    row, column = np.rint(y).astype(int), np.rint(x).astype(int)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    home = vectors + back[row.clip(0, height - 1), column.clip(0, width - 1)]
    return inside & (np.square(home).sum(axis=-1) < ROUND_TRIP**2)


def _differs(pictures: tuple[Array, Array], t: int, other: int, vectors: Array) -> Mask:
    """Return where a frame of the reference differs from another one that is brought to its place."""
    height, width = vectors.shape[:2]
    y, x = np.mgrid[0:height, 0:width] + np.moveaxis(vectors, -1, 0)[::-1]
    images, everywhere = [half[other] for half in pictures], np.ones((height, width), bool)
    warped = sample_cubic(images, lambda rows: (x[rows], y[rows]), (height, width), everywhere)
    first, second = (half[t] - moved for half, moved in zip(pictures, warped, strict=True))
    return np.asarray(blurred((first * second).mean(axis=-1), BLURS) > CHANGED**2)
