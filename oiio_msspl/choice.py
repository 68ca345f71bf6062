# SPDX-License-Identifier: Apache-2.0
"""Which model is enough for a pair: what ``--model auto`` means.

How much noise a pair has does not tell how good a small model will be: detail that it can't tell from noise decides.
So the small model is asked: what it expects its error to be, on some squares of the frame, goes with the PSNR that it
reaches (``benchmarks.ladder``).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from oiio_msspl import schema, tensors, transforms
from oiio_msspl.errors import MssplError
from oiio_msspl.fusion import fuse, scaled
from oiio_msspl.pairing import Pairing, Source, pair
from oiio_msspl.render import Array, Render, Window
from oiio_msspl.session import ALWAYS, AUTO, BEST, FAST, Session, find_model

#: Expected error of ``FAST``, as :func:`expected_error` has it, below which it is enough.
ENOUGH = 0.018
#: The frame is judged by so many squares across and down, of so many HRLS pixels each way.
ACROSS, DOWN, SQUARE = 3, 2, 256


def choose(lr: Source, hr: Source, name: str | None, load: Callable[[Path], Session]) -> tuple[Session, str]:
    """The model of a name, or for ``auto`` (or None) the smallest one that is enough, and why.

    Args:
        load: makes a session of a model's file, or has it already.

    Raises:
        InputError: there is no such model, it can't be loaded, or the two are no pair.
    """
    pairing = pair(lr, hr)
    if name not in (None, AUTO):
        return load(find_model(pairing.scale, name)), ""
    if not find_spec("pyoidn"):
        return load(find_model(pairing.scale, ALWAYS)), "auto: pyoidn is not installed"
    fast = load(find_model(pairing.scale, FAST))
    try:
        error = expected_error(lr, hr, pairing, fast)
    except MssplError:  # whatever it is, fusing the frame will say it
        return load(find_model(pairing.scale, BEST)), "auto"
    if error < ENOUGH:
        return fast, f"auto: expects an error of {error:.3f}, below {ENOUGH:g}"
    return load(find_model(pairing.scale, BEST)), f"auto: {fast.contract.name} expects an error of {error:.3f}"


def expected_error(lr: Source, hr: Source, pairing: Pairing, session: Session) -> float:
    """The mean error that a model expects on some squares of a pair, in network values (about those of the sRGB
    picture)."""
    fused = fuse(*_sample(lr, hr, pairing), session, error=True)
    assert fused.error is not None
    values = transforms.compress(fused.rgb, fused.exposure).mean(axis=-1, keepdims=True)
    brighter = transforms.expand(values, fused.exposure) + fused.error
    return float(np.mean(transforms.compress(brighter, fused.exposure) - values))


def _sample(lr: Source, hr: Source, pairing: Pairing) -> tuple[Render, Render]:
    """Squares of a pair side by side: a small pair of its own. All of a small frame."""
    grid, s = pairing.grid, pairing.scale
    rows, columns = (
        _spread(first, size, count, SQUARE // s)
        for first, size, count in ((grid.y0, grid.height, DOWN), (grid.x0, grid.width, ACROSS))
    )
    squares = [[Window(x0, y0, x1, y1) for x0, x1 in columns] for y0, y1 in rows]
    low = _mosaic(lr, squares, 1, pairing.lr_data)
    high = _mosaic(hr, squares, s, pairing.hr_data)
    return Render.from_arrays(lr.name, rgb=low[schema.RGB]), Render.from_arrays(hr.name, **high)


def _spread(first: int, size: int, count: int, side: int) -> list[tuple[int, int]]:
    """So many stretches of a length, evenly over a size; one of all of it where they would touch."""
    if size <= count * side:
        return [(first, first + size)]
    return [(start, start + side) for start in np.linspace(first, first + size - side, count).astype(int).tolist()]


def _mosaic(source: Source, squares: list[list[Window]], scale: int, have: Window) -> dict[str, Array]:
    """The layers that a network reads over rows of squares, which are in LRHS pixels."""
    rows = [[tensors.read(source, scaled(square, scale), have) for square in row] for row in squares]
    names = [name for name in rows[0][0] if name in schema.HRLS_FEATURES]
    return {
        name: np.concatenate([np.concatenate([part[name] for part in row], axis=1) for row in rows]) for name in names
    }
