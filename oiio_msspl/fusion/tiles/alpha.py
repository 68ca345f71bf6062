# SPDX-License-Identifier: Apache-2.0
"""Fuses alpha: the network treats it as a grey picture."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.fusion.tiles.features import TileFeatures
from oiio_msspl.fusion.tiles.guards import check_finite, repeated
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import all_within
from oiio_msspl.model.render_mean import Images, Shares
from oiio_msspl.model.session import Session


def fuse_alpha(tile: TileFeatures, session: Session, shares: Shares) -> Array:
    """Fuse the alpha of a tile, (s*h, s*w, 1) in [0, 1].

    A pixel is exactly 1 or 0 if its LRHS pixel and the 3 x 3 HRLS pixels around it are. The network would blur edges
    over several pixels. A tile of such pixels only does not reach the network. If the LRHS has no alpha, that of the
    HRLS is kept.

    Args:
        shares: see :meth:`oiio_msspl.model.session.Session.run`.
    """
    hrls_alpha = np.clip(tile.hrls["alpha"], 0.0, 1.0)
    if "alpha" not in tile.lrhs:
        return hrls_alpha
    lrhs_alpha = np.clip(tile.lrhs["alpha"], 0.0, 1.0)
    solid, empty = (repeated(lrhs_alpha == value, tile.scale) & all_within(hrls_alpha == value, 1) for value in (1, 0))
    if (solid | empty).all():
        return solid.astype(np.float32)
    grey = session.run(*alpha_as_colour(tile), 1.0, shares)["fused"]
    check_finite(session, grey)
    fused = np.clip(grey.mean(axis=-1, keepdims=True), 0.0, 1.0)
    return np.where(solid, np.float32(1), np.where(empty, np.float32(0), fused))


def alpha_as_colour(tile: TileFeatures) -> tuple[Images, Images]:
    """Return albedo and normal of both renders of a tile, with their alpha as a grey colour."""
    lrhs, hrls = (
        {name: render[name] for name in (ALBEDO, NORMAL) if name in render}
        | {RGB: np.repeat(np.clip(render["alpha"], 0.0, 1.0), 3, axis=-1)}
        for render in (tile.lrhs, tile.hrls)
    )
    return lrhs, hrls
