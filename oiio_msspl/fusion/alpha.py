# SPDX-License-Identifier: Apache-2.0
"""Fuses alpha: the network treats it as a grey picture."""

from __future__ import annotations

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, LRHS_FEATURES, NORMAL, RGB
from oiio_msspl.arrays import Array, planes
from oiio_msspl.fusion.guards import check_finite, holds_around
from oiio_msspl.fusion.tile_features import TilePair
from oiio_msspl.model.contract import Contract
from oiio_msspl.model.encoding import decode_radiance, encode_features
from oiio_msspl.model.render_mean import Images, MeanSettings
from oiio_msspl.model.session import Session


def fuse_alpha(pair: TilePair, session: Session, lrhs_aovs: Images, mean: MeanSettings | None = None) -> Array:
    """Alpha of a tile, (s*h, s*w, 1) in [0, 1].

    Where both renders agree that a pixel and its surroundings are fully covered or fully empty, it stays exactly 1 or
    0. A tile that is all of one kind does not reach the network. Without an alpha in the LRHS, the HRLS's is kept.

    Args:
        lrhs_aovs, mean: see :meth:`oiio_msspl.model.session.Session.run`.
    """
    hrls_alpha = np.clip(pair.hrls["alpha"], 0.0, 1.0)
    if "alpha" not in pair.lrhs:
        return hrls_alpha
    lrhs_alpha = np.clip(pair.lrhs["alpha"], 0.0, 1.0)
    solid = holds_around(lrhs_alpha == 1, hrls_alpha == 1, pair.scale)
    empty = holds_around(lrhs_alpha == 0, hrls_alpha == 0, pair.scale)
    if (solid | empty).all():
        return solid.astype(np.float32)
    lrhs, hrls = encode_alpha(pair, session.contract)
    encoded = session.run(lrhs, hrls, lrhs_aovs=lrhs_aovs, mean=mean)["fused"]
    check_finite(session, encoded)
    fused = np.clip(decode_radiance(encoded, 1.0).mean(axis=-1, keepdims=True), 0.0, 1.0)
    return np.where(solid, np.float32(1), np.where(empty, np.float32(0), fused))


def encode_alpha(pair: TilePair, contract: Contract) -> tuple[Array, Array]:
    """Both alphas of a tile as encoded grey pictures, as :meth:`oiio_msspl.model.session.Session.run` reads them."""
    lrhs_alpha, hrls_alpha = (np.clip(render["alpha"], 0.0, 1.0) for render in (pair.lrhs, pair.hrls))
    grey = {name: values for name, values in pair.hrls.items() if name in (ALBEDO, NORMAL)}
    grey[RGB] = np.repeat(hrls_alpha, 3, axis=-1)
    lrhs, hrls = planes(lrhs_alpha, len(contract.lrhs)), planes(hrls_alpha, len(contract.hrls))
    encode_features({RGB: np.repeat(lrhs_alpha, 3, axis=-1)}, LRHS_FEATURES, 1.0, lrhs)
    encode_features(grey, contract.features, 1.0, hrls)
    return lrhs, hrls
