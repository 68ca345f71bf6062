# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole method for one frame: render the LRHS, render the HRLS, fuse.

A job is a generator: it yields what is being done, so that a window stays alive, and closing it cancels. The scene has
its own settings again however the job ends.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path

from . import fuse, render
from .errors import Failure


@dataclass
class Take:
    """One of the two renders."""

    name: str
    size: tuple
    spp: int
    file: str
    seconds: float = 0.0
    """Wall time, loading the scene and writing the file included."""

    @property
    def samples(self):
        return self.size[0] * self.size[1] * self.spp

    def __str__(self):
        return f"{self.name} {self.size[0]}x{self.size[1]}, {self.spp} spp"


@dataclass
class Report:
    """What was done and how long it took."""

    output: str
    lrhs: Take
    hrls: Take
    fuse_seconds: float
    warnings: list

    @property
    def seconds(self):
        return self.lrhs.seconds + self.hrls.seconds + self.fuse_seconds

    @property
    def plain_spp(self):
        """About how many samples a pixel an ordinary render takes in the same time: those of the two renders, and as
        many as the faster of them would have taken during the fusion."""
        rate = max(take.samples / max(take.seconds, 1e-3) for take in (self.lrhs, self.hrls))
        samples = self.lrhs.samples + self.hrls.samples + rate * self.fuse_seconds
        return samples / (self.hrls.size[0] * self.hrls.size[1])

    def __str__(self):
        return (
            f"LRHS {self.lrhs.seconds:.1f} s, HRLS {self.hrls.seconds:.1f} s, fuse {self.fuse_seconds:.1f} s; "
            f"in the same time, plain rendering takes about {self.plain_spp:.1f} spp"
        )


def make(scene, options, output, work, program, *, overwrite=False, window=False):
    """Render and fuse a frame, as steps that yield ``(what is being done, what part of all is done)``.

    Args:
        output: EXR to write.
        work: folder for ``lr.exr`` and ``hr.exr``, which stay there.
        program: msspl-fuse.
        window: Blender goes on while it renders; the caller then takes a step now and then, and does not wait.

    Returns:
        A :class:`Report`.

    Raises:
        Failure, Cancelled: nothing was written.
    """
    check_output(Path(output), overwrite)
    render.check(scene, options)
    lrhs = Take("LRHS", render.low_size(scene, options.scale), options.low_spp, str(Path(work, "lr.exr")))
    hrls = Take("HRLS", render.high_size(scene), options.hr_spp, str(Path(work, "hr.exr")))
    values = render.low(scene, options), render.high(scene, options)
    identity, moment = (scene.name, scene.session_uid), (scene.frame_current, scene.frame_subframe)
    # The scene is loaded once for both renders.
    with render.settings(scene, {"render.use_persistent_data": True}):
        for part, take in enumerate((lrhs, hrls)):
            yield str(take), part / 3
            scene = render.find_scene(*identity)
            if (scene.frame_current, scene.frame_subframe) != moment:
                raise Failure(
                    f"frame {moment[0]} was left for {scene.frame_current} while it was rendered; do it again"
                )
            start = time.perf_counter()
            with render.settings(scene, values[part] | {"render.filepath": render.literal(take.file)}):
                render.check_animation(scene, values[part])
                for _ in render.render(scene, take.file, window=window):
                    yield str(take), part / 3
            take.seconds = time.perf_counter() - start
    start = time.perf_counter()
    fused = yield from fuse.run(program, lrhs.file, hrls.file, output, work, overwrite, options.threads)
    return Report(str(output), lrhs, hrls, time.perf_counter() - start, fused["warnings"])


def finish(steps, told=None):
    """Do all the steps of a job at once and return its report; ``told`` gets what each step yields."""
    while True:
        try:
            step = next(steps)
        except StopIteration as end:
            return end.value
        if told is not None:
            told(*step)
        time.sleep(0.02)


def check_output(path, overwrite):
    """Fail before anything is rendered.

    Raises:
        Failure: the frame can't be put there.
    """
    if path.suffix.lower() != ".exr":
        raise Failure(f"{path}: the result is an EXR; name it .exr")
    if not path.parent.is_dir():
        raise Failure(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise Failure(f"{path}: the folder {path.parent} is not writable")
    if path.exists() and not overwrite:
        raise Failure(f"{path}: exists; allow overwriting, or name another file")
