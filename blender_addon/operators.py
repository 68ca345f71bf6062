# SPDX-License-Identifier: GPL-3.0-or-later
"""The button "Render and Fuse". It runs step by step in a window and blocks in a script."""

import functools
import re
import tempfile
import time

import bpy

from . import compositor, frame, fuse, overrides
from .errors import Cancelled, Failure
from .panel import status

#: Results of a modal operator: continue, and either let others see the event or keep it from them.
_CONTINUE = {"PASS_THROUGH"}
_CONSUME_EVENT = {"RUNNING_MODAL"}


class MSSPL_OT_fuse(bpy.types.Operator):
    """Render the frame at low and at full resolution, fuse the two renders, and show the result in the compositor"""

    bl_idname = "msspl.fuse"
    bl_label = "Render and Fuse"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context):
        return not status.text

    def execute(self, context):
        status.text = "starting"  # From now on, poll() refuses a second job.
        self._steps = self._job(context)
        try:
            while (result := self._step()) == _CONTINUE:
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
            if bpy.app.is_job_running("RENDER"):  # Blender cancels its render itself.
                return _CONTINUE
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            # Settings of the scene are overridden: the user must not change, undo or save anything now.
            return _CONTINUE if event.type.startswith("TIMER") else _CONSUME_EVENT
        result = {"CANCELLED"}
        try:
            result = self._step()
        finally:
            if result != _CONTINUE:
                self.cancel(context)
        if result == _CONTINUE:
            status.text, status.fraction = self._doing
            context.workspace.status_text_set(f"MSSPL Fuse: {status.text} (Esc cancels)")
            for area in context.screen.areas:
                area.tag_redraw()
        return result

    def cancel(self, context):
        """Cancel the job and clean up. Blender also calls this when another file is opened."""
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
        """Run the job up to its next step and return the operator's result."""
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
        return _CONTINUE

    def _job(self, context, window=False):
        scene, settings = context.scene, context.scene.msspl
        identity, overwrite = (scene.name, scene.session_uid), scene.render.use_overwrite
        addon = context.preferences.addons.get(__package__)
        program = fuse.find_program(bpy.path.abspath(addon.preferences.program) if addon else "")
        options = settings.options(context.view_layer.name)
        # The frame number replaces # in the file name only, because a folder's name may contain #.
        path = re.sub(r"#+(?=[^/\\]*$)", lambda signs: f"{scene.frame_current:0{len(signs[0])}d}", settings.output)
        if path.startswith("//") and not bpy.data.filepath:
            raise Failure(f"{path}: save the .blend first, or give a full path")
        with tempfile.TemporaryDirectory(prefix="msspl-") as work:
            output = bpy.path.abspath(path)
            run = functools.partial(fuse.run, program, work=work, overwrite=overwrite, threads=options.threads)
            report = yield from frame.render_and_fuse(
                scene, options, output, work, run, overwrite=overwrite, window=window
            )
        scene = overrides.find_scene(*identity)
        compositor.show(scene, path, scene.msspl.connect)
        for warning in report.warnings:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, f"{path}: {report}")


def register():
    bpy.utils.register_class(MSSPL_OT_fuse)
    bpy.app.handlers.save_pre.append(overrides.restore_for_save)
    for after in (bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail):
        after.append(overrides.override_after_save)


def unregister():
    bpy.app.handlers.save_pre.remove(overrides.restore_for_save)
    for after in (bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail):
        after.remove(overrides.override_after_save)
    bpy.utils.unregister_class(MSSPL_OT_fuse)
