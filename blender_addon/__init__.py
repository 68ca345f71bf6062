# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender add-on: render the LRHS and the HRLS of a Cycles scene, fuse them with msspl-fuse, composite the result."""

from . import operators, panel


def register():
    panel.register()
    operators.register()


def unregister():
    operators.unregister()
    panel.unregister()
