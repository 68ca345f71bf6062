# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes one frame: renders it once or twice, and fuses the renders.

A job is a generator that yields its progress, so that a window stays responsive. Closing the generator cancels the job.
However the job ends, the scene gets its own settings back.
"""

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bpy.types import Scene

from . import render_settings
from .checks import check_animation, check_output, check_scene
from .errors import Failure
from .options import Options, frame_size
from .overrides import find_scene, override
from .render import escape_path, render

#: The current step, and the fraction of the work that is done.
Progress = tuple[str, float]
#: Fuses the files of one or two renders into another one, and returns a dictionary with ``warnings``. The second
#: argument is the progress before it.
Fuse = Callable[[Sequence[str], float, str], Generator[Progress, None, dict[str, Any]]]


@dataclass
class InputRender:
    """A render that is fused."""

    name: str
    """``LRHS`` and ``HRLS``; ``render``; or ``render 1`` and ``render 2``, which have the frame's size."""
    size: tuple[int, int]
    """(width, height) in pixels."""
    spp: int
    file: str
    seconds: float = 0.0
    """Wall time, including loading the scene and writing the file."""

    @property
    def samples(self) -> int:
        """All samples of the image."""
        return self.size[0] * self.size[1] * self.spp

    def __str__(self) -> str:
        return f"{self.name} {self.size[0]}x{self.size[1]}, {self.spp} spp"


@dataclass
class Report:
    """The files and times of one fused frame."""

    output: str
    renders: list[InputRender]
    fuse_seconds: float
    warnings: list[str]

    @property
    def seconds(self) -> float:
        """The time of the renders and of the fusion."""
        return sum(part.seconds for part in self.renders) + self.fuse_seconds

    @property
    def plain_spp(self) -> float:
        """Estimated spp of an ordinary render that takes as long as this frame took: the samples of all renders and,
        during the time of the fusion, samples at the rate of the fastest render."""
        rate = max(part.samples / max(part.seconds, 1e-3) for part in self.renders)
        samples = sum(part.samples for part in self.renders) + rate * self.fuse_seconds
        return samples / (self.renders[-1].size[0] * self.renders[-1].size[1])

    def __str__(self) -> str:
        times = "".join(f"{part.name} {part.seconds:.1f} s, " for part in self.renders)
        same_time = f"an ordinary render takes about {self.plain_spp:.1f} spp in the same time"
        return f"{times}fuse {self.fuse_seconds:.1f} s; {same_time}"


def render_and_fuse(
    scene: Scene,
    options: Options,
    output: Path,
    work: Path,
    fuse: Fuse,
    loaded: AbstractContextManager[None],
    *,
    overwrite: bool = False,
    window: bool = False,
) -> Generator[Progress, None, Report]:
    """Render and fuse a frame, yield the progress, and return a :class:`Report`.

    Args:
        work: a folder for the renders, which stay there.
        loaded: entered while frames are rendered: :func:`loaded_once`, or nothing if the caller is inside of it.
        window: let Blender go on while it renders. The caller must then return to Blender's event loop between steps.

    Raises:
        Failure, Cancelled: no output was written.
    """
    check_output(output, overwrite)
    check_scene(scene, options)
    to_render = _input_renders(scene, options, work)
    identity, moment = (scene.name, scene.session_uid), (scene.frame_current, scene.frame_subframe)
    steps = len(to_render) + 1
    with loaded:
        for index, (part, values) in enumerate(to_render):
            yield str(part), index / steps
            scene = find_scene(*identity)
            if (scene.frame_current, scene.frame_subframe) != moment:
                raise Failure(
                    f"the scene went from frame {moment[0]} to {scene.frame_current} during the render; render again"
                )
            start = time.perf_counter()
            with override(scene, values | {"render.filepath": escape_path(part.file)}):
                check_animation(scene, values)
                for _ in render(scene, part.file, window=window):
                    yield str(part), index / steps
            part.seconds = time.perf_counter() - start
    start, renders = time.perf_counter(), [part for part, _ in to_render]
    fused = yield from fuse([part.file for part in renders], (steps - 1) / steps, str(output))
    return Report(str(output), renders, time.perf_counter() - start, fused["warnings"])


@contextmanager
def loaded_once(scene: Scene) -> Iterator[None]:
    """Keep the scene's data in memory for all renders of this block, also those of other frames.

    Data of earlier renders are discarded first: Cycles does not notice that the user has put lights into another group
    since, and renders that group black.
    """
    with override(scene, {"render.use_persistent_data": False}), override(scene, {"render.use_persistent_data": True}):
        yield


def _input_renders(scene: Scene, options: Options, work: Path) -> list[tuple[InputRender, dict[str, Any]]]:
    """Return the renders that are fused, each with its settings."""
    names = ["LRHS", "HRLS"] if options.scale > 1 else ["render 1", "render 2"] if options.renders > 1 else ["render"]
    low = InputRender(names[0], frame_size(scene, options.scale), options.lrhs_spp, str(work / "lr.exr"))
    full = InputRender(names[-1], frame_size(scene), options.hrls_spp, str(work / "hr.exr"))
    inputs = [(low, render_settings.lrhs(scene, options)), (full, render_settings.hrls(scene, options))]
    return inputs[-options.renders :]


def run_to_end(job: Generator[Progress, None, Report], on_step: Callable[[str, float], None]) -> Report:
    """Run a job without a window and return its report. The progress of each step goes to ``on_step``."""
    while True:
        try:
            progress = next(job)
        except StopIteration as end:
            return end.value
        on_step(*progress)
        time.sleep(0.02)
