# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders one frame once or twice, and reports on it.

A job is a generator that yields its progress, so that a window stays responsive. Closing the generator cancels the job.
However the job ends, the scene gets its own settings back.
"""

import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bpy.types import Scene

from . import render_settings
from .checks import check_animation
from .errors import Failure
from .options import Options, frame_size
from .overrides import find_scene, override
from .render import render

#: The current step, and the fraction of the work that is done.
Progress = tuple[str, float]


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


def render_frame(
    scene: Scene, options: Options, work: Path, *, window: bool = False
) -> Generator[Progress, None, list[InputRender]]:
    """Render a frame once or twice, yield the progress, and return the renders. The fusion counts as one step more.

    Args:
        work: a folder for the renders, which stay there.
        window: let Blender go on while it renders. The caller must then return to Blender's event loop between steps.

    Raises:
        Failure, Cancelled: a render is missing.
    """
    to_render = _input_renders(scene, options, work)
    identity, moment = (scene.name, scene.session_uid), (scene.frame_current, scene.frame_subframe)
    for index, (part, values) in enumerate(to_render):
        progress = str(part), index / (len(to_render) + 1)
        yield progress
        scene = find_scene(*identity)
        if (scene.frame_current, scene.frame_subframe) != moment:
            raise Failure(
                f"the scene went from frame {moment[0]} to {scene.frame_current} during the render; render again"
            )
        start = time.perf_counter()
        escaped = part.file.replace("{", "{{").replace("}", "}}")  # Blender takes {name} for a variable.
        with override(scene, values | {"render.filepath": escaped}):
            check_animation(scene, values)
            for _ in render(scene, part.file, window=window):
                yield progress
        part.seconds = time.perf_counter() - start
    return [part for part, _ in to_render]


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
