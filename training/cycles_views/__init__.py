# SPDX-License-Identifier: GPL-3.0-or-later
"""Training views rendered with Blender's Cycles from procedural scenes.

    python -m training.cycles_views --out DIR --seeds 0:400

The files are those of :mod:`training.mitsuba_views`, named `cycles-<seed>-<view>.npz`. Their layers are what
`oiio_msspl.aovs` finds in a Cycles file: Combined, Denoising Albedo, Denoising Normal (camera space), and the paper's
composites (direct + indirect) * colour of the diffuse and of the glossy passes. The rest of Combined is transmission,
emission, the background and volumes.

Pixel filter: `lr` always has a box of one pixel, so that its box average over s x s pixels is exactly a render at 1/s
of the resolution with a box filter. In three scenes of four `hr` and `ref` have it too. In the fourth they have
Cycles' default, Blackman-Harris of 1.5 pixels, which is narrower than the box (standard deviation some 0.2 of a pixel,
the box's is 0.29), so edges alias more. What is only approximated there is the LRHS: a user's has the default filter
at its own pixel size, sharper than the box average that stands for it. The network learns from both that LRHS pixels
need not be the means of their footprints.

A seed always gives the same scene. Its pixels repeat exactly within a process; a later run may differ in about one of
a hundred, as Cycles does when a scene is built anew.

Licence: this folder alone is GPL-3.0-or-later, because it imports `bpy`. Nothing outside it imports it.
"""
