# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender add-on: render a Cycles scene at low and at full resolution, fuse the two, and composite the result."""

from . import operators, panel


def register() -> None:
    panel.register()
    operators.register()


def unregister() -> None:
    operators.unregister()
    panel.unregister()
