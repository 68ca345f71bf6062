# SPDX-License-Identifier: Apache-2.0
"""Fuses alpha: the network treats it as a grey picture."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.fusion.tiles.features import TileFeatures
from oiio_msspl.fusion.tiles.guards import SMEAR, check_finite, repeated
from oiio_msspl.fusion.tiles.trust import Renders, trust_renders
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.filters import all_within
from oiio_msspl.model.render_mean import Images, Shares
from oiio_msspl.model.session import Session

#: Nearer to what is translucent, the network decides, up to this difference.
INVISIBLE = 1 / 256


def fuse_alpha(tile: TileFeatures, session: Session, shares: Shares, *, trust: bool) -> Array:
    """Fuse the alpha of a tile, (s*h, s*w, 1) in [0, 1].

    A pixel is exactly 1 or 0 if its LRHS pixel and the HRLS pixels around it are. A tile of such pixels only does not
    reach the network. If the LRHS has no alpha, that of the HRLS is kept.

    Args:
        shares: see :meth:`oiio_msspl.model.session.Session.run`.
        trust: put back what both renders show, such as crisp edges (:func:`.trust_renders`).
    """
    hrls_alpha = np.clip(tile.hrls["alpha"], 0.0, 1.0)
    if "alpha" not in tile.lrhs:
        return hrls_alpha
    lrhs_alpha = np.clip(tile.lrhs["alpha"], 0.0, 1.0)
    exact = [repeated(lrhs_alpha == value, tile.scale) & (hrls_alpha == value) for value in (0, 1)]
    if (exact[0] | exact[1]).all():
        return exact[1].astype(np.float32)
    grey = session.run(*alpha_as_colour(tile), 1.0, shares)["fused"]
    check_finite(session, grey)
    fused = grey.mean(axis=-1, keepdims=True)
    if trust and RGB in shares:
        renders = Renders(lrhs_alpha, hrls_alpha, shares[RGB], 1.0)
        fused, _ = trust_renders(fused, renders, session.contract.overlap)
    fused = np.clip(fused, 0.0, 1.0)
    for value, mask in enumerate(exact):
        near = all_within(mask, 1) & (np.abs(fused - np.float32(value)) < INVISIBLE)
        fused[all_within(mask, SMEAR) | near] = value
    return fused


def alpha_as_colour(tile: TileFeatures) -> tuple[Images, Images]:
    """Return albedo and normal of both renders of a tile, with their alpha as a grey colour."""
    lrhs, hrls = (
        {name: render[name] for name in (ALBEDO, NORMAL) if name in render}
        | {RGB: np.repeat(np.clip(render["alpha"], 0.0, 1.0), 3, axis=-1)}
        for render in (tile.lrhs, tile.hrls)
    )
    return lrhs, hrls
