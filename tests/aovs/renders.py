# SPDX-License-Identifier: Apache-2.0
"""Small renders with constant layers, and their mapping."""

import numpy as np

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from tests.conftest import write_exr

H = W = 8


def plane(value):
    return np.full((H, W), value, np.float32)


def layer(name, value, names="RGB"):
    """Channels of one layer, constant."""
    return {f"{name}.{c}" if name else c: plane(value + i / 10) for i, c in enumerate(names)}


def mapped(tmp_path, channels, mapping=None, stem="hr", **options):
    """The file with these channels, mapped."""
    attributes = options.pop("attributes", {})
    return map_render(open_exr(write_exr(tmp_path / f"{stem}.exr", channels, **attributes)), mapping, **options)


def sources(render):
    """{feature: layers} of the features that were found."""
    return {row["feature"]: row["source"] for row in render.table() if row["status"] in ("found", "computed")}
