# SPDX-License-Identifier: Apache-2.0
"""Lays out the table of flicker, and draws the sequences."""

from __future__ import annotations

import io
from collections.abc import Sequence as Rows
from pathlib import Path

import numpy as np

from benchmarks import results
from benchmarks.flicker.sequence import Sequence
from benchmarks.flicker.temporal import LENGTH
from benchmarks.results import Row
from oiio_msspl.arrays import Array
from oiio_msspl.exr.atomic import replacing

OIDN_FULL = "OIDN, same samples"
#: In the column `accumulated`: nothing, the method's outputs, or its inputs.
NOTHING, OUTPUTS, INPUTS = "nothing", "outputs", "inputs"
#: By how much the picture enlarges deviations.
GAIN = 4

Pictures = dict[tuple[str, str], Array]
"""(method, accumulated) -> sRGB (frames, h, w, 3)."""


def layout(rows: Rows[Row]) -> str:
    """Flicker of each method frame by frame, and with accumulation."""
    found = results.index(rows, "scene", "camera", "method", "accumulated")

    def of_oidn(row: Row, measure: str) -> str:
        other = found[row["scene"], row["camera"], OIDN_FULL, row["accumulated"]]
        return f"{row[measure] / other[measure]:.2f}"

    body = [
        [
            row["scene"],
            row["camera"],
            row["method"],
            _levels(row["mean_abs"]) if row["camera"] == "static" else "",
            _levels(row["rms"]),
            of_oidn(row, "rms"),
            _levels(row["rms_blotches"]),
            of_oidn(row, "rms_blotches"),
            _levels(row["rms_grain"]),
            f"{row['psnr']:.2f}",
            f"{row['psnr_worst']:.2f}",
        ]
        for row in rows
        if row["accumulated"] == NOTHING
    ]
    head = ["scene", "camera", "method", "mean abs.", "RMS", "of OIDN's", "blotches", "of OIDN's", "grain", "PSNR"]
    alone = results.markdown([*head, "worst frame"], body)

    body = []
    for key in dict.fromkeys((row["scene"], row["camera"], row["method"]) for row in rows):
        ways = (found[*key, way] for way in (NOTHING, OUTPUTS, INPUTS))
        body.append(
            [*key]
            + [
                f"{_levels(row['late_rms'])} / {_levels(row['late_rms_blotches'])} / {row['late_psnr']:.2f}"
                for row in ways
            ]
        )
    head = ["scene", "camera", "method", "frame by frame", "outputs accumulated", "inputs accumulated"]
    note = f"\nRMS / blotches / PSNR, accumulated over {LENGTH} frames, of the frames from the fifth on:\n\n"
    return alone + note + results.markdown(head, body)


def _levels(value: float) -> str:
    """An sRGB value from 0 to 1 in 8-bit levels."""
    return f"{255 * value:.2f}"


def draw(path: Path, shown: list[tuple[Sequence, Pictures]]) -> None:
    """Write a PNG: one image row over time, and how far the pixels of a static camera deviate over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    names = [name for name, accumulated in shown[0][1] if accumulated == NOTHING]
    heights = [h for sequence, _ in shown for h in ((1, 2) if sequence.camera == "static" else (1,))]
    figure = plt.figure(figsize=(2.7 * (len(names) + 1), sum(heights)), layout="constrained")
    grid = figure.subplots(len(heights), len(names) + 1, height_ratios=heights, squeeze=False)
    for axis, name in zip(grid[0], ("reference", *names), strict=True):
        axis.set_title(name)
    lines = iter(grid)
    for sequence, pictures in shown:
        truth = (sequence.truth[0] + sequence.truth[1]) / 2
        row = truth.shape[1] // 2
        line = next(lines)
        line[0].set_ylabel(f"{sequence.scene}\n{sequence.camera}" + f", x{GAIN}" * (sequence.camera == "static"))
        for axis, values in zip(line, (truth, *(pictures[name, NOTHING] for name in names)), strict=True):
            over_time = values[:, row]
            if sequence.camera == "static":
                over_time = 0.5 + GAIN * (over_time - over_time.mean(axis=0))
            axis.imshow(np.clip(over_time, 0, 1), aspect="auto", interpolation="nearest")
        if sequence.camera == "static":
            line = next(lines)
            line[0].set_ylabel("deviation\nover time")
            line[0].imshow(truth[0])
            line[0].axhline(row, color="red", linewidth=0.8)
            deviations = [255 * pictures[name, NOTHING].std(axis=0).mean(axis=-1) for name in names]
            top = float(np.percentile(deviations, 99))
            for axis, deviation in zip(line[1:], deviations, strict=True):
                drawn = axis.imshow(deviation, vmin=0, vmax=top, cmap="inferno")
            figure.colorbar(drawn, ax=line[-1], label="8-bit levels")
    for axis in grid.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    rendered = io.BytesIO()
    figure.savefig(rendered, dpi=75)
    with replacing(path, overwrite=True) as temporary:
        Image.open(rendered).convert("RGB").quantize(128).save(temporary)  # a palette needs a third of the bytes
