# SPDX-License-Identifier: GPL-3.0-or-later
"""What the user sets and sees: Render Properties > MSSPL Fuse, and the add-on's preferences."""

from dataclasses import dataclass

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty

from .render import Options, high_size, low_size


@dataclass
class Status:
    """What a running job does now; the text is empty when none runs. No property: that would be saved in files."""

    text: str = ""
    fraction: float = 0.0


status = Status()


class MSSPLSettings(bpy.types.PropertyGroup):
    scale: EnumProperty(
        name="Scale",
        description="The LRHS has 1/scale of the frame's width and height",
        items=[("2", "2", ""), ("4", "4", ""), ("8", "8", "")],
        default="4",
    )
    hr_spp: IntProperty(name="HRLS Samples", description="Samples a pixel at full resolution", default=1, min=1)
    lr_spp: IntProperty(
        name="LRHS Samples",
        description="Samples a pixel at low resolution; 0: in all, a third of those of the HRLS",
        default=0,
        min=0,
    )
    filter: EnumProperty(
        name="Pixel Filter",
        items=[
            ("BOX", "Box", "An LRHS pixel is exactly the mean of its HRLS pixels: what the network expects"),
            ("SCENE", "Scene", "The scene's own pixel filter"),
        ],
    )
    output: StringProperty(
        name="Output",
        description="EXR to write; # is the frame number",
        default="//fused_####.exr",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    connect: BoolProperty(
        name="Connect to Output", description="Make the fused frame the compositor's output, whatever that comes from"
    )

    def options(self, view_layer):
        return Options(int(self.scale), self.hr_spp, self.lr_spp, self.filter, view_layer)


class MSSPLPreferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    program: StringProperty(
        name="msspl-fuse",
        description="The program; empty: as the variable MSSPL_FUSE or the path says",
        subtype="FILE_PATH",
    )

    def draw(self, context):
        self.layout.prop(self, "program")


class MSSPL_PT_fuse(bpy.types.Panel):
    bl_label = "MSSPL Fuse"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}
    COMPAT_ENGINES = {"CYCLES"}

    @classmethod
    def poll(cls, context):
        return context.engine in cls.COMPAT_ENGINES

    def draw(self, context):
        layout, scene = self.layout, context.scene
        settings = scene.msspl
        layout.use_property_split = True
        for name in ("scale", "hr_spp", "lr_spp", "filter", "output", "connect"):
            layout.prop(settings, name)
        options = settings.options("")
        sizes = low_size(scene, options.scale), high_size(scene)
        layout.label(
            text="{}x{} at {} spp, {}x{} at {} spp".format(*sizes[0], options.low_spp, *sizes[1], options.hr_spp)
        )
        if status.text:
            layout.progress(text=status.text, factor=status.fraction)
        else:
            layout.operator("msspl.fuse", icon="RENDER_STILL")


CLASSES = (MSSPLSettings, MSSPLPreferences, MSSPL_PT_fuse)


def register():
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.msspl = PointerProperty(type=MSSPLSettings)


def unregister():
    del bpy.types.Scene.msspl
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
