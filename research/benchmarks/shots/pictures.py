# SPDX-License-Identifier: Apache-2.0
"""Draw a sequence."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from oiio_msspl.exr.atomic import replacing
from oiio_msspl.image.arrays import Array


def strip(path: Path, shown: dict[str, Array], frames: list[int], crop: tuple[slice, slice], row: int) -> None:
    """Write a PNG: a detail of some frames, and below it an image row over time.

    Args:
        shown: title -> sRGB (frames, h, w, 3).
        frames: indices of the frames.
        crop: rows and columns of the detail.
        row: the image row.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    height = (crop[0].stop - crop[0].start) / (crop[1].stop - crop[1].start)
    ratios = [height] * len(frames) + [0.3]
    width = 2.2
    size = (width * len(shown), width * (sum(ratios) + 0.35))
    figure, grid = plt.subplots(len(ratios), len(shown), figsize=size, height_ratios=ratios, layout="constrained")
    for column, (title, images) in zip(grid.T, shown.items(), strict=True):
        column[0].set_title(title, fontsize=9)
        for axis, frame in zip(column, frames, strict=False):
            axis.imshow(np.clip(images[frame][crop], 0, 1), interpolation="nearest", aspect="auto")
        column[-1].imshow(np.clip(images[:, row, crop[1]], 0, 1), interpolation="nearest", aspect="auto")
    labels = [*(f"frame {frame + 1}" for frame in frames), "row, over time"]
    for axis, label in zip(grid[:, 0], labels, strict=True):
        axis.set_ylabel(label, fontsize=8)
    for axis in grid.flat:
        axis.set(xticks=[], yticks=[])
    rendered = io.BytesIO()
    figure.savefig(rendered, dpi=100)
    with replacing(path, overwrite=True) as temporary:
        Image.open(rendered).convert("RGB").quantize(96).save(temporary)  # a palette needs a third of the bytes


def film(path: Path, shown: dict[str, Array], crop: tuple[slice, slice]) -> None:
    """Write an animated WebP of details side by side, which plays forwards and backwards."""
    from PIL import Image, ImageDraw

    wide = [np.clip(images[(slice(None), *crop)], 0, 1) for images in shown.values()]
    frames = []
    for t in [*range(len(wide[0])), *range(len(wide[0]) - 2, 0, -1)]:
        joined = np.concatenate([np.pad(images[t], [(12, 0), (0, 2), (0, 0)]) for images in wide], axis=1)
        picture = Image.fromarray((joined * 255 + 0.5).astype(np.uint8))
        for i, title in enumerate(shown):
            ImageDraw.Draw(picture).text((i * (wide[0].shape[2] + 2) + 3, 0), title, fill="white")
        frames.append(picture)
    with replacing(path, overwrite=True) as temporary:
        timing = {"append_images": frames[1:], "duration": 120, "loop": 0}
        frames[0].save(temporary, format="WEBP", save_all=True, quality=80, method=6, **timing)
