# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender add-on: render a Cycles scene once, twice or at two sizes, fuse the renders, and composite the result."""

from . import operators, panel


def register() -> None:
    panel.register()
    operators.register()


def unregister() -> None:
    operators.unregister()
    panel.unregister()
