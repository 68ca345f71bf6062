# SPDX-License-Identifier: GPL-3.0-or-later
"""Training views rendered with Blender's Cycles from procedural scenes, see :mod:`research.datagen.views` for the
files.

    python -m research.datagen.cycles --out VIEWS --seeds 0:400

AOVs are composed as the package composes those of a Cycles file: Combined, Denoising Albedo, Denoising Normal (camera
space), and (direct + indirect) * colour of the diffuse and of the glossy passes, as in the paper. The rest of Combined
is transmission, emission, the background and volumes.

Pixel filter: ``lr`` always has a box filter of one pixel, so that its average over s x s pixels equals a box-filtered
render at 1/s of the resolution. In three scenes of four, ``hr`` and ``ref`` have the same filter. In the fourth they
have Cycles' default, Blackman-Harris of 1.5 pixels, which is narrower (a standard deviation of 0.2 instead of 0.29
pixels), so that edges alias more. There the LRHS is an approximation: a user's LRHS has the default filter at its own
pixel size, which is sharper than the box average. From both the network learns that an LRHS pixel is not always the
mean of its s x s pixels.

A seed always gives the same scene. Its pixels repeat exactly within a process. In a later run about one pixel of a
hundred may differ, because Cycles builds the scene anew.

Licence: this folder alone is GPL-3.0-or-later, because it imports ``bpy``. Nothing outside it imports it.
"""
