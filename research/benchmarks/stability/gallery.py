# SPDX-License-Identifier: Apache-2.0
"""Pictures of the stability benchmark's cases."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from oiio_msspl.aovs.features import RGB
from oiio_msspl.compare import error_map
from oiio_msspl.exr.preview import write_png
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import srgb
from oiio_msspl.image.filters import box_downsample
from oiio_msspl.model.encoding import find_exposure
from research.benchmarks.results import Row
from research.benchmarks.stability.cases import Case
from research.benchmarks.stability.report import ENLARGED

#: Colours of the picture that is committed: error maps have few, and a palette needs a quarter of the bytes.
COLOURS = 48


class Gallery:
    """Collects pictures while the cases run."""

    def __init__(self) -> None:
        self._blocks: dict[str, list[Array]] = {}
        self._errors: dict[tuple[int, str, str], Array] = {}

    def add(self, scale: int, group: str, case: Case, pictures: dict[str, Array]) -> None:
        """Add a case's results, linear (h, w, 3) by method."""
        truth = case.pair.reference
        shown = case.factor * find_exposure(truth)
        hr = case.pair.hr.layers[RGB]
        views = [np.concatenate([_display(hr, shown), _display(truth, shown)], axis=1)]
        errors = []
        for image in pictures.values():
            error = error_map(image / np.float32(case.factor), truth / np.float32(case.factor))
            views.append(np.concatenate([_display(image, shown), error], axis=1))
            errors.append(_halved(_halved(error)))
        labels = [case.name, *pictures]
        rows = [labelled(_halved(view), label) for view, label in zip(views, labels, strict=True)]
        self._blocks.setdefault(f"x{scale}-{slug(group)}", []).append(np.concatenate(rows, axis=0))
        self._errors[scale, group, case.name] = labelled(np.concatenate(errors, axis=1), f"{group}: {case.name}")

    def write_groups(self, folder: Path) -> None:
        """A PNG for each group. A case has the HRLS and the reference above, then each method's result and error."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, blocks in self._blocks.items():
            write_png(folder / f"{name}.png", _rows_of(blocks, 4), overwrite=True)

    def write_worst(self, path: Path, rows: Sequence[Row]) -> None:
        """One PNG with the error maps of the worst case of each group, the methods from left to right."""
        from PIL import Image

        picture = _rows_of([self._errors[case] for case in worst_cases(rows)], 2)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.round(picture * 255).astype(np.uint8)).quantize(COLOURS).save(path, optimize=True)


def worst_cases(rows: Sequence[Row]) -> list[tuple[int, str, str]]:
    """For each scale and group the (scale, group, case) with the largest trimmed RelMSE of any method."""
    worst: dict[tuple[int, str], Row] = {}
    for row in rows:
        key = row["scale"], row["group"]
        if row["scenes"] == "analytic" and row["method"] != ENLARGED:
            worst[key] = max(worst.get(key, row), row, key=lambda r: r["relmse_trimmed"])
    return [(row["scale"], row["group"], row["case"]) for row in worst.values()]


def slug(group: str) -> str:
    """A group's name as part of a file name."""
    return "-".join("".join(c if c.isalnum() else " " for c in group.lower()).split())


def labelled(picture: Array, text: str) -> Array:
    """A picture with a line of text above."""
    canvas = oiio.ImageBuf(np.zeros((14, picture.shape[1], 3), np.float32))
    oiio.ImageBufAlgo.render_text(canvas, 2, 11, text, 10, "", (1.0, 1.0, 1.0))
    return np.concatenate([np.asarray(canvas.get_pixels(oiio.FLOAT), np.float32), picture], axis=0)


def _display(image: Array, exposure: float) -> Array:
    """sRGB at mid-grey; NaN and Inf are magenta."""
    bad = ~np.isfinite(image).all(axis=-1, keepdims=True)
    values = srgb(np.nan_to_num(image, posinf=0, neginf=0) * np.float32(exposure))
    return np.where(bad, np.asarray((1, 0, 1), np.float32), values)


def _halved(image: Array) -> Array:
    return box_downsample(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2], 2)


def _rows_of(blocks: Sequence[Array], columns: int) -> Array:
    """Blocks of the same width in rows; black where the last row ends early."""
    columns = min(columns, len(blocks))
    rows = []
    for start in range(0, len(blocks), columns):
        row = list(blocks[start : start + columns])
        height = max(block.shape[0] for block in row)
        row += [np.zeros_like(row[0])] * (columns - len(row))
        rows.append(np.concatenate([np.pad(b, [(0, height - b.shape[0]), (0, 4), (0, 0)]) for b in row], axis=1))
    return np.concatenate(rows, axis=0)
