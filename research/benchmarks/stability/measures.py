# SPDX-License-Identifier: Apache-2.0
"""Measure a result, and judge the figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.aovs.features import RGB
from oiio_msspl.image.arrays import Array, repair
from oiio_msspl.image.colour import luminance
from oiio_msspl.image.filters import max_around
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
    low = np.minimum(low, highest(truth, HRLS_REACH, -1))
    high = np.maximum(high, highest(truth, HRLS_REACH))
    beyond = np.maximum((image + floor) / (high + floor), (low + floor) / (np.maximum(image, 0) + floor))
    errors = relmse_map(image * grey, truth * grey).mean(axis=-1)
    row: dict[str, Any] = {
        "finite": bool(np.isfinite(image).all()) and math.isfinite(errors.mean()),
        "relmse_trimmed": trimmed(errors),
        "relmse_enlarged": trimmed(relmse_map(enlarged * grey, truth * grey).mean(axis=-1)),
        "psnr": psnr(image * grey, truth * grey),
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
    """Return "holds", "suffers" or "fails", and the faults, from the figures of :func:`measure` and the ``group``."""
    worse = row["relmse_trimmed"] > row["relmse_enlarged"]
    costs = row.get("cost", 0) > COST
    silent = row["group"] == DISAGREE and costs and not row["warnings"]
    faults = {
        "NaN or Inf": not row["finite"],
        "outside the inputs' range": row["range"] > EXCESS,
        "does not scale": row.get("deviation", 0) > DEVIATION,
        "changes far from what changed": row.get("away", 0) > AWAY,
        "holes": row["holes"] > 0,
        "stamps": row["stamps"] > 0,
        f"costs more than {COST:g} dB": costs,
        "worse than the LRHS merely enlarged": worse,
        "no warning": silent,
    }
    found = "; ".join(fault for fault, there in faults.items() if there)
    return "fails" if worse or silent or not row["finite"] else "suffers" if found else "holds", found


def judged(measured: Sequence[dict[str, Any]]) -> list[Row]:
    """Return the table's rows: `KEYS`, `COLUMNS`, ``verdict`` and ``faults``."""
    rows = []
    for figures in measured:
        row = {key: figures[key] for key in (*KEYS, *COLUMNS) if key in figures} | results.model_of(figures["method"])
        row["verdict"], row["faults"] = verdict(figures)
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
    across, inside = steps[:, :-1, -1], max_around(np.abs(steps[..., :-1]).max(axis=2), 1)
    limit = np.maximum(math.log(STEP), STEP_INSIDE * np.maximum(inside[:, :-1], inside[:, 1:]))
    sides = np.zeros((height, width), np.int64)
    sides[:, :-1] += across > limit
    sides[:, 1:] += across < -limit
    return sides


def trimmed(errors: NDArray[np.float64]) -> float:
    """Return the mean without the share `TRIMMED` of the largest values."""
    kept = errors.size - max(1, round(TRIMMED * errors.size))
    return float(np.partition(errors.ravel(), kept - 1)[:kept].mean())


def highest(values: NDArray[Any], reach: int, sign: int = 1) -> NDArray[Any]:
    """Return the largest value within ``reach`` pixels along x and y; with a ``sign`` of -1 the smallest."""
    return sign * max_around(sign * values, reach)


def input_range(pair: Pair) -> tuple[Array, Array]:
    """Return the smallest and largest value of both renders around every pixel, for each channel (h, w, 3)."""
    low, high = (repair(render.layers[RGB])[0] for render in (pair.lr, pair.hr))
    s = pair.scale
    result = []
    for sign, extreme in ((-1, np.minimum), (1, np.maximum)):
        around = highest(low, LRHS_REACH, sign).repeat(s, 0).repeat(s, 1)
        result.append(extreme(around, highest(high, HRLS_REACH, sign)))
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
    return max_around(low, NEAR).repeat(s, 0).repeat(s, 1)


def _differs(a: Array, b: Array) -> NDArray[np.bool_]:
    return np.asarray(~np.isclose(a, b, rtol=0, atol=0, equal_nan=True).all(axis=-1))
