# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of the add-on inside Blender::

    MSSPL_FUSE=... BLENDER_USER_RESOURCES=folder python in_blender FOLDER

Installs the extension, renders tiny scenes and leaves files in FOLDER, which test_in_blender.py compares. This folder
imports bpy, so it is GPL-3.0-or-later. The text of the licence is blender_addon/LICENSE.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import bpy
from check_button import (
    check_animation_button,
    check_button,
    check_cancel,
    check_colour_space,
    check_modes,
    check_panel,
)
from check_motion import render_motion
from check_passes import check_passes
from check_renders import check_choices, check_compositing, check_layers, check_loaded_once, check_renders, check_seed
from check_scene import check_animated, check_changes, check_samples, check_sentences, render_ramps
from support import MODULE, WORK, build_scene

ADDON = Path(__file__).resolve().parents[3] / "blender_addon"


def install():
    """Build the package with Blender's own tool and install it from disk, as a user does."""
    tool = Path(bpy.utils.system_resource("SCRIPTS"), "addons_core", "bl_pkg", "cli", "blender_ext.py")
    package = WORK / "msspl.zip"
    arguments = ["build", "--source-dir", str(ADDON), "--output-filepath", str(package)]
    subprocess.run([sys.executable, str(tool), *arguments], check=True)
    bpy.ops.extensions.package_install_files(filepath=str(package), repo="user_default", enable_on_install=True)
    assert MODULE in bpy.context.preferences.addons


if __name__ == "__main__":
    install()
    scene = build_scene()
    check_panel()
    check_button(scene)
    check_colour_space(build_scene())
    scene = build_scene()
    check_sentences(scene)
    check_samples()
    check_animated(scene)
    check_changes(scene)
    check_modes(scene)
    check_cancel(scene)
    check_renders(scene)
    check_choices(scene)
    check_seed(scene)
    check_compositing(scene)
    check_loaded_once(scene)
    check_layers(scene)
    check_animation_button(build_scene())
    render_ramps()
    check_passes()
    render_motion()
    bpy.ops.preferences.addon_disable(module=MODULE)
    assert not hasattr(bpy.types.Scene, "msspl")
    print("all is well", flush=True)
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    os._exit(0)  # A normal exit would run the destructors of bpy, which can hang in 4.5.
