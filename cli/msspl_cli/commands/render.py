# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl-render``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from msspl_cli import console, options
from msspl_cli.blender_process import find_blender, render_frames
from msspl_cli.options import INPUT, OUTPUT, SHOT, option
from oiio_msspl.errors import InputError
from oiio_msspl.exr import atomic
from oiio_msspl.image.parallel import MOST_THREADS

if TYPE_CHECKING:
    from oiio_msspl.jobs.blender_source import RenderedShot

EXAMPLES = """[bold]Examples[/bold]

  msspl-render scene.blend -o frame.exr

  msspl-render scene.blend --renders 2 --hr-spp 4 -o frame.exr

  msspl-render scene.blend -s 4 --lr-spp 16 --hr-spp 1 -o frame.exr

  msspl-render scene.blend -o shot/frame.####.exr --frames 1001-1100 --skip-existing

  msspl-render scene.blend -o shot/frame.####.exr --frames 1001-1100 --temporal auto

  msspl-render scene.blend -o frame.exr --blender /opt/blender-5.0/blender

  msspl-render scene.blend -o frame.exr --keep --json > times.json
"""

#: Group of options in the help text.
RENDER = "Render"

_SCENE_NAME = "Render this scene, if the file has several. Without it: the one that was active when it was saved."
_BLENDER = "Run this Blender (4.5 or later) or Python with bpy. Without it: MSSPL_BLENDER, or blender on the path."
_RENDERS = "Render each frame once (1), or twice with another noise seed each (2). \\[default: 1, or 2 with --scale]"
_SCALE = "Render two sizes: the first render has 1/2, 1/4 or 1/8 of the width and height. 1: the frame's size."
_HR_SPP = "Render N samples per pixel, each time at full resolution. \\[default: 8, 4 with --renders 2, 1 with --scale]"
_LR_SPP = (
    "Render N samples per pixel at low resolution. \\[default: a third as many samples in total as the "
    "full-resolution render has, but at least 4, 16 or 64 at x2, x4 or x8]"
)
_FILTER = "Filter pixels with box, which is sharpest, or scene for the scene's own filter."
_COMPONENTS = "Render all component passes, from diffuse to volume, besides the passes that the scene has on."
_THREADS = "Use N CPU threads. 0: as the scene says, or one on each core."
_KEEP = "Keep the renders beside OUT: OUT_hr.exr; OUT_a.exr and OUT_b.exr; or OUT_lr.exr and OUT_hr.exr."
_FRAMES = (
    "Render only these frames: 7, 1001-1100x2 or 1001,1005-1010. Without it: the frame at which the scene was saved."
)


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A .blend that renders with Cycles.")],
    *,
    # Input
    view_layer: Annotated[
        str, option(INPUT, "Render this view layer, if several are on.", metavar="NAME", show_default=False)
    ] = "",
    scene_name: Annotated[str, option(INPUT, _SCENE_NAME, metavar="NAME", show_default=False, hidden=True)] = "",
    blender: Annotated[str | None, option(INPUT, _BLENDER, metavar="PROGRAM")] = None,
    # Render
    renders: Annotated[int | None, option(RENDER, _RENDERS, min=1, max=2, metavar="N", show_default=False)] = None,
    scale: Annotated[int, option(RENDER, _SCALE, "--scale", "-s", metavar="N")] = 1,
    lr_spp: Annotated[int | None, option(RENDER, _LR_SPP, min=1, metavar="N", show_default=False)] = None,
    hr_spp: Annotated[int | None, option(RENDER, _HR_SPP, min=1, metavar="N", show_default=False)] = None,
    pixel_filter: Annotated[str, option(RENDER, _FILTER, "--filter", metavar="NAME", hidden=True)] = "box",
    components: Annotated[bool, option(RENDER, _COMPONENTS, "--components")] = False,
    threads: Annotated[int, option(RENDER, _THREADS, min=0, max=MOST_THREADS, metavar="N", hidden=True)] = 0,
    # Model
    quality: options.Quality = None,
    model: options.Model = "auto",
    device: options.Device = "cpu",
    max_memory: options.MaxMemory = "3G",
    # Output
    output: Annotated[
        Path, option(OUTPUT, "Write this EXR, or a pattern.", "--output", "-o", metavar="OUT", show_default=False)
    ],
    layout: options.Layout = "multilayer",
    passes: options.Passes = ["auto"],  # noqa: B006
    error_layer: options.ErrorLayer = False,
    data_passes: options.DataPasses = False,
    trust: options.Trust = "on",
    trust_layer: options.TrustLayer = False,
    keep: Annotated[bool, option(OUTPUT, _KEEP, "--keep", hidden=True)] = False,
    overwrite: options.Overwrite = False,
    as_json: options.Json = False,
    # Shot
    frames: Annotated[str | None, option(SHOT, _FRAMES, "--frames", "--frame", metavar="RANGE")] = None,
    temporal: options.RenderedTemporal = "off",
    skip_existing: options.SkipExisting = False,
    verbose: options.Verbose = 0,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
    version: options.Version = False,
) -> None:
    """Render a Blender scene once, twice, or at two sizes, and fuse the renders.

    OUT gets the fused beauty and every pass of the scene. The time of each step
    is printed, and the samples that ordinary rendering reaches in that time.
    """
    if not scene.is_file():
        raise InputError(f"{scene}: no such file")
    from oiio_msspl.exr.reader import use_threads
    from oiio_msspl.jobs.blender_source import RenderedShot, beside, suffixes
    from oiio_msspl.jobs.plan import TemporalOptions
    from oiio_msspl.jobs.sequence import FrameFiles
    from oiio_msspl.jobs.settings import Settings, bytes_of

    if pixel_filter not in ("box", "scene"):
        raise InputError(f"--filter {pixel_filter!r}: use one of box, scene")
    renders = _count_renders(renders, scale, lr_spp)
    program = find_blender(blender)
    over_time = TemporalOptions(temporal)
    if overwrite and skip_existing:
        raise InputError("--overwrite and --skip-existing exclude each other: replace frames, or leave them")
    shot = name_targets(output, frames)
    targets = [path for _, path in shot if not (skip_existing and path.exists())]
    extras = [beside(path, name) for path in targets for name in suffixes(renders, scale)] if keep else []
    _check_files(scene, output, targets, extras, overwrite=overwrite, skip_existing=skip_existing)
    use_threads(threads)
    added: dict[str, Any] = {"error_layer": error_layer, "trust_layer": trust_layer, "data_passes": data_passes}
    settings = Settings(
        write=options.make_write_options(passes, trust, layout=layout, **added),
        model=options.choose_model(model, quality),
        device=device,
        threads=threads,
        max_memory=bytes_of(max_memory),
        overwrite=overwrite,
    )
    # A scene without a number is one frame, numbered 0.
    files = {path: FrameFiles(number or 0, None, None, path.absolute()) for number, path in shot}
    wanted = [files[path] for path in targets]
    fused = RenderedShot(settings, renders, scale, list(files.values()), wanted, over_time, keep=keep)
    results = {frame.number: str(frame.output) for frame in wanted}
    job = {
        "scene": str(scene.absolute()),
        "scene_name": scene_name,
        # Without a range, there is one frame: that at which the scene was saved. A frame without a result is rendered
        # for its neighbours.
        "frames": [(None if frames is None else frame.number, results.get(frame.number)) for frame in fused.order],
        "options": {
            "renders": renders,
            "scale": scale,
            "hr_spp": hr_spp or 0,
            "lr_spp": lr_spp or 0,
            "filter": pixel_filter.upper(),
            "view_layer": view_layer,
            "components": components,
            "vectors": fused.plan.count > 0,
            "threads": threads,
        },
    }
    atomic.make_folder(output.parent)
    atomic.remove_leftovers(path for _, path in shot)
    printer = _Printer(fused, quiet, verbose=bool(verbose), keep=keep)

    def show(event: dict[str, Any]) -> None:
        if "no_vectors" in event:
            fused.fuse_alone(event["no_vectors"])
        if "size" in event:
            fused.check(event["size"], event["layers"], event["pixel_bytes"])
        printer.show(event)

    try:
        if targets:
            render_frames(program, scene, job, output.parent, show, fused.fuse, verbose=bool(verbose))
    finally:
        printer.end(as_json)
    if not (targets or as_json or quiet):
        print(f"{output}: every frame exists")


def _count_renders(renders: int | None, scale: int, lr_spp: int | None) -> int:
    """Return how often a frame is rendered. Raise InputError if the options do not fit together."""
    from oiio_msspl.model.contract import ONE_SIZE, SCALES

    if scale not in (ONE_SIZE, *SCALES):
        raise InputError(f"--scale {scale}: use one of {', '.join(map(str, (ONE_SIZE, *SCALES)))}")
    if scale == ONE_SIZE and lr_spp is not None:
        raise InputError("--lr-spp: is for a low-resolution render; give --scale, too")
    if scale != ONE_SIZE and renders == 1:
        raise InputError(f"--renders 1: does not go with --scale {scale}, which renders two sizes; leave one out")
    return renders or (1 if scale == ONE_SIZE else 2)


def name_targets(output: Path, frames: str | None) -> list[tuple[int | None, Path]]:
    """Pair frame numbers with files. The number is None without ``frames``: the frame at which the scene was saved."""
    from oiio_msspl.jobs.sequence import is_sequence, parse_frames, parse_pattern

    numbers = [] if frames is None else parse_frames(frames)
    if output.suffix.lower() != ".exr":
        raise InputError(f"{output}: the result is an EXR; name it .exr")
    if is_sequence(output) and not output.is_dir():
        if not numbers:
            raise InputError(f"{output}: is a pattern; name the frames with --frames")
        pattern = parse_pattern(output)
        return [(number, pattern.path(number)) for number in numbers]
    if len(numbers) > 1:
        raise InputError(f"{output}: one name for {len(numbers)} frames; write {output.stem}.####.exr")
    return [(numbers[0] if numbers else None, output)]


def _check_files(
    scene: Path, output: Path, targets: Sequence[Path], extras: Sequence[Path], *, overwrite: bool, skip_existing: bool
) -> None:
    """Refuse results, and extra files beside them, that can't be written."""
    if output not in targets and not output.parent.exists():
        atomic.check_folder(output.parent)  # a pattern's folder is made
    else:
        for path in targets:
            atomic.check_target(path, overwrite=overwrite)
        for path in extras:
            # A resumed shot replaces the files that an earlier run left beside a frame that it could not complete.
            atomic.check_target(path, overwrite=overwrite or skip_existing)
    atomic.check_separate([scene], [*targets, *extras])


class _Printer:
    """The progress and the reports of a shot, as they are printed."""

    def __init__(self, shot: RenderedShot, quiet: bool, *, verbose: bool, keep: bool) -> None:
        self._shot, self._quiet, self._keep = shot, quiet, keep
        self._bar, self._label = console.ProgressBar(shown=not quiet and not verbose), ""
        #: Frames that are done, and the fraction of the current one that is done.
        self._done, self._fraction = 0, 0.0
        self._reports: list[dict[str, Any]] = []
        self._waiting: list[dict[str, Any]] = []  # reports of frames that wait for their neighbours
        self._warnings: list[str] = []  # about all frames

    def show(self, event: dict[str, Any]) -> None:
        """Show the step that Blender works on, and what was written."""
        if "warning" in event:
            self._warnings.append(event["warning"])
        if "step" in event:
            number = event.get("frame")
            self._label = event["step"] if number is None else f"frame {number}: {event['step']}"
            self._fraction = event.get("fraction", 0.0)
        if "report" in event:
            self._waiting.append(event["report"])
            self._done, self._fraction = self._done + 1, 0.0
        else:  # each render takes as long as the fusion
            done = self._done + self._fraction + event.get("samples", 0) / (len(self._shot.suffixes) + 1)
            self._bar.update(self._label, done, len(self._shot.order))
        self._add_written()

    def _add_written(self) -> None:
        """Keep the reports of frames that are written, and print their warnings."""
        from oiio_msspl.findings import codes_of
        from oiio_msspl.jobs.blender_source import beside

        while self._waiting and not self._shot.waits(result := Path(self._waiting[0]["output"])):
            report = self._waiting.pop(0)
            report["temporal"] = self._shot.plan.text
            report["warnings"] += [*self._warnings, *self._shot.written.get(result, [])]
            report["warning_codes"] = codes_of(report["warnings"])
            for render, suffix in zip(report["renders"], self._shot.suffixes, strict=True):
                render["file"] = str(beside(result, suffix)) if self._keep else None
            self._reports.append(report)
            self._bar.hide()
            for warning in () if self._quiet else report["warnings"]:
                console.say(f"warning: frame {report['frame']}: {warning}", error=True)

    def end(self, as_json: bool) -> None:
        """Print the reports: as JSON, or the times as a table, and how frames were averaged."""
        self._add_written()  # they are reported even if a later frame failed
        self._bar.hide()
        if as_json:
            print(json.dumps(self._reports, indent=2))
        elif self._reports and not self._quiet:
            plan = self._shot.plan
            _print_times(self._reports, alone=not plan.count)
            if plan.text:
                print(f"Fused {plan.text}")


def _print_times(reports: Sequence[dict[str, Any]], *, alone: bool) -> None:
    """Print the time of each step and, without neighbours, what ordinary rendering gives in the time of the frame.

    The time of a frame that is averaged does not tell, because it holds the work for frames that waited for it.
    """
    first, last = reports[0], reports[-1]
    for render in first["renders"]:
        print(f"{render['name']} {render['size'][0]}x{render['size'][1]}, {render['spp']} spp")
    names = [f"{render['name']} s" for render in first["renders"]]
    titles = ("frame", *names, "fuse s", "all s", "plain rendering in that time")
    columns = len(titles) if alone else len(titles) - 1
    rows: list[tuple[str, ...]] = [titles[:columns]]
    for report in reports:
        plain = f"about {report['plain_spp']:.1f} spp"
        seconds = *(render["seconds"] for render in report["renders"]), report["fuse_seconds"], report["seconds"]
        rows.append((str(report["frame"]), *(f"{value:.2f}" for value in seconds), plain)[:columns])
    console.table(rows, header=True)
    print(f"Wrote {first['output']}" + (f" to {last['output']}" if last is not first else ""))
