# SPDX-License-Identifier: Apache-2.0
"""``msspl-render``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from msspl_cli import console, options
from msspl_cli.blender_process import find_blender, render_frames
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import (
    check_folder,
    check_separate,
    check_target,
    make_folder,
    remove_left_folders,
    remove_leftovers,
)
from oiio_msspl.image.parallel import MOST_THREADS

if TYPE_CHECKING:
    from oiio_msspl.jobs.blender_source import RenderedShot
    from oiio_msspl.jobs.settings import Settings

EXAMPLES = """[bold]Examples[/bold]

  msspl-render scene.blend -s 4 --lr-spp 16 --hr-spp 1 -o frame.exr

  msspl-render scene.blend -o shot/frame.####.exr --frames 1001-1100 --skip-existing

  msspl-render scene.blend -o shot/frame.####.exr --frames 1001-1100 --temporal auto

  msspl-render scene.blend -o frame.exr --blender /opt/blender-5.0/blender

  msspl-render scene.blend -o frame.exr --keep --compare --json > times.json
"""

#: Group of options in the help text.
RENDER = "Render"


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A .blend that renders with Cycles.")],
    *,
    # Input
    view_layer: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="View layer to render, if several are on.",
            show_default=False,
            rich_help_panel=options.INPUT,
        ),
    ] = "",
    scene_name: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Scene to render, if the file has several. Without it: the one that was active when it was saved.",
            show_default=False,
            rich_help_panel=options.INPUT,
            hidden=True,
        ),
    ] = "",
    blender: Annotated[
        str | None,
        typer.Option(
            metavar="PROGRAM",
            help="Blender 4.5 or later, or a Python that has bpy. Without it: MSSPL_BLENDER, or blender on the path.",
            rich_help_panel=options.INPUT,
        ),
    ] = None,
    # Render
    scale: Annotated[
        int,
        typer.Option(
            "--scale",
            "-s",
            metavar="N",
            help="2, 4 or 8: the low-resolution render has 1/N of the width and height.",
            rich_help_panel=RENDER,
        ),
    ] = 4,
    lr_spp: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Samples per pixel of the low-resolution render. \\[default: a third as many samples in total as the "
            "full-resolution render has, but at least 4, 16 or 64 at x2, x4 or x8]",
            show_default=False,
            rich_help_panel=RENDER,
        ),
    ] = None,
    hr_spp: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="Samples per pixel of the full-resolution render.", rich_help_panel=RENDER
        ),
    ] = 1,
    pixel_filter: Annotated[
        str,
        typer.Option(
            "--filter",
            metavar="NAME",
            help="Pixel filter: box, which is sharpest, or scene for the scene's own.",
            rich_help_panel=RENDER,
            hidden=True,
        ),
    ] = "box",
    components: Annotated[
        bool,
        typer.Option(
            "--components",
            help="Render all component passes, from diffuse to volume, besides the passes that the scene has on.",
            rich_help_panel=RENDER,
        ),
    ] = False,
    threads: Annotated[
        int,
        typer.Option(
            min=0,
            max=MOST_THREADS,
            metavar="N",
            help="CPU threads. 0: as the scene says, or one on each core.",
            rich_help_panel=RENDER,
            hidden=True,
        ),
    ] = 0,
    # Model
    quality: options.Quality = None,
    model: options.Model = "auto",
    device: options.Device = "cpu",
    max_memory: options.MaxMemory = "3G",
    # Output
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="EXR to write, or a pattern.",
            show_default=False,
            rich_help_panel=options.OUTPUT,
        ),
    ],
    layout: options.Layout = "multilayer",
    passes: options.Passes = ["auto"],  # noqa: B006
    error_layer: options.ErrorLayer = False,
    data_passes: options.DataPasses = False,
    keep: Annotated[
        bool,
        typer.Option(
            "--keep",
            help="Keep both renders beside OUT: OUT_lr.exr, OUT_hr.exr.",
            rich_help_panel=options.OUTPUT,
            hidden=True,
        ),
    ] = False,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Also render the ordinary way, with OIDN, in the same time: OUT_oidn.exr.",
            rich_help_panel=options.OUTPUT,
        ),
    ] = False,
    overwrite: options.Overwrite = False,
    as_json: options.Json = False,
    # Shot
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames",
            "--frame",
            metavar="RANGE",
            help="7, 1001-1100x2 or 1001,1005-1010. Without it: the frame at which the scene was saved.",
            rich_help_panel=options.SHOT,
        ),
    ] = None,
    temporal: options.RenderedTemporal = "off",
    skip_existing: options.SkipExisting = False,
    verbose: options.Verbose = 0,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Render a Blender scene at low and at full resolution, and fuse the two.

    OUT gets the fused beauty and every pass of the scene. The time of each step
    is printed, and the samples that ordinary rendering reaches in that time.
    """
    if not scene.is_file():
        raise InputError(f"{scene}: no such file")
    from oiio_msspl.exr.reader import use_threads
    from oiio_msspl.jobs.blender_source import RenderedShot, beside
    from oiio_msspl.jobs.sequence import FrameFiles
    from oiio_msspl.jobs.settings import Settings
    from oiio_msspl.model.contract import SCALES

    if scale not in SCALES:
        raise InputError(f"--scale {scale}: use one of {', '.join(map(str, SCALES))}")
    if pixel_filter not in ("box", "scene"):
        raise InputError(f"--filter {pixel_filter!r}: use one of box, scene")
    program = find_blender(blender)
    if overwrite and skip_existing:
        raise InputError("--overwrite and --skip-existing exclude each other: replace frames, or leave them")
    over_time = options.make_temporal_options(temporal, None)
    targets = name_targets(output, frames)
    folder = output.parent
    makes_folder = is_pattern(output) and not folder.exists()
    if makes_folder:
        check_folder(folder)
    suffixes = [*(["lr", "hr"] if keep else []), *(["oidn"] if compare else [])]
    for _, target in targets:
        if target.suffix.lower() != ".exr":
            raise InputError(f"{target}: the result is an EXR; name it .exr")
    shot = targets
    if skip_existing:
        targets = [(number, target) for number, target in targets if not target.exists()]
    written = [[target, *(beside(target, suffix) for suffix in suffixes)] for _, target in targets]
    for target, *more in [] if makes_folder else written:
        check_target(target, overwrite=overwrite)
        for path in more:
            # A resumed shot replaces what an earlier run left beside a frame that it could not complete.
            check_target(path, overwrite=overwrite or skip_existing)
    check_separate([scene], [path for paths in written for path in paths])
    write = options.make_write_options(layout, None, None, [], error_layer, passes, data_passes=data_passes)
    model = options.choose_model(model, quality)
    use_threads(threads)
    settings = Settings(
        write=write,
        model=model,
        device=device,
        threads=threads,
        max_memory=options.parse_bytes(max_memory),
        overwrite=overwrite,
    )
    _load_model(settings, scale)
    frames_of_shot = [FrameFiles(number or 0, None, None, target.absolute()) for number, target in shot]
    wanted = {target.absolute() for _, target in targets}
    fuser = RenderedShot(
        settings, frames_of_shot, [each for each in frames_of_shot if each.output in wanted], over_time, keep=keep
    )
    job = {
        "scene": str(scene.absolute()),
        "scene_name": scene_name,
        # A neighbour of a frame has no result. Without a range, there is one frame: that at which the scene was saved.
        "frames": [
            (None if frames is None else frame.number, str(frame.output) if frame.output in wanted else None)
            for frame in fuser.order
        ],
        "options": {
            "scale": scale,
            "hr_spp": hr_spp,
            "lr_spp": lr_spp or 0,
            "filter": pixel_filter.upper(),
            "view_layer": view_layer,
            "components": components,
            "vectors": fuser.averages,
            "threads": threads,
        },
        "overwrite": overwrite,
        "compare": compare,
    }
    if makes_folder:
        make_folder(folder)
    remove_leftovers(target for _, target in shot)
    remove_left_folders(folder)
    reports = _Reports(fuser, keep=keep, quiet=quiet, bar=console.ProgressBar(shown=not quiet and not verbose))
    try:
        if targets:
            render_frames(program, scene, job, folder, reports.show, fuser.fuse, verbose=bool(verbose))
    finally:
        reports.end()  # frames that are written are reported even if a later one failed
        if as_json:
            print(json.dumps(reports.written, indent=2))
        elif reports.written and not quiet:
            _print(reports.written, alone=not fuser.averages)
            if fuser.text:
                print(f"Fused {fuser.text}")
    if not (targets or as_json or quiet):
        print(f"{output}: every frame exists")


def _load_model(settings: Settings, scale: int) -> None:
    """Load the model of all frames.

    Raises:
        InputError: the model or the device can't be had. No frame was rendered for nothing.
    """
    from oiio_msspl.model.catalogue import family_of

    settings = replace(settings, model=family_of(settings.model) or settings.model)
    session = settings.load(scale)
    if session.contract.scale != scale:
        raise InputError(f"--model {settings.model}: is for x{session.contract.scale}, but --scale is {scale}")
    settings.session(scale)  # refuses a model that does not make the layers that are asked for


class _Reports:
    """The reports of a shot's frames, while they are rendered.

    Args:
        fuser: what fuses the frames.
        keep: whether the renders are kept.
        quiet: print no warnings.
        bar: shows the progress.
    """

    def __init__(self, fuser: RenderedShot, *, keep: bool, quiet: bool, bar: console.ProgressBar) -> None:
        self._fuser, self._keep, self._quiet, self._bar = fuser, keep, quiet, bar
        self.written: list[dict[str, Any]] = []
        """Reports of the frames that are written."""
        self._waiting: list[dict[str, Any]] = []  # of frames that wait for their neighbours
        self._warnings: list[str] = []  # about all frames
        self._label = ""

    def show(self, event: dict[str, Any]) -> None:
        """Take an event of :func:`msspl_cli.blender_process.render_frames`.

        Raises:
            InputError: the frames that it is about could not be fused.
        """
        if "no_vectors" in event:
            self._fuser.fuse_alone(event["no_vectors"])
        if "size" in event:
            self._fuser.check(event["size"], event["layers"], event["pixel_bytes"])
        if "warning" in event:
            self._warnings.append(event["warning"])
        if "report" in event:
            self._waiting.append(event["report"])
            self._report()
            return
        if "step" in event:
            number = event.get("frame")
            self._label = event["step"] if number is None else f"frame {number}: {event['step']}"
        self._bar.update(self._label, event.get("samples", 0), 1)

    def end(self) -> None:
        """Report what is written, and hide the progress."""
        self._report()
        self._bar.hide()

    def _report(self) -> None:
        from oiio_msspl.jobs.blender_source import beside

        while self._waiting and not self._fuser.waits(result := Path(self._waiting[0]["output"])):
            report = self._waiting.pop(0)
            report["temporal"] = self._fuser.text
            report["warnings"] += [*self._warnings, *self._fuser.warnings(result)]
            for render, suffix in (("lrhs", "lr"), ("hrls", "hr")):
                report[render]["file"] = str(beside(result, suffix)) if self._keep else None
            self.written.append(report)
            self._bar.hide()
            for warning in [] if self._quiet else report["warnings"]:
                console.say(f"warning: frame {report['frame']}: {warning}", error=True)


def is_pattern(output: Path) -> bool:
    """Whether OUT names several frames."""
    from oiio_msspl.jobs.sequence import is_sequence

    return is_sequence(output) and not output.is_dir()


def name_targets(output: Path, frames: str | None) -> list[tuple[int | None, Path]]:
    """Pair frame numbers with files.

    Args:
        output: an EXR, or a pattern.
        frames: a range; None for the frame at which the scene was saved.

    Returns:
        (number, file) of each frame. The number is None for the frame at which the scene was saved.

    Raises:
        InputError: one name for several frames, or a pattern without frames.
    """
    from oiio_msspl.jobs.sequence import parse_frames, parse_pattern

    numbers = [] if frames is None else parse_frames(frames)
    if is_pattern(output):
        if not numbers:
            raise InputError(f"{output}: is a pattern; name the frames with --frames")
        pattern = parse_pattern(output)
        return [(number, pattern.path(number)) for number in numbers]
    if len(numbers) > 1:
        raise InputError(f"{output}: one name for {len(numbers)} frames; write {output.stem}.####.exr")
    return [(numbers[0] if numbers else None, output)]


def _print(reports: list[dict[str, Any]], *, alone: bool) -> None:
    """Print the time of each step, and what ordinary rendering gives in the same time. If frames are not fused alone,
    the time of one does not say what it costs: it holds the work for frames that have waited for it."""
    first = reports[0]
    for key, name in (("lrhs", "LRHS"), ("hrls", "HRLS")):
        print(f"{name} {first[key]['size'][0]}x{first[key]['size'][1]}, {first[key]['spp']} spp")
    titles = ("frame", "LRHS s", "HRLS s", "fuse s", "all s", "plain rendering in that time")
    columns = len(titles) if alone or any("oidn" in report for report in reports) else len(titles) - 1
    rows: list[tuple[str, ...]] = [titles[:columns]]
    for report in reports:
        oidn = report.get("oidn")
        plain = (
            f"{oidn['spp']} spp and OIDN, {oidn['seconds']:.2f} s: {oidn['file']}"
            if oidn
            else f"about {report['plain_spp']:.1f} spp"
        )
        seconds = report["lrhs"]["seconds"], report["hrls"]["seconds"], report["fuse_seconds"], report["seconds"]
        rows.append((str(report["frame"]), *(f"{value:.2f}" for value in seconds), plain)[:columns])
    console.table(rows, header=True)
    print(f"Wrote {reports[0]['output']}" + (f" to {reports[-1]['output']}" if len(reports) > 1 else ""))
