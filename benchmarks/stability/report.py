# SPDX-License-Identifier: Apache-2.0
"""The suite's rows as tables, and its results as pictures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from benchmarks.stability.measures import AWAY, COST, EXCESS, FLOOR, HRLS_REACH, LRHS_REACH, NEAR, TRIMMED
from oiio_msspl import transforms
from oiio_msspl.comparison import error_map
from oiio_msspl.preview import write_png
from oiio_msspl.render import Array

INTRODUCTION = """\
# How stable it is

Printed by `python -m benchmarks.stability`, which puts pairs through everything that goes wrong on a set, with exact
references: the scenes are analytic pictures, rendered with the noise of one-sample Monte Carlo (HRLS of 1 spp, where
layers or variance are disturbed of 4; LRHS of one sample a HRLS pixel; unless a case says otherwise), and held-out
rendered views where such are given.

* **worst pixel**: the largest value, over the largest of the reference within {hrls_reach} pixels.
* **RelMSE** (0.5, 0.01), **trimmed** of the worst {trimmed:g} % of the pixels, and **PSNR** (sRGB): with the
  reference's log-mean at mid-grey, so that they say something of dark and of very bright frames too.
* **cost**: PSNR that the disturbance costs against the same method's result for the undisturbed pair.
* **range**: the furthest that a value lies beyond what both inputs have around its pixel, {lrhs} x {lrhs} LRHS and
  {hrls} x {hrls} HRLS pixels, as a factor; x1 is inside. Less than {floor:g} of mid-grey counts as nothing.

The sentence follows from the figures (thresholds in `benchmarks/stability/measures.py`). A method **fails** where the
LRHS merely enlarged is closer to the truth, where something not finite comes out, or where a pair that does not belong
together costs more than {cost:g} dB without a warning. It **suffers** where a value is more than {excess:.0f} % outside
the inputs' range, a disturbance costs more than {cost:g} dB, a scaled scene does not give a scaled result, or the
result changes by more than {away:.0f} % more than {near} LRHS pixels away from what changed. OIDN gets the HRLS with
albedo and normal. *The tool warns*: `msspl-fuse` says something on that pair; about spp outside training it warns too,
from the files' metadata.
""".format(
    hrls_reach=HRLS_REACH,
    trimmed=100 * TRIMMED,
    lrhs=2 * LRHS_REACH + 1,
    hrls=2 * HRLS_REACH + 1,
    floor=FLOOR,
    cost=COST,
    excess=100 * (EXCESS - 1),
    away=100 * AWAY,
    near=NEAR,
)
ENLARGED = "LRHS enlarged"
COLUMNS = (
    ("worst pixel", lambda r: f"x{r['worst_ratio']:.3g}"),
    ("RelMSE", lambda r: f"{r['relmse']:.4g}"),
    ("trimmed", lambda r: f"{r['relmse_trimmed']:.4g}"),
    ("PSNR", lambda r: f"{r['psnr']:.2f}"),
    ("cost, dB", lambda r: f"{r['cost']:.2f}" if "cost" in r else ""),
    ("range", lambda r: f"x{r['excess']:.3g}"),
)


def pooled(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each scale, case and method of several views: the worst of the worst, means of the means."""
    worst = ("worst_ratio", "worst_error", "excess", "deviation", "away")
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["scale"], row["group"], row["case"], row["method"]), []).append(row)
    result = []
    for members in groups.values():
        row = dict(members[0])
        for key, value in members[0].items():
            if isinstance(value, float):
                values = [member.get(key, 0.0) for member in members]
                row[key] = max(values) if key in worst else float(np.mean(values))
        row["finite"] = all(member["finite"] for member in members)
        row["warnings"] = [warning for member in members for warning in member["warnings"]]
        result.append(row)
    return result


def summary(rows: list[dict[str, Any]]) -> Iterable[str]:
    """A line for each method: how often it holds, suffers and fails."""
    yield "| method | holds | suffers | fails | furthest outside the inputs' range | RelMSE finite |"
    yield "|---|---|---|---|---|---|"
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        if method == ENLARGED:
            continue
        counts = [sum(row["verdict"] == grade for row in mine) for grade in ("holds", "suffers", "fails")]
        worst = max(mine, key=lambda row: row["excess"])
        finite = "everywhere" if all(np.isfinite(row["relmse"]) for row in mine) else "no"
        where = f"x{worst['excess']:.3g} ({worst['group']}: {worst['case']})"
        yield f"| {method} | " + " | ".join(map(str, counts)) + f" | {where} | {finite} |"


def tables(rows: list[dict[str, Any]]) -> Iterable[str]:
    """A table for each group: a row for each case and method."""
    for group in dict.fromkeys(row["group"] for row in rows):
        yield f"\n### {group[0].upper() + group[1:]}\n"
        yield "| case | method | " + " | ".join(name for name, _ in COLUMNS) + " | |"
        yield "|---|---|" + "---|" * (len(COLUMNS) + 1)
        shown = None
        for row in (row for row in rows if row["group"] == group):
            case = "" if row["case"] == shown else row["case"]
            shown = row["case"]
            cells = " | ".join(form(row) for _, form in COLUMNS)
            sentence = "" if row["method"] == ENLARGED else f"**{row['verdict']}**: {row['sentence']}"
            yield f"| {case} | {row['method']} | {cells} | {sentence} |"


# Pictures


class Gallery:
    """Collects a group's pictures while it runs: a block a case, HRLS and reference above, then for each method its
    result and its error."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._blocks: list[Array] = []
        self._sheet: list[Array] = []
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, case: str, hr: Array, truth: Array, results: dict[str, Array], factor: float) -> None:
        """Linear pictures of one case, (H, W, 3)."""
        shown = factor * transforms.exposure_of(truth)
        views = [np.concatenate([_display(hr, shown), _display(truth, shown)], axis=1)]
        labels = [case]
        for method, image in results.items():
            error = error_map(image / np.float32(factor), truth / np.float32(factor))
            views.append(np.concatenate([_display(image, shown), error], axis=1))
            labels.append(method)
        rows = [labelled(_halved(view), label) for view, label in zip(views, labels, strict=True)]
        self._blocks.append(np.concatenate(rows, axis=0))
        errors = [_halved(_halved(view[:, view.shape[1] // 2 :])) for view in views[1:]]
        self._sheet.append(labelled(np.concatenate(errors, axis=1), case))

    def write_group(self, name: str) -> None:
        if self._blocks:
            write_png(self.folder / f"{name}.png", _rows_of(self._blocks, 4), overwrite=True)
            self._blocks = []

    def write_sheet(self, name: str) -> None:
        """Every case's error maps, the methods from left to right."""
        write_png(self.folder / f"{name}.png", _rows_of(self._sheet, 4), overwrite=True)


def slug(group: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in group.lower()).split())


def labelled(picture: Array, text: str) -> Array:
    """A picture with a line of text above."""
    canvas = oiio.ImageBuf(np.zeros((14, picture.shape[1], 3), np.float32))
    oiio.ImageBufAlgo.render_text(canvas, 2, 11, text, 10, "", (1.0, 1.0, 1.0))
    return np.concatenate([np.asarray(canvas.get_pixels(oiio.FLOAT), np.float32), picture], axis=0)


def _display(image: Array, exposure: float) -> Array:
    """sRGB at mid-grey; what is not finite is magenta."""
    bad = ~np.isfinite(image).all(axis=-1, keepdims=True)
    values = transforms.srgb(np.nan_to_num(image, posinf=0, neginf=0) * np.float32(exposure))
    return np.where(bad, np.asarray((1, 0, 1), np.float32), values)


def _halved(image: Array) -> Array:
    height, width = (n // 2 * 2 for n in image.shape[:2])
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))


def _rows_of(blocks: list[Array], columns: int) -> Array:
    """Blocks of one width in rows, black where the last row ends early."""
    columns = min(columns, len(blocks))
    rows = []
    for start in range(0, len(blocks), columns):
        row = blocks[start : start + columns]
        height = max(block.shape[0] for block in row)
        row += [np.zeros_like(row[0])] * (columns - len(row))
        rows.append(np.concatenate([np.pad(b, [(0, height - b.shape[0]), (0, 4), (0, 0)]) for b in row], axis=1))
    return np.concatenate(rows, axis=0)
