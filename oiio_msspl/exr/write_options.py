# SPDX-License-Identifier: Apache-2.0
"""How the result is stored."""

from __future__ import annotations

from dataclasses import dataclass

from oiio_msspl.errors import InputError

LAYOUTS = {
    "spec": "channels named layer.component in parts as the HRLS has them (OpenEXR's rule; most tools)",
    "nuke": "a part a layer, the layer in the part's name alone, as Nuke writes",
    "multilayer": "a single part with all channels",
}
LOSSLESS = ("none", "rle", "zip", "zips", "piz")
COMPRESSIONS = (*LOSSLESS, "pxr24", "b44", "b44a", "dwaa", "dwab")
DEFAULT_COMPRESSION = "zip"

#: Name of the layer that holds the predicted error.
ERROR_LAYER = "error"


@dataclass(frozen=True)
class WriteOptions:
    """How the result is stored."""

    layout: str = "spec"
    compression: str | None = None
    """Of the fused beauty; None: as the HRLS's beauty, or ``zip`` where that is lossy. Passed-on layers keep theirs, or
    ``zip`` where it is lossy: they must not lose bits a second time."""
    pixel_type: str | None = None
    """``half`` or ``float`` for the fused beauty; None: as the HRLS's."""
    layers: tuple[str, ...] = ()
    """Patterns of the layers that are passed on beside the fused beauty, ``none`` for none; empty: all."""
    error_layer: bool = False
    """Add a layer ``error``: what the model expects the beauty to be off by."""

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise InputError(f"--layout {self.layout!r}: use one of {', '.join(LAYOUTS)}")
        if self.compression is not None and self.compression not in COMPRESSIONS:
            raise InputError(f"--compression {self.compression!r}: use one of {', '.join(COMPRESSIONS)}")
