# SPDX-License-Identifier: Apache-2.0
"""What the network reads, and in which order: the one place that fixes names and channels.

The paper's HRLS branch takes RGB, albedo, normal, diffuse, specular and variance (section 4);
its LRHS branch takes RGB alone (section 5.3 finds that more does not help).

Units: ``rgb``, ``diffuse`` and ``specular`` are scene-linear radiance, >= 0. ``albedo`` is a reflectance, mostly in
[0, 1]. ``normal`` is a signed vector in [-1, 1], world or camera space, 0 where nothing was hit. ``variance`` is the
variance of the pixel's *mean* luminance (radiance squared), >= 0.
"""

from __future__ import annotations

RGB = "rgb"
ALBEDO = "albedo"
NORMAL = "normal"
DIFFUSE = "diffuse"
SPECULAR = "specular"
VARIANCE = "variance"

#: Feature -> number of channels, in the order in which the network's HRLS branch stacks them.
HRLS_FEATURES: dict[str, int] = {RGB: 3, ALBEDO: 3, NORMAL: 3, DIFFUSE: 3, SPECULAR: 3, VARIANCE: 1}
LRHS_FEATURES: dict[str, int] = {RGB: 3}
FEATURES = tuple(HRLS_FEATURES)
#: Those that are light, and scale with the scene.
RADIANCE_FEATURES = (RGB, DIFFUSE, SPECULAR)

#: Features that a render may lack; each then has the default below, in the network's own (transformed) values.
OPTIONAL_FEATURES = (ALBEDO, NORMAL, DIFFUSE, SPECULAR, VARIANCE)

#: The paper sets the variance layer to a constant for renders that have none (its Gharbi experiment) without giving
#: the value. We take a standard deviation as large as a mid-grey pixel, about 0.5 after the transform: "assume noise".
DEFAULTS: dict[str, float] = {ALBEDO: 0.5, NORMAL: 0.0, DIFFUSE: 0.0, SPECULAR: 0.0, VARIANCE: 0.5}


def channel_names(features: dict[str, int]) -> list[str]:
    """Flat channel names (``rgb.R``, ``normal.X``, ``variance.Y``) of a stack of features, in order."""
    suffixes = {1: "Y", 3: "RGB"}
    return [f"{name}.{c}" for name, count in features.items() for c in ("XYZ" if name == NORMAL else suffixes[count])]
