# SPDX-License-Identifier: Apache-2.0
"""Views for training and tests: two generators of random scenes, and the file format that both write.

``views`` is the file format. ``quality`` rejects useless cameras and estimates the noise of a reference.
``command_line`` is the command line of a generator. ``meshes`` and ``textures`` are procedural content for both.
``mitsuba`` and ``cycles`` are the generators; ``cycles`` is GPL-3.0-or-later, because it imports Blender's ``bpy``.
``references`` denoises references.
"""
