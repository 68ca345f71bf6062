# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs the two buttons, for a frame and for an animation: step by step in a window, blocking in a script."""

import re
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

import bpy
from bpy.types import Context, Event, Scene

from . import compositor, frame, overrides, programs
from .checks import check_output, check_scene
from .errors import Cancelled, Failure
from .panel import status

#: Results of a modal operator: continue, and either let others see the event or keep it from them.
_CONTINUE = {"PASS_THROUGH"}
_CONSUME_EVENT = {"RUNNING_MODAL"}


class _Job:
    """An operator whose ``_job`` yields its progress."""

    bl_options = {"UNDO"}
    _cancelled: str
    _job: Callable[..., Generator[frame.Progress, None, None]]
    report: Callable[[set[str], str], None]

    @classmethod
    def poll(cls, context: Context) -> bool:
        return not status.text

    def execute(self, context: Context) -> set[str]:
        status.text = "starting"  # From now on, poll() refuses a second job.
        self._steps = self._job(context)
        try:
            while (result := self._step()) == _CONTINUE:
                time.sleep(0.02)
        finally:
            self._end()
        return result

    def invoke(self, context: Context, event: Event) -> set[str]:
        self._steps = self._job(context, window=True)
        self._timer = context.window_manager.event_timer_add(0.1, window=context.window)
        context.window_manager.modal_handler_add(self)
        status.text = "starting"
        return {"RUNNING_MODAL"}

    def modal(self, context: Context, event: Event) -> set[str]:
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

    def cancel(self, context: Context) -> None:
        """Cancel the job and clean up. Blender also calls this when another file is opened."""
        try:
            context.window_manager.event_timer_remove(self._timer)
            context.workspace.status_text_set(None)
        finally:
            self._end()

    def _end(self) -> None:
        try:
            self._steps.close()
        finally:
            status.text = ""

    def _step(self) -> set[str]:
        """Run the job up to its next step and return the operator's result."""
        try:
            self._doing = next(self._steps)
        except StopIteration:
            return {"FINISHED"}
        except Cancelled:
            self.report({"WARNING"}, self._cancelled)
            return {"CANCELLED"}
        except Failure as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return _CONTINUE

    def _finish(
        self, scene: Scene, layer: str, path: str, warnings: list[str], text: str, frames: Sequence[int] | None = None
    ) -> None:
        """Show the result of a view layer in the compositor, and report it."""
        compositor.show(scene, layer, path, scene.msspl.connect, frames)
        for warning in dict.fromkeys(warnings):
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, text)


class MSSPL_OT_fuse(_Job, bpy.types.Operator):
    """Render the frame as Renders says, fuse the renders, and show the result in the compositor"""

    bl_idname = "msspl.fuse"
    bl_label = "Render and Fuse"
    _cancelled = "Cancelled; nothing was written"

    def _job(self, context: Context, window: bool = False) -> Generator[frame.Progress, None, None]:
        scene, settings = context.scene, context.scene.msspl
        identity, overwrite = (scene.name, scene.session_uid), scene.render.use_overwrite
        program = programs.find_fuse(_preference(context))
        options = settings.options(context.view_layer.name)
        path = _numbered(_output(scene, options.view_layer), scene.frame_current)
        if path.startswith("//") and not bpy.data.filepath:
            raise Failure(f"{path}: save the .blend first, or give a full path")
        output = bpy.path.abspath(path)
        check_output(Path(output), overwrite)
        check_scene(scene, options)
        more = [*programs.model_options(scene), *(["--overwrite"] if overwrite else [])]
        with tempfile.TemporaryDirectory(prefix="msspl-") as name:
            work = Path(name)
            with frame.loaded_once(scene):
                renders = yield from frame.render_frame(scene, options, work, window=window)
            start = time.perf_counter()
            warnings = yield from programs.fuse(program, more, work, [part.file for part in renders], output)
            report = frame.Report(path, renders, time.perf_counter() - start, warnings)
        self._finish(overrides.find_scene(*identity), options.view_layer, path, warnings, f"{path}: {report}")


class MSSPL_OT_fuse_animation(_Job, bpy.types.Operator):
    """Render all frames of the scene in another Blender, fuse them, and show the result in the compositor"""

    bl_idname = "msspl.fuse_animation"
    bl_label = "Render and Fuse Animation"
    _cancelled = "Cancelled; the frames that were written stay"

    def _job(self, context: Context, window: bool = False) -> Generator[frame.Progress, None, None]:
        scene, settings = context.scene, context.scene.msspl
        identity, file = (scene.name, scene.session_uid), bpy.data.filepath
        program = programs.find_render(_preference(context))
        options = settings.options(context.view_layer.name)
        check_scene(scene, options)
        # Without a window, Blender does not know whether a file has changed.
        if not file or (bpy.data.is_dirty and not bpy.app.background):
            raise Failure(f"{file or 'the scene'}: save the .blend first; another Blender renders the saved file")
        pattern = _output(scene, options.view_layer)
        frames = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        if not _LAST_NUMBER.search(pattern):
            raise Failure(f"{pattern}: name the frames with #### as the last number, such as //fused_####.exr")
        outputs = {number: bpy.path.abspath(_numbered(pattern, number)) for number in frames}
        with tempfile.TemporaryDirectory(prefix="msspl-") as work:
            reports = yield from programs.render_shot(
                program, Path(work), scene, options, bpy.path.abspath(pattern), outputs
            )
        warnings = [warning for report in reports for warning in report["warnings"]]
        text = f"{pattern}: {len(reports)} of {len(frames)} frames rendered and fused"
        text += f" {reports[0]['temporal']}" if reports else ""
        shown = overrides.find_scene(*identity), options.view_layer, _numbered(pattern, frames[0])
        self._finish(*shown, warnings, text, frames)


#: The frame number in the name of a file. The name of a folder may contain #.
_NUMBER = re.compile(r"#+(?=[^/\\]*$)")
#: Characters of a scene's names that become _ in the name of a file.
_NOT_IN_NAMES = re.compile(r'[#<>:"/\\|?*{}]')
#: The last number of the name, which Blender's compositor takes for the frame number.
_LAST_NUMBER = re.compile(r"(?<![\d#])#+[^/\\\d#]*$")


def _output(scene: Scene, view_layer: str) -> str:
    """Return the name of the output, with the names of the scene in the place of ``{scene_name}`` and so on."""
    pattern, several = scene.msspl.output, [layer.name for layer in scene.view_layers if layer.use]
    if len(several) > 1 and "{view_layer}" not in pattern:
        raise Failure(
            f"{pattern}: {len(several)} view layers are on ({', '.join(several)}); put {{view_layer}} into the name, "
            "so that each has a file of its own"
        )
    names = {
        "view_layer": view_layer,
        "scene_name": scene.name,
        "camera_name": scene.camera.name if scene.camera else "no_camera",
        "blend_name": bpy.path.display_name_from_filepath(bpy.data.filepath) or "Unsaved",
    }
    safe = {key: _NOT_IN_NAMES.sub("_", name) for key, name in names.items()}
    try:
        return pattern.format_map(safe)
    except (AttributeError, LookupError, ValueError) as error:
        known = ", ".join(f"{{{key}}}" for key in names)
        raise Failure(f"{pattern}: write braces only around known names, which are {known}") from error


def _numbered(pattern: str, number: int) -> str:
    """Return the file of a frame."""
    return _NUMBER.sub(lambda signs: f"{number:0{len(signs[0])}d}", pattern)


def _preference(context: Context) -> str:
    """Return the path of msspl-fuse in the add-on's preferences; empty if there is none."""
    addon = context.preferences.addons.get(__package__)
    return bpy.path.abspath(addon.preferences.program) if addon else ""


_register, _unregister = bpy.utils.register_classes_factory((MSSPL_OT_fuse, MSSPL_OT_fuse_animation))


def register() -> None:
    _register()
    bpy.app.handlers.save_pre.append(overrides.restore_for_save)
    for after in (bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail):
        after.append(overrides.override_after_save)


def unregister() -> None:
    bpy.app.handlers.save_pre.remove(overrides.restore_for_save)
    for after in (bpy.app.handlers.save_post, bpy.app.handlers.save_post_fail):
        after.remove(overrides.override_after_save)
    _unregister()
