# SPDX-License-Identifier: Apache-2.0
"""Training views rendered with Mitsuba 3 from procedural scenes.

    python -m training.mitsuba_views --out DIR --seeds 0:400

Each view is one uncompressed file `mitsuba-<seed>-<view>.npz`, height and width 256:

    hr      float16 (8, H, W, 15)  independent 1-spp passes: colour, albedo, world normal, diffuse, specular
    lr      float16 (5, H, W, 3)   colour at full resolution, `lr_spp` samples a pixel each; box-averaged over
                                   s x s pixels it is what a render at 1/s of the resolution gives
    lr_x2, lr_x4, lr_x8            in place of `lr` with a filter wider than a pixel: float16 (5, H/s, W/s, 3), colour
                                   rendered at 1/s of the resolution, s² times `lr_spp` samples a pixel
    lr_spp  int32 (5,)
    ref     float16 (H, W, 3)      the reference
    meta    a JSON string: seed, view, split, generator version, kind, renderer, assets, exposure

`hr`, `lr` and `ref` are independent of one another. Colour = diffuse + specular + rest, by the first
scattering event; the rest is transmission, directly seen emission and the background.
"""
