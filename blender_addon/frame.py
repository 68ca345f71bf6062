# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes one frame: renders the LRHS, renders the HRLS, and fuses the two.

A job is a generator that yields its progress, so that a window stays responsive. Closing the generator cancels the job.
However the job ends, the scene gets its own settings back.
"""

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bpy.types import Scene

from . import render_settings
from .checks import check_animation, check_output, check_scene
from .errors import Failure
from .options import Options, hrls_size, lrhs_size
from .overrides import find_scene, override
from .render import escape_path, render

#: The current step, and the fraction of the work that is done.
Progress = tuple[str, float]
#: Fuses the files of an LRHS and of an HRLS into a third, and returns a dictionary with ``warnings``.
Fuse = Callable[[str, str, str], Generator[Progress, None, dict[str, Any]]]


@dataclass
class InputRender:
    """One of the two renders that are fused."""

    name: str
    """``LRHS`` or ``HRLS``."""
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
    lrhs: InputRender
    hrls: InputRender
    fuse_seconds: float
    warnings: list[str]

    @property
    def seconds(self) -> float:
        """The time of both renders and of the fusion."""
        return self.lrhs.seconds + self.hrls.seconds + self.fuse_seconds

    @property
    def plain_spp(self) -> float:
        """Estimated spp of an ordinary render that takes as long as this frame took: the samples of both renders and,
        during the time of the fusion, samples at the rate of the faster render."""
        rate = max(part.samples / max(part.seconds, 1e-3) for part in (self.lrhs, self.hrls))
        samples = self.lrhs.samples + self.hrls.samples + rate * self.fuse_seconds
        return samples / (self.hrls.size[0] * self.hrls.size[1])

    def __str__(self) -> str:
        return (
            f"LRHS {self.lrhs.seconds:.1f} s, HRLS {self.hrls.seconds:.1f} s, fuse {self.fuse_seconds:.1f} s; "
            f"an ordinary render takes about {self.plain_spp:.1f} spp in the same time"
        )


def render_and_fuse(
    scene: Scene, options: Options, output: Path, work: Path, fuse: Fuse, overwrite: bool = False, window: bool = False
) -> Generator[Progress, None, Report]:
    """Render and fuse a frame, and yield the progress.

    Args:
        output: the EXR to write.
        work: a folder for ``lr.exr`` and ``hr.exr``, which stay there.
        window: let Blender go on while it renders. The caller must then return to Blender's event loop between steps.

    Returns:
        A :class:`Report`.

    Raises:
        Failure, Cancelled: no output was written.
    """
    check_output(output, overwrite)
    check_scene(scene, options)
    lrhs = InputRender("LRHS", lrhs_size(scene, options.scale), options.lrhs_spp, str(Path(work, "lr.exr")))
    hrls = InputRender("HRLS", hrls_size(scene), options.hr_spp, str(Path(work, "hr.exr")))
    values = render_settings.lrhs(scene, options), render_settings.hrls(scene, options)
    identity, moment = (scene.name, scene.session_uid), (scene.frame_current, scene.frame_subframe)
    # With persistent data, Blender loads the scene once for both renders. Turning it off first discards the data of
    # earlier renders: Cycles does not notice that lights have another group since, and renders that group black.
    with (
        override(scene, {"render.use_persistent_data": False}),
        override(scene, {"render.use_persistent_data": True}),
    ):
        for index, part in enumerate((lrhs, hrls)):
            yield str(part), index / 3
            scene = find_scene(*identity)
            if (scene.frame_current, scene.frame_subframe) != moment:
                raise Failure(
                    f"the scene went from frame {moment[0]} to {scene.frame_current} during the render; render again"
                )
            start = time.perf_counter()
            with override(scene, values[index] | {"render.filepath": escape_path(part.file)}):
                check_animation(scene, values[index])
                for _ in render(scene, part.file, window=window):
                    yield str(part), index / 3
            part.seconds = time.perf_counter() - start
    start = time.perf_counter()
    fused = yield from fuse(lrhs.file, hrls.file, str(output))
    return Report(str(output), lrhs, hrls, time.perf_counter() - start, fused["warnings"])


def run_to_end(job: Generator[Progress, None, Report], on_step: Callable[[str, float], None]) -> Report:
    """Run a job without a window and return its report. The progress of each step goes to ``on_step``."""
    while True:
        try:
            progress = next(job)
        except StopIteration as end:
            return end.value
        on_step(*progress)
        time.sleep(0.02)
