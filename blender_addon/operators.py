# SPDX-License-Identifier: GPL-3.0-or-later
"""The button: all of :func:`.frame.make`, step by step in a window, at once in a script."""

import re
import tempfile
import time

import bpy

from . import compositor, frame, fuse
from .errors import Cancelled, Failure

_MORE = {"PASS_THROUGH"}


class MSSPL_OT_fuse(bpy.types.Operator):
    """Render at low and at full resolution, fuse both with msspl-fuse, and load the frame into the compositor"""

    bl_idname = "msspl.fuse"
    bl_label = "Render and Fuse"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context):
        return not context.window_manager.msspl.text

    def execute(self, context):
        self._steps = self._job(context)
        while (result := self._step()) == _MORE:
            time.sleep(0.02)
        return result

    def invoke(self, context, event):
        self._steps = self._job(context)
        self._timer = context.window_manager.event_timer_add(0.1, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC" and not bpy.app.is_job_running("RENDER"):  # a render is cancelled by Blender itself
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return _MORE
        result = {"CANCELLED"}
        try:
            result = self._step()
        finally:
            if result != _MORE:
                self.cancel(context)
        if result == _MORE:
            status = context.window_manager.msspl
            status.text, status.fraction = self._doing
            context.workspace.status_text_set(f"MSSPL Fuse: {status.text} (Esc cancels)")
            for area in context.screen.areas:
                area.tag_redraw()
        return result

    def cancel(self, context):
        """End the job where it stands; Blender calls this too, when another file is opened."""
        self._steps.close()
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.msspl.text = ""
        context.workspace.status_text_set(None)

    def _step(self):
        """Go on to the next step; the operator's result if there is none."""
        try:
            self._doing = next(self._steps)
        except StopIteration:
            return {"FINISHED"}
        except Cancelled:
            self.report({"WARNING"}, "Cancelled; nothing was written")
            return {"CANCELLED"}
        except Failure as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return _MORE

    def _job(self, context):
        scene, settings = context.scene, context.scene.msspl
        addon = context.preferences.addons.get(__package__)
        program = fuse.find_program(bpy.path.abspath(addon.preferences.program) if addon else "")
        options = settings.options(context.view_layer.name)
        path = re.sub("#+", lambda signs: f"{scene.frame_current:0{len(signs[0])}d}", settings.output)
        if path.startswith("//") and not bpy.data.filepath:
            raise Failure(f"{path}: save the .blend first, or give a full path")
        with tempfile.TemporaryDirectory(prefix="msspl-") as work:
            output = bpy.path.abspath(path)
            report = yield from frame.make(scene, options, output, work, program, overwrite=scene.render.use_overwrite)
        compositor.show(scene, path, settings.connect)
        for warning in report.warnings:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, f"{path}: {report}")


def register():
    bpy.utils.register_class(MSSPL_OT_fuse)


def unregister():
    bpy.utils.unregister_class(MSSPL_OT_fuse)
