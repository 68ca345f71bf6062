# SPDX-License-Identifier: Apache-2.0
"""Luminance, the sRGB display transform, and linear RGB spaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from oiio_msspl.image.arrays import Array

#: Rec. 709 luminance weights of linear RGB.
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)

#: The cone responses of the Bradford chromatic adaptation (Lam 1985), which ACES and ICC use.
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


@dataclass(frozen=True)
class ColourSpace:
    """A linear RGB space."""

    name: str
    chromaticities: tuple[float, ...]
    """CIE xy of red, green, blue and white, as in an EXR's header: 8 values."""
    aliases: tuple[str, ...] = ()
    """Other names in headers and OpenColorIO configurations, in lower case."""


_D65, _ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)

REC709 = ColourSpace(
    "lin_rec709",
    (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65),
    (
        *("linear", "scene_linear", "lin_rec709_scene", "lin_srgb", "linear rec.709 (srgb)", "linear rec.709"),
        *("linear srgb", "scene-linear rec.709-srgb", "utility - linear - srgb", "utility - linear - rec.709"),
    ),
)
ACESCG = ColourSpace(
    "acescg",
    (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE),
    ("lin_ap1", "lin_ap1_scene", "ap1", "aces - acescg"),
)
ACES2065 = ColourSpace(
    "aces2065-1",
    (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *_ACES_WHITE),
    ("lin_ap0", "lin_ap0_scene", "ap0", "aces", "aces - aces2065-1"),
)
REC2020 = ColourSpace(
    "lin_rec2020",
    (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    ("lin_rec2020_scene", "linear rec.2020", "utility - linear - rec.2020"),
)
P3 = ColourSpace(
    "lin_p3d65",
    (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    ("lin_p3d65_scene", "linear p3-d65", "utility - linear - p3-d65"),
)
ADOBE = ColourSpace(
    "lin_adobergb", (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65), ("lin_adobergb_scene", "linear adobergb")
)
SPACES = (REC709, ACESCG, ACES2065, REC2020, P3, ADOBE)

#: Names in lower case that OpenImageIO writes by default, so they say nothing of the space.
_INDEFINITE = ("", "linear", "scene_linear", "lin_rec709")
#: Chromaticities are equal if none differs by more than this.
_SAME = 0.003


def luminance(rgb: Array) -> Array:
    """Compute the Rec. 709 luminance of linear RGB: (..., 3) to (...).

    The sum is written out, because a matrix product rounds differently for other layouts in memory.
    """
    red, green, blue = map(np.float32, LUMINANCE_WEIGHTS)
    total = np.asarray(red * rgb[..., 0])
    total += green * rgb[..., 1]
    total += blue * rgb[..., 2]
    return total


def srgb(linear: Array) -> Array:
    """Convert scene-linear values to sRGB, clipped to [0, 1]: the display transform s(x) of the paper, section 5.1."""
    x = np.clip(linear, 0.0, 1.0)
    curve = 1.055 * np.power(np.maximum(x, 1e-12), 1 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)


def converted(rgb: Array, source: ColourSpace, target: ColourSpace) -> Array:
    """Convert linear colours (..., 3) from one space to another one; the array itself if the two are equal."""
    return rgb if same_space(source, target) else rgb @ conversion(source, target).T.astype(np.float32)


def conversion(source: ColourSpace, target: ColourSpace) -> NDArray[np.float64]:
    """Return the matrix (3, 3) for ``rgb @ matrix.T``, linear RGB. White stays white (Bradford adaptation)."""
    to_cones = []
    for space in (source, target):
        xy = np.reshape(space.chromaticities, (4, 2))
        xyz = np.column_stack([xy, 1 - xy.sum(axis=1)]) / xy[:, 1:]
        primaries = xyz[:3].T
        # Linear RGB to CIE XYZ, for a white of Y = 1 (SMPTE RP 177).
        matrix = primaries * np.linalg.solve(primaries, xyz[3])
        to_cones.append(_BRADFORD @ matrix / (_BRADFORD @ matrix.sum(axis=1))[:, None])
    return np.linalg.solve(to_cones[1], to_cones[0])


def named_space(name: str) -> ColourSpace | None:
    """Return the linear space of a name in a header, an option or OpenColorIO; None for other names.

    Names that are not in the table are looked up in the configuration of ``$OCIO``, or in that of OpenImageIO.
    """
    wanted = name.strip().lower()
    for space in SPACES:
        if wanted in (space.name, *space.aliases):
            return space
    config = oiio.ColorConfig() if wanted else None
    return next((space for space in SPACES if config and config.equivalent(name, space.name)), None)


def space_of(metadata: Mapping[str, Any]) -> ColourSpace | None:
    """Return the linear space that an EXR's header declares; None if it declares none.

    ``colorInteropID`` comes first: programs that convert colours set it, and often keep old ``chromaticities``.
    ``oiio:ColorSpace`` counts only with a definite name.
    """
    if (space := named_space(str(metadata.get("colorInteropID") or ""))) is not None:
        return space
    values = metadata.get("chromaticities")
    if isinstance(values, tuple) and len(values) == 8 and all(isinstance(v, float) and np.isfinite(v) for v in values):
        stored = ColourSpace(f"the space with the chromaticities {', '.join(f'{v:.4g}' for v in values)}", values)
        red, green, blue, _ = np.reshape(values, (4, 2))
        degenerate = min(abs(v) for v in values[1::2]) < 1e-6 or abs(np.linalg.det([green - red, blue - red])) < 1e-4
        return next((space for space in SPACES if same_space(stored, space)), None if degenerate else stored)
    name = str(metadata.get("oiio:ColorSpace") or "")
    return None if name.lower() in _INDEFINITE else named_space(name)


def encoding_of(metadata: Mapping[str, Any]) -> str:
    """Return the name of an encoding that is not linear, such as ``srgb_rec709_scene``, from an EXR's header.

    It is empty for linear files, and for names that neither ``$OCIO`` nor OpenImageIO knows.
    """
    name = str(metadata.get("oiio:ColorSpace") or "")
    if not name or named_space(name) is not None:
        return ""
    greys = oiio.ImageBuf(np.array([[[0.1] * 3, [0.2] * 3]], np.float32))
    linear = oiio.ImageBufAlgo.colorconvert(greys, name, "scene_linear")
    if linear.geterror():
        return ""
    dark, bright = np.asarray(linear.get_pixels(oiio.FLOAT))[0]
    return "" if np.allclose(bright, 2 * dark, rtol=1e-3) else name


def same_space(first: ColourSpace, second: ColourSpace) -> bool:
    """Return whether two spaces are equal, except for the rounding of headers."""
    return bool(np.allclose(first.chromaticities, second.chromaticities, rtol=0, atol=_SAME))
