# SPDX-License-Identifier: Apache-2.0
"""Name the features that networks read, with their channels, order and units.

The HRLS branch of the paper's network reads all of them (section 4), the LRHS branch RGB only (section 5.3). The other
models read RGB, albedo and normal.

Units:

- ``rgb``, ``diffuse``, ``specular``: scene-linear radiance, >= 0.
- ``albedo``: reflectance, mostly in [0, 1].
- ``normal``: signed vector in [-1, 1], in world or camera space; 0 where the camera ray hits nothing.
- ``variance``: variance of the pixel's *mean* (radiance squared), >= 0: one channel of luminance, or R, G and B.
"""

from __future__ import annotations

RGB = "rgb"
ALBEDO = "albedo"
NORMAL = "normal"
DIFFUSE = "diffuse"
SPECULAR = "specular"
VARIANCE = "variance"

#: Feature -> number of channels, in the order in which the paper's HRLS branch stacks them.
HRLS_FEATURES: dict[str, int] = {RGB: 3, ALBEDO: 3, NORMAL: 3, DIFFUSE: 3, SPECULAR: 3, VARIANCE: 1}
#: All features, in order.
FEATURES = tuple(HRLS_FEATURES)
#: Features that only the paper's network reads.
PAPER_FEATURES = frozenset({DIFFUSE, SPECULAR, VARIANCE})
#: Features that are radiance: they scale with the brightness of the scene.
RADIANCE_FEATURES = (RGB, DIFFUSE, SPECULAR)
#: Features that a render may lack. The network then reads the value in ``DEFAULTS``.
OPTIONAL_FEATURES = (ALBEDO, NORMAL, DIFFUSE, SPECULAR, VARIANCE)
#: Value of a missing feature, encoded as the network reads it. The paper sets a missing variance to a constant (its
#: Gharbi experiment) without giving the value. Ours is the standard deviation of a pixel whose noise is as large as mid
#: grey, about 0.5 when encoded: the network should expect noise.
DEFAULTS: dict[str, float] = {ALBEDO: 0.5, NORMAL: 0.0, DIFFUSE: 0.0, SPECULAR: 0.0, VARIANCE: 0.5}
#: Prefix of the names of features that hold the light of a single pass. Networks do not read them.
LIGHT_OF = "light of "


def is_light_of_pass(feature: str) -> bool:
    """Return whether a feature is the light of a pass."""
    return feature.startswith(LIGHT_OF)
