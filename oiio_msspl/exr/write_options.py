# SPDX-License-Identifier: Apache-2.0
"""Declare and check the user's choices about the output file: layout, compression, pixel type and layers."""

from __future__ import annotations

from dataclasses import dataclass

from oiio_msspl.errors import InputError

#: Layouts by name, with their description.
LAYOUTS = {
    "spec": "channels named layer.component in parts as the HRLS has them (OpenEXR's rule; most tools)",
    "nuke": "one part for each layer, named after the layer, as Nuke writes",
    "multilayer": "a single part with all channels",
}
#: Compressions that keep every bit.
LOSSLESS = ("none", "rle", "zip", "zips", "piz", "htj2k256", "htj2k32", "zstd")
#: All compressions of OpenEXR 3.5. Older versions lack zstd, lj2k and perhaps htj2k.
COMPRESSIONS = (*LOSSLESS, "pxr24", "b44", "b44a", "dwaa", "dwab", "lj2k")
#: Replaces a lossy compression of the source.
DEFAULT_COMPRESSION = "zip"

#: The names of layers that are added, each with the field of :class:`WriteOptions` that asks for it.
ADDED = {"error": "error_layer", "frames": "frames_layer", "trust": "trust_layer"}
ADDED |= {"denoised_albedo": "data_passes", "denoised_normal": "data_passes"}
#: The channels of these layers.
COMPONENTS = {"error": "Y", "frames": "Y", "trust": "Y", "denoised_albedo": "RGB", "denoised_normal": "XYZ"}


@dataclass(frozen=True)
class WriteOptions:
    """The user's choices about the output file.

    Raises:
        InputError: layout, compression or pixel type is unknown, or ``none`` is combined with other patterns.
    """

    layout: str = "spec"
    """One of ``LAYOUTS``."""
    compression: str | None = None
    """One of ``COMPRESSIONS``, for the fused beauty. None keeps the compression of the HRLS's beauty, or takes ``zip``
    if that is lossy. Other layers keep theirs, or become ``zip`` if it is lossy: they must not lose bits again."""
    pixel_type: str | None = None
    """``half`` or ``float``, for the fused beauty; None keeps the type of the HRLS's beauty."""
    layers: tuple[str, ...] = ()
    """Patterns such as ``crypto*`` of the HRLS's layers to pass on; ``("none",)`` passes on none, ``()`` all."""
    passes: tuple[str, ...] = ()
    """Patterns such as ``light*`` of the additive sets, or of layers in them, to fuse; ``("none",)`` fuses none, ``()``
    all. Other layers are passed on."""
    error_layer: bool = False
    """Add a layer ``error``: the error that the model predicts for the fused beauty."""
    frames_layer: bool = False
    """Add a layer ``frames``: the number of frames that were averaged in a pixel of a shot."""
    trust: bool = True
    """Put back what both renders show and the network has removed. False keeps the network's picture."""
    trust_layer: bool = False
    """Add a layer ``trust``: how much of the HRLS's difference to the network's picture was put back, from 0 to 1."""
    data_passes: bool = False
    """Add the layers ``denoised_albedo`` and ``denoised_normal``."""

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise InputError(f"--layout {self.layout!r}: use one of {', '.join(LAYOUTS)}")
        if self.compression is not None and self.compression not in COMPRESSIONS:
            raise InputError(f"--compression {self.compression!r}: use one of {', '.join(COMPRESSIONS)}")
        if self.pixel_type not in (None, "half", "float"):
            raise InputError(f"pixel type {self.pixel_type!r}: use half or float")
        for option, patterns in (("--layers", self.layers), ("--passes", self.passes)):
            if isinstance(patterns, str):
                raise InputError(f"{option} {patterns!r}: give a tuple of patterns, such as ({patterns!r},)")
            if "none" in patterns and len(patterns) > 1:
                others = ", ".join(pattern for pattern in patterns if pattern != "none")
                raise InputError(f"{option} none excludes {others or 'a second none'}; give one of them")
        if self.layout == "multilayer" and self.compression not in (None, *LOSSLESS) and self.layers != ("none",):
            raise InputError(
                f"--compression {self.compression}: with --layout multilayer all layers would lose bits, such as depth "
                f"and Cryptomatte; use --layout spec, or one of {', '.join(LOSSLESS)}"
            )
