# SPDX-License-Identifier: GPL-3.0-or-later
"""Views of test scenes, rendered with Blender's Cycles from procedural scenes, see :mod:`research.datagen.views`.

    python -m research.datagen.cycles --out VIEWS --seeds 1:262:20 --views 1

AOVs are composed as the package composes those of a Cycles file: Combined, Denoising Albedo, Denoising Normal (camera
space), and (direct + indirect) * colour of the diffuse and of the glossy passes, as in the paper. The rest of Combined
is transmission, emission, the background and volumes. The pixel filter of both renders is Cycles' default,
Blackman-Harris of 1.5 pixels, so the LRHS is rendered at each scale.

A seed always gives the same scene. Its pixels repeat exactly within a process. In a later run about one pixel of a
hundred may differ, because Cycles builds the scene anew.

Licence: this folder alone is GPL-3.0-or-later, because it imports ``bpy``. Nothing outside it imports it.
"""
