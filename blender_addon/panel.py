# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the panel Render Properties > MSSPL Fuse, and holds its settings and the add-on's preferences."""

from types import SimpleNamespace

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty
from bpy.types import Context

from .options import Options, frame_size

#: The current step of the running job; without a text, no job runs. A Blender property would be saved in the .blend.
status = SimpleNamespace(text="", fraction=0.0)


class MSSPLSettings(bpy.types.PropertyGroup):
    renders: EnumProperty(
        name="Renders",
        description="What is rendered of each frame, and then fused",
        items=[
            ("ONE", "One", "One render of the frame"),
            ("TWO", "Two Seeds", "Two renders of the frame's size, each with its own noise. What both show is detail"),
            ("SIZES", "Two Sizes", "A small render with many samples, and one of the frame's size with few"),
        ],
    )
    scale: EnumProperty(
        name="Scale",
        description="The low-resolution render has 1/scale of the width and height of the frame",
        items=[("2", "2", ""), ("4", "4", ""), ("8", "8", "")],
        default="4",
    )
    hr_spp: IntProperty(
        name="Samples",
        description="Samples per pixel of each render of the frame's size. 0: 8 in all, or 1 beside a small render",
        default=0,
        min=0,
    )
    lr_spp: IntProperty(
        name="Small Samples",
        description="Samples per pixel of the low-resolution render. 0: a third of the total samples of the "
        "full-resolution render, but at least scale x scale samples per pixel",
        default=0,
        min=0,
    )
    filter: EnumProperty(
        name="Pixel Filter",
        items=[
            ("BOX", "Box", "A low-resolution pixel is the mean of its full-resolution pixels, as the network expects"),
            ("SCENE", "Scene", "The pixel filter of the scene"),
        ],
    )
    quality: EnumProperty(
        name="Quality",
        description="The model that fuses",
        items=[
            ("FAST", "Fast", "For previews"),
            ("BALANCED", "Balanced", "For most frames"),
            ("BEST", "Best", "For final frames that can wait"),
        ],
        default="BALANCED",
    )
    device: EnumProperty(
        name="Device",
        description="Where the model runs. Devices other than the CPU need a package of their own beside msspl-fuse",
        items=[(name.upper(), name, "") for name in ("CPU", "CUDA", "TensorRT", "OpenVINO", "CoreML", "DirectML")],
    )
    components: BoolProperty(
        name="All Component Passes",
        description="Render diffuse, glossy, transmission, emission, environment and volume passes, which sum to the "
        "beauty. Passes and light groups that the view layer has on are always rendered and fused",
    )
    average: BoolProperty(
        name="Average Neighbouring Frames",
        description="In an animation, average each frame with four frames before and four after it, along the motion "
        "of the surfaces. It removes noise and flicker, needs motion blur to be off, and renders the pass Vector",
        default=True,
    )
    output: StringProperty(
        name="Output",
        description="The EXR to write. # stands for the frame number, {view_layer}, {scene_name}, {camera_name} and "
        "{blend_name} for the names of these",
        default="//fused_####.exr",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    connect: BoolProperty(
        name="Connect to Output",
        description="Connect the fused frame to the compositor's output even if another node is connected there",
    )

    def options(self, view_layer: str) -> Options:
        """Return the options of a frame of a view layer."""
        renders, scale = 1 if self.renders == "ONE" else 2, int(self.scale) if self.renders == "SIZES" else 1
        return Options(renders, scale, self.hr_spp, self.lr_spp, self.filter, view_layer, self.components)


class MSSPLPreferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    program: StringProperty(
        name="msspl-fuse",
        description="Path of the program msspl-fuse. If empty, the environment variable MSSPL_FUSE names it, or else "
        "it is looked up on PATH",
        subtype="FILE_PATH",
    )

    def draw(self, context: Context) -> None:
        self.layout.prop(self, "program")


class MSSPL_PT_fuse(bpy.types.Panel):
    bl_label = "MSSPL Fuse"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}
    COMPAT_ENGINES = {"CYCLES"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        return context.engine in cls.COMPAT_ENGINES

    def draw(self, context: Context) -> None:
        layout, scene = self.layout, context.scene
        settings = scene.msspl
        layout.use_property_split = True
        options = settings.options("")
        small = ("scale", "lr_spp") if options.scale > 1 else ()
        choices = ("quality", "device", "filter", "components", "average", "output", "connect")
        for name in ("renders", *small, "hr_spp", *choices):
            layout.prop(settings, name)
        inputs = [(frame_size(scene), options.hrls_spp)]
        if options.renders > 1:
            inputs.insert(0, (frame_size(scene, options.scale), options.lrhs_spp))
        layout.label(text=", ".join(f"{width}x{height} at {spp} spp" for (width, height), spp in inputs))
        if status.text:
            layout.progress(text=status.text, factor=status.fraction)
        else:
            layout.operator("msspl.fuse", icon="RENDER_STILL")
            layout.operator("msspl.fuse_animation", icon="RENDER_ANIMATION")


_register, _unregister = bpy.utils.register_classes_factory((MSSPLSettings, MSSPLPreferences, MSSPL_PT_fuse))


def register() -> None:
    _register()
    bpy.types.Scene.msspl = PointerProperty(type=MSSPLSettings)


def unregister() -> None:
    del bpy.types.Scene.msspl
    _unregister()
