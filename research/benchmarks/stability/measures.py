# SPDX-License-Identifier: Apache-2.0
"""Measure a result, and word a verdict from the figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.image.arrays import Array, repair
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.metrics import psnr, relmse_map
from oiio_msspl.model.encoding import KEY, find_exposure
from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.stability.cases import DISAGREE, Case, Pair

#: Columns of the table: what tells its rows apart, and figures.
KEYS = ("scale", "group", "case", "method")
COLUMNS = ("psnr", "cost", "range", "holes", "stamps")
#: Share of pixels that the trimmed RelMSE leaves out: the worst ones.
TRIMMED = 1e-4
#: A result should stay in the range of the inputs within this many pixels to each side. Our networks average 10 x 10
#: HRLS pixels.
LRHS_REACH, HRLS_REACH = 1, 5
#: Values below this share of mid-grey are not compared: their ratios mean nothing.
FLOOR = 0.01

#: The verdict's thresholds.
EXCESS = 1.02
"""Factor from which a value counts as outside the inputs' range. Half floats and the encoding round."""
COST = 1.0
"""dB that a disturbance may cost before a method counts as suffering."""
DEVIATION = 0.01
"""Relative difference allowed between the result of a scaled scene and the scaled result."""
AWAY = 0.02
"""Relative change allowed in a pixel if nothing within ``NEAR`` LRHS pixels has changed."""
NEAR = 8

#: A hole is darker than these shares of the reference and of the median around it.
HOLE, HOLE_AROUND = 0.1, 0.25
#: "Around" a hole: this many LRHS pixels to each side, so that a hole as large as an LRHS pixel does not hide itself.
HOLE_REACH = 2
#: Side of the squares that are compared in search of stamps, in pixels.
CELL = 2
#: A step between two squares changes the brightness by this factor at least,
STEP = 1.25
#: and, as a logarithm, by this many times the largest change inside the squares around.
STEP_INSIDE = 3.0


def measure(case: Case, image: Array, clean: Array | None, enlarged: Array, warnings: list[str]) -> dict[str, Any]:
    """Return all figures of one result.

    Args:
        image: the result (h, w, 3), linear.
        clean: the same method's result for ``case.clean``.
        enlarged: the case's LRHS enlarged, without any method.
    """
    pair = case.pair
    truth = pair.reference
    grey = np.float32(find_exposure(truth))  # the scores are made for exposed pictures
    floor = np.float32(FLOOR * KEY) / grey
    low, high = input_range(pair)
    low = np.minimum(low, window(truth, HRLS_REACH, np.minimum))
    high = np.maximum(high, window(truth, HRLS_REACH, np.maximum))
    beyond = np.maximum((image + floor) / (high + floor), (low + floor) / (np.maximum(image, 0) + floor))
    errors = relmse_map(image * grey, truth * grey).mean(axis=-1)
    row: dict[str, Any] = {
        "finite": bool(np.isfinite(image).all()) and math.isfinite(errors.mean()),
        "relmse_trimmed": trimmed(errors),
        "relmse_enlarged": trimmed(relmse_map(enlarged * grey, truth * grey).mean(axis=-1)),
        "psnr": psnr(image * grey, truth * grey),
        "outside": float((beyond > EXCESS).mean()),
        "range": float(beyond.max()),
        "holes": int(holes(image, truth, float(floor), pair.scale).sum()),
        "stamps": stamps(image, truth, float(floor)),
        "warnings": warnings,
    }
    if clean is not None and case.clean is not None:
        grey = np.float32(find_exposure(case.clean.reference))
        row["cost"] = psnr(clean * grey, case.clean.reference * grey) - row["psnr"]
        change = np.abs(image / case.factor - clean) / (clean + floor / case.factor)
        if case.factor != 1:
            row["deviation"] = float(change.max())
        near = touched(case.clean, pair)
        if case.factor == 1 and near.mean() < 0.5:
            row["away"] = float(change[~near].max())
    return row


def verdict(row: dict[str, Any]) -> tuple[str, str]:
    """Return "holds", "suffers" or "fails", and a sentence, from the figures of :func:`measure` and the ``group``."""
    if not row["finite"]:
        return "fails", "NaN or Inf comes out."
    faults = []
    if row["range"] > EXCESS:
        faults.append(
            f"leaves the inputs' range by up to x{row['range']:.3g} in {100 * row['outside']:.2g} % of values"
        )
    if row.get("deviation", 0) > DEVIATION:
        faults.append(f"does not scale: off by up to {100 * row['deviation']:.2g} %")
    if row.get("away", 0) > AWAY:
        faults.append(f"changes by up to {100 * row['away']:.2g} % far from what changed")
    counts = {fault: row[f"{fault}s"] for fault in ("hole", "stamp")}
    faults += [f"{count} {fault}{'s' * (count > 1)}" for fault, count in counts.items() if count]
    if row.get("cost", 0) > COST:
        faults.append(f"costs {row['cost']:.1f} dB")
    worse = row["relmse_trimmed"] > row["relmse_enlarged"]
    if worse:
        faults.append("worse than the LRHS merely enlarged")
    silent = row["group"] == DISAGREE and row.get("cost", 0) > COST and not row["warnings"]
    text = "; ".join(faults) or "within the inputs"
    if "cost" in row and row["cost"] <= COST:
        text += f"; costs {max(0.0, row['cost']):.1f} dB"
    if row["warnings"] or silent:
        text += "; the tool warns" if row["warnings"] else "; nothing is said"
    return "fails" if worse or silent else "suffers" if faults else "holds", text[0].upper() + text[1:] + "."


def judged(measured: Sequence[dict[str, Any]]) -> list[Row]:
    """Return the table's rows: `KEYS`, `COLUMNS`, ``verdict`` and ``sentence``."""
    rows = []
    for figures in measured:
        row = {key: figures[key] for key in (*KEYS, *COLUMNS) if key in figures} | results.model_of(figures["method"])
        row["verdict"], row["sentence"] = verdict(figures)
        rows.append(row)
    return rows


def holes(image: Array, truth: Array, floor: float, scale: int) -> NDArray[np.bool_]:
    """Return the pixels (h, w) that are much darker than the reference and than their surroundings.

    Their luminance is below `HOLE` of the reference's and below `HOLE_AROUND` of the median of the result within
    `HOLE_REACH` LRHS pixels. Pixels whose reference is below ``floor`` are no holes.
    """
    value, wanted = luminance(image), luminance(truth)
    dark = (value < HOLE * wanted) & (wanted > floor)
    reach = HOLE_REACH * scale
    side = 2 * reach + 1
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(value, reach, mode="reflect"), (side, side))
    around = np.median(windows[dark].reshape(-1, side * side), axis=1)
    dark[dark] = value[dark] < HOLE_AROUND * around
    return dark


def stamps(image: Array, truth: Array, floor: float) -> int:
    """Count the rectangles stand out that no light made: a quarter of their corners, rounded up.

    Networks compute in squares of 2 x 2 pixels or more, and an LRHS pixel has at least as many, so the sides of such a
    rectangle lie along the `CELL` x `CELL` grid. A corner is a square that has a step both at a vertical and at a
    horizontal side, and is darker than both neighbours or brighter than both. The logarithm of result / reference is
    examined, so edges of the reference do not count. A step is the difference between the two lines of pixels along a
    side, each as a mean. It is larger than `STEP`, and `STEP_INSIDE` times as large as every difference between lines
    inside the squares around. Values below ``floor`` are not compared.
    """
    ratio = np.log((np.maximum(luminance(image), 0) + floor) / (luminance(truth) + floor))
    corners = sum(int((_sides(r) * _sides(r.T).T).sum()) for r in (ratio, -ratio))
    return math.ceil(corners / 4)


def _sides(ratio: Array) -> NDArray[np.int64]:
    """Count how many of the left and right side of every square are steps to a higher ratio, (h / CELL, w / CELL)."""
    height, width = (n // CELL for n in ratio.shape)
    lines = ratio[: height * CELL, : width * CELL].reshape(height, CELL, width * CELL).mean(axis=1)
    steps = np.pad(np.diff(lines, axis=1), ((0, 0), (0, 1))).reshape(height, width, CELL)
    across, inside = steps[:, :-1, -1], window(np.abs(steps[..., :-1]).max(axis=2), 1, np.maximum)
    limit = np.maximum(math.log(STEP), STEP_INSIDE * np.maximum(inside[:, :-1], inside[:, 1:]))
    sides = np.zeros((height, width), np.int64)
    sides[:, :-1] += across > limit
    sides[:, 1:] += across < -limit
    return sides


def trimmed(errors: NDArray[np.float64]) -> float:
    """Return the mean without the share `TRIMMED` of the largest values."""
    kept = errors.size - max(1, round(TRIMMED * errors.size))
    return float(np.partition(errors.ravel(), kept - 1)[:kept].mean())


def window(
    values: NDArray[Any], reach: int, extreme: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
) -> NDArray[Any]:
    """Return the largest or smallest value within ``reach`` pixels along x and y."""
    for axis in (0, 1):
        size = values.shape[axis]
        padded = np.pad(values, [(reach, reach) if i == axis else (0, 0) for i in range(values.ndim)], mode="edge")
        views = [padded.take(range(start, start + size), axis) for start in range(2 * reach + 1)]
        for view in views:
            values = extreme(values, view)
    return values


def input_range(pair: Pair) -> tuple[Array, Array]:
    """Return the smallest and largest value of both renders around every pixel, for each channel (h, w, 3)."""
    low, high = (repair(render.layers[RGB])[0] for render in (pair.lr, pair.hr))
    s = pair.scale
    result = []
    for extreme in (np.minimum, np.maximum):
        around = window(low, LRHS_REACH, extreme).repeat(s, 0).repeat(s, 1)
        result.append(extreme(around, window(high, HRLS_REACH, extreme)))
    return result[0], result[1]


def touched(before: Pair, after: Pair) -> NDArray[np.bool_]:
    """Return where either render differs within ``NEAR`` LRHS pixels, (h, w)."""
    s = after.scale
    low = _differs(before.lr.layers[RGB], after.lr.layers[RGB])
    high = np.zeros((low.shape[0] * s, low.shape[1] * s), bool)
    for name in {*before.hr.layers, *after.hr.layers}:
        if name not in before.hr.layers or name not in after.hr.layers:
            return np.ones_like(high)
        high |= _differs(before.hr.layers[name], after.hr.layers[name])
    low |= high.reshape(low.shape[0], s, low.shape[1], s).any((1, 3))
    return window(low, NEAR, np.maximum).repeat(s, 0).repeat(s, 1)


def _differs(a: Array, b: Array) -> NDArray[np.bool_]:
    return np.asarray(~np.isclose(a, b, rtol=0, atol=0, equal_nan=True).all(axis=-1))
