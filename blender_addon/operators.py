# SPDX-License-Identifier: GPL-3.0-or-later
"""The button: all of :func:`.frame.make`, step by step in a window, at once in a script."""

import re
import tempfile
import time

import bpy

from . import compositor, frame, fuse, render
from .errors import Cancelled, Failure
from .panel import status

_MORE = {"PASS_THROUGH"}
_SWALLOWED = {"RUNNING_MODAL"}


class MSSPL_OT_fuse(bpy.types.Operator):
    """Render at low and at full resolution, fuse both with msspl-fuse, and load the frame into the compositor"""

    bl_idname = "msspl.fuse"
    bl_label = "Render and Fuse"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context):
        return not status.text

    def execute(self, context):
        status.text = "starting"  # at once: there is one job at a time
        self._steps = self._job(context)
        try:
            while (result := self._step()) == _MORE:
                time.sleep(0.02)
        finally:
            self._end()
        return result

    def invoke(self, context, event):
        status.text = "starting"
        self._steps, self._timer = self._job(context, window=True), None
        try:
            self._timer = context.window_manager.event_timer_add(0.1, window=context.window)
            context.window_manager.modal_handler_add(self)
        except BaseException:
            self.cancel(context)
            raise
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC":
            if bpy.app.is_job_running("RENDER"):  # Blender itself cancels a render
                return _MORE
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            # The scene has settings of ours: nothing is to be changed, undone or saved now.
            return _MORE if event.type.startswith("TIMER") else _SWALLOWED
        result = {"CANCELLED"}
        try:
            result = self._step()
        finally:
            if result != _MORE:
                self.cancel(context)
        if result == _MORE:
            status.text, status.fraction = self._doing
            context.workspace.status_text_set(f"MSSPL Fuse: {status.text} (Esc cancels)")
            for area in context.screen.areas:
                area.tag_redraw()
        return result

    def cancel(self, context):
        """End the job where it stands; Blender calls this too, when another file is opened."""
        try:
            if self._timer is not None:
                context.window_manager.event_timer_remove(self._timer)
            context.workspace.status_text_set(None)
        finally:
            self._end()

    def _end(self):
        try:
            self._steps.close()
        finally:
            status.text = ""

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

    def _job(self, context, window=False):
        scene, settings = context.scene, context.scene.msspl
        identity, overwrite = (scene.name, scene.session_uid), scene.render.use_overwrite
        addon = context.preferences.addons.get(__package__)
        program = fuse.find_program(bpy.path.abspath(addon.preferences.program) if addon else "")
        options = settings.options(context.view_layer.name)
        # In the name alone: a folder may be called so.
        path = re.sub(r"#+(?=[^/\\]*$)", lambda signs: f"{scene.frame_current:0{len(signs[0])}d}", settings.output)
        if path.startswith("//") and not bpy.data.filepath:
            raise Failure(f"{path}: save the .blend first, or give a full path")
        with tempfile.TemporaryDirectory(prefix="msspl-") as work:
            output = bpy.path.abspath(path)
            report = yield from frame.make(scene, options, output, work, program, overwrite=overwrite, window=window)
        scene = render.find_scene(*identity)
        compositor.show(scene, path, scene.msspl.connect)
        for warning in report.warnings:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, f"{path}: {report}")


def register():
    bpy.utils.register_class(MSSPL_OT_fuse)
    bpy.app.handlers.save_pre.append(render.put_back)
    for after in (bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail):
        after.append(render.set_again)


def unregister():
    bpy.app.handlers.save_pre.remove(render.put_back)
    for after in (bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail):
        after.remove(render.set_again)
    bpy.utils.unregister_class(MSSPL_OT_fuse)
