# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame from start to end: render the LRHS, render the HRLS, fuse the two.

A job is a generator that yields its progress, so that a window stays responsive. Closing the generator cancels the job.
However the job ends, the scene gets its own settings back.
"""

import time
from dataclasses import dataclass
from pathlib import Path

from . import render_settings
from .checks import check_animation, check_output, check_scene
from .errors import Failure
from .options import hrls_size, lrhs_size
from .overrides import find_scene, override
from .render import escape_path, render


@dataclass
class InputRender:
    """One of the two renders that are fused."""

    name: str
    """``LRHS`` or ``HRLS``."""
    size: tuple
    """(width, height) in pixels."""
    spp: int
    file: str
    seconds: float = 0.0
    """Wall time, including loading the scene and writing the file."""

    @property
    def samples(self):
        """All samples of the image."""
        return self.size[0] * self.size[1] * self.spp

    def __str__(self):
        return f"{self.name} {self.size[0]}x{self.size[1]}, {self.spp} spp"


@dataclass
class Report:
    """The files and times of one fused frame."""

    output: str
    lrhs: InputRender
    hrls: InputRender
    fuse_seconds: float
    warnings: list

    @property
    def seconds(self):
        return self.lrhs.seconds + self.hrls.seconds + self.fuse_seconds

    @property
    def plain_spp(self):
        """Estimated spp of an ordinary render that takes as long as this frame took.

        It could take the samples of both renders and, during the time of the fusion, samples at the faster one's rate.
        """
        rate = max(each.samples / max(each.seconds, 1e-3) for each in (self.lrhs, self.hrls))
        samples = self.lrhs.samples + self.hrls.samples + rate * self.fuse_seconds
        return samples / (self.hrls.size[0] * self.hrls.size[1])

    def __str__(self):
        return (
            f"LRHS {self.lrhs.seconds:.1f} s, HRLS {self.hrls.seconds:.1f} s, fuse {self.fuse_seconds:.1f} s; "
            f"an ordinary render takes about {self.plain_spp:.1f} spp in the same time"
        )


def render_and_fuse(scene, options, output, work, fuse, *, overwrite=False, window=False):
    """Render and fuse a frame. This is a generator that yields ``(current step, fraction done)``.

    Args:
        output: the EXR to write.
        work: a folder for ``lr.exr`` and ``hr.exr``, which stay there.
        fuse: called with the files of the LRHS, the HRLS and the output. It is a generator like this function, and
            returns a dictionary with ``warnings``.
        window: let Blender go on while it renders. The caller must then return to Blender's event loop between steps.

    Returns:
        A :class:`Report`.

    Raises:
        Failure, Cancelled: no output was written.
    """
    check_output(Path(output), overwrite)
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
        for part, each in enumerate((lrhs, hrls)):
            yield str(each), part / 3
            scene = find_scene(*identity)
            if (scene.frame_current, scene.frame_subframe) != moment:
                raise Failure(
                    f"the scene went from frame {moment[0]} to {scene.frame_current} during the render; render again"
                )
            start = time.perf_counter()
            with override(scene, values[part] | {"render.filepath": escape_path(each.file)}):
                check_animation(scene, values[part])
                for _ in render(scene, each.file, window=window):
                    yield str(each), part / 3
            each.seconds = time.perf_counter() - start
    start = time.perf_counter()
    fused = yield from fuse(lrhs.file, hrls.file, str(output))
    return Report(str(output), lrhs, hrls, time.perf_counter() - start, fused["warnings"])


def run_to_end(steps, on_step):
    """Run a job without a window and return its report. Each step's progress goes to ``on_step``."""
    while True:
        try:
            step = next(steps)
        except StopIteration as end:
            return end.value
        on_step(*step)
        time.sleep(0.02)
