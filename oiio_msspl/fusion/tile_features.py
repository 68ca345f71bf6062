# SPDX-License-Identifier: Apache-2.0
"""From a source's pixels to the network's stacked channels."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from oiio_msspl.aovs.features import NORMAL
from oiio_msspl.arrays import Array, repair
from oiio_msspl.exr.render import ReadableRender, Window

#: Features that may be negative.
SIGNED_FEATURES = {NORMAL}


def read_features(
    source: ReadableRender,
    want: Window,
    have: Window,
    *,
    counts: dict[str, int] | None = None,
    counted: Window | None = None,
    features: Iterable[str] | None = None,
) -> dict[str, Array]:
    """Repaired layers of a source over ``want``; beyond ``have`` the nearest pixel is repeated.

    Args:
        want, have: what to read, and the source's data window, both counted from its display window's top left.
        counts: repaired values by layer are added here, as far as they lie in ``counted`` (overlaps are read twice).
        features: which layers; all if None.
    """
    rows = np.clip(np.arange(want.y0, want.y1), have.y0, have.y1 - 1)
    columns = np.clip(np.arange(want.x0, want.x1), have.x0, have.x1 - 1)
    inside = Window(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    layers = source.read(inside.shift(source.display_window.x0, source.display_window.y0), features)
    result = {}
    for name, values in layers.items():
        repaired, bad = repair(values, signed=name in SIGNED_FEATURES)
        if bad is not None and counts is not None and counted is not None:
            changed = int(np.count_nonzero(bad[counted.intersect(inside).slices(inside)]))
            counts[name] = counts.get(name, 0) + changed
        repeated = (rows[:, None] - inside.y0, columns[None, :] - inside.x0)
        result[name] = repaired if inside == want else repaired[repeated]
    return result
