# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl-fuse``."""

from __future__ import annotations

import json
import logging
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from msspl_cli import console, options
from msspl_cli.options import INPUT, MODEL, OUTPUT, SHOT, option
from msspl_cli.shot_printer import ShotPrinter
from oiio_msspl.errors import InputError
from oiio_msspl.image.parallel import MOST_THREADS

if TYPE_CHECKING:
    from oiio_msspl.jobs.report import FrameReport

#: LRHS, HRLS and output; None and the only render in front, if there is one.
Files = tuple[Path | None, Path, Path]

EXAMPLES = """[bold]Examples[/bold]

  msspl-fuse hr.exr -o out.exr

  msspl-fuse seed1.exr seed2.exr -o out.exr

  msspl-fuse lr.exr hr.exr -o out.exr

  msspl-fuse lr.exr hr.exr -o out.exr --map albedo=my_albedo --layout nuke --half

  msspl-fuse lr.exr hr.exr -o out.exr --overwrite --no-preview --max-memory 4G --json > report.json

  msspl-fuse lr/ hr/ -o out/ --skip-existing --report shot.json

  msspl-fuse lr.####.exr hr.####.exr -o out.####.exr --frames 1001-1100x2

  msspl-fuse lr/ hr/ -o out/ --scheduler tcp://farm01:8786

[bold]Exit code[/bold]

  0: every frame is fused, or was there (--skip-existing)

  1: a failure that is not in the input, such as a full disk

  2: a mistake in files or options, or in a shot a frame that was not fused

  129, 130, 143: stopped by SIGHUP, by Ctrl-C, by SIGTERM
"""

_OUTPUT = "Write this EXR. For a shot: a pattern or a folder."
_LAYERS = (
    "Write only these layers of HR (crypto*) beside the beauty, or none. A pass that does not match is left out, too. "
    "May be repeated. \\[default: all]"
)
_COMPRESSION = "Compress the fused layer by zip, htj2k256, dwaa, ... \\[default: as HR, or zip if that is lossy]"


def fuse(
    renders: options.Renders,
    *,
    # Input
    mapping: options.Map = [],  # noqa: B006
    map_file: options.MapFile = None,
    view_layer: options.ViewLayer = None,
    lr_spp: Annotated[
        float | None, option(INPUT, "Set LR's samples per pixel, if its header does not.", metavar="N", hidden=True)
    ] = None,
    hr_spp: Annotated[
        float | None, option(INPUT, "Set HR's samples per pixel, if its header does not.", metavar="N", hidden=True)
    ] = None,
    colorspace: options.Colourspace = None,
    sums: options.Sum = [],  # noqa: B006
    # Model
    quality: options.Quality = None,
    model: options.Model = "auto",
    device: options.Device = "cpu",
    max_memory: options.MaxMemory = "3G",
    threads: Annotated[
        int, option(MODEL, "Use N CPU threads. 0: one on each core.", metavar="N", min=0, max=MOST_THREADS, hidden=True)
    ] = 0,
    # Output
    output: Annotated[Path, option(OUTPUT, _OUTPUT, "--output", "-o", metavar="OUT", show_default=False)],
    layout: options.Layout = "spec",
    layers: Annotated[list[str], option(OUTPUT, _LAYERS, metavar="PATTERN")] = [],  # noqa: B006
    passes: options.Passes = ["auto"],  # noqa: B006
    error_layer: options.ErrorLayer = False,
    data_passes: options.DataPasses = False,
    trust: options.Trust = "on",
    trust_layer: options.TrustLayer = False,
    compression: Annotated[str | None, option(OUTPUT, _COMPRESSION, metavar="NAME", hidden=True)] = None,
    half: Annotated[
        bool | None, option(OUTPUT, "Set the fused layer's type. \\[default: as HR]", "--half/--float", hidden=True)
    ] = None,
    preview: Annotated[bool, option(OUTPUT, "Write an sRGB PNG beside OUT.", hidden=True)] = True,
    view: Annotated[
        str | None, option(OUTPUT, "Preview in an OpenColorIO view.", "--ocio-view", metavar="NAME", hidden=True)
    ] = None,
    overwrite: options.Overwrite = False,
    strict: options.Strict = False,
    as_json: options.Json = False,
    # Shot
    frames: options.Frames = None,
    temporal: options.Temporal = "auto",
    motion_format: options.MotionFormat = None,
    frames_layer: options.FramesLayer = False,
    skip_existing: options.SkipExisting = False,
    update: Annotated[
        bool, option(SHOT, "Skip frames that exist and are newer than their inputs.", "--update", hidden=True)
    ] = False,
    report_file: Annotated[
        Path | None, option(SHOT, "Write a JSON report after each frame.", "--report", metavar="FILE", hidden=True)
    ] = None,
    progress: Annotated[
        str | None, option(SHOT, "Print progress for programs: openjd or json.", metavar="FORM", hidden=True)
    ] = None,
    scheduler: Annotated[
        str | None,
        option(SHOT, "Fuse on the workers of this Dask scheduler (tcp://HOST:8786).", metavar="ADDRESS", hidden=True),
    ] = None,
    verbose: options.Verbose = 0,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
    version: options.Version = False,
) -> None:
    """Remove the noise of a render, or of two renders of the same frame together.

    Two renders have a noise seed each. They are a low-resolution, high-spp render
    LR and a high-resolution, low-spp render HR, or two renders of the same size.

    OUT gets the fused beauty and passes, and every other layer of HR unchanged.
    The scale (x1, x2, x4, x8) follows from the two display windows. Layers are
    found under the names that renderers give them; --map names others.

    With folders or patterns it fuses a shot: frames are paired by number, and a
    bad frame does not stop the others.
    """
    options.set_up_logging(verbose, quiet)
    from oiio_msspl.exr.reader import use_threads
    from oiio_msspl.jobs.plan import TemporalOptions
    from oiio_msspl.jobs.sequence import check_exists, is_sequence
    from oiio_msspl.jobs.settings import bytes_of

    lr, hr = options.low_and_high(renders)
    for path in renders:
        check_exists(path)
    written: dict[str, Any] = {"layout": layout, "compression": compression, "error_layer": error_layer}
    written |= {"frames_layer": frames_layer, "trust_layer": trust_layer, "data_passes": data_passes}
    common: dict[str, Any] = {
        "inputs": options.make_inputs(mapping, map_file, view_layer, lr_spp, hr_spp, colorspace, sums),
        "write": options.make_write_options(passes, trust, layers=layers, half=half, **written),
        "model": options.choose_model(model, quality),
        "device": device,
        "threads": threads,
        "max_memory": bytes_of(max_memory),
        "view_transform": view,
        "overwrite": overwrite,
        "strict": strict,
    }
    over_time = TemporalOptions(temporal, motion_format)
    use_threads(threads)
    if any(is_sequence(path) for path in renders):
        if debug:
            logging.getLogger("oiio_msspl.jobs.shot").setLevel(logging.DEBUG)  # the traceback of each failed frame
        printer = ShotPrinter(verbose, quiet, as_json, progress)
        shot = {"frames": frames, "temporal": over_time, "previews": preview, "report_path": report_file}
        skipping = {"skip_existing": skip_existing, "update": update}
        _fuse_shot((lr, hr, output), scheduler, printer, **shot, **skipping, **common)
    for name, value in (
        ("--frames", frames),
        ("--skip-existing", skip_existing),
        ("--update", update),
        ("--report", report_file),
        ("--progress", progress),
        ("--scheduler", scheduler),
        ("--temporal", temporal not in ("auto", "off")),
        ("--motion-format", motion_format),
        ("--frames-layer", frames_layer),
    ):
        if value:
            raise InputError(f"{name} is for shots: give folders, or patterns such as lr.####.exr")
    png = output.with_suffix(".png") if preview and output.name else None
    _fuse_pair((lr, hr, output), verbose, quiet, as_json, preview_path=png, **common)


def _fuse_shot(files: Files, scheduler: str | None, printer: ShotPrinter, **settings: Any) -> None:
    """Fuse a shot, on a Dask cluster if ``--scheduler`` names one, and exit with its code."""
    from oiio_msspl.jobs.farm.dask import connect
    from oiio_msspl.jobs.shot import fuse_shot

    try:
        with ExitStack() as stack:
            client = None if scheduler is None else stack.enter_context(connect(scheduler))
            report = fuse_shot(*files, begin=printer.begin, progress=printer, client=client, **settings)
    finally:
        printer.end()
    raise typer.Exit(report.exit_code)


def _fuse_pair(files: Files, verbose: int, quiet: bool, as_json: bool, **settings: Any) -> None:
    from oiio_msspl.jobs.files import fuse_files

    start = time.perf_counter()
    with console.ProgressBar(shown=not quiet and not verbose) as bar:

        def show(done: int, count: int) -> None:
            logging.info("step %d of %d", done, count)  # hosts read this line
            bar.update("fusing", done, count)

        report = fuse_files(*files, progress=show, **settings)
    if as_json:
        print(json.dumps(report.as_dict(), indent=2))
    elif not quiet:
        _print(report, time.perf_counter() - start)
    for warning in () if quiet else report.warnings:
        console.say(f"warning: {warning}", error=True)


def _print(report: FrameReport, seconds: float) -> None:
    """Print which layers were used, what was repaired, and the time of each stage."""
    from oiio_msspl.aovs.views import name_of

    kind = "render" if report.is_one_render else "pair"
    renderer = kind.capitalize() if report.hr.renderer == "unknown" else f"{report.hr.renderer} {kind}"
    average = "" if report.spp_avg is None else f", {report.spp_avg:g} spp on average"
    fused = [name_of(view.hr.view) for view in report.fused_views()]
    rest = [name for name in map(name_of, report.hr.other_views) if name not in fused]
    others = f" (also there: {', '.join(rest)})" if rest else ""
    console.say(f"{renderer} at x{report.scale}{average}{console.views_in_words(fused)}{others}")
    console.aov_table(report.aovs(), report.hr.notes)
    for view in report.other_views:
        rows = view.aovs()
        read = [f"{row['feature']} {row['source']}" for row in rows if row["status"] in ("found", "computed")]
        if any((row["feature"], row["status"]) == ("albedo", "default") for row in rows):
            read.append("albedo none: expect blur")
        console.say(f"  view {name_of(view.hr.view)}: {', '.join(read)}")
    if lrhs_aovs := report.lrhs_aovs:
        console.say("  also read from LR: " + ", ".join(f"{name} ({layer})" for name, layer in lrhs_aovs.items()))
    for name, outcome in report.passes.items():
        console.say(f"  {name}: {outcome}")
    if report.trust is not None and report.trust >= 0.005:
        why = "its variance tells that it is no noise" if report.is_one_render else "both renders show it"
        console.say(f"Put back {report.trust:.0%} of what the network had removed: {why}.")
    for text, counts in (
        ("Repaired values that were NaN or infinite", report.repaired),
        ("Set negative values to 0 (colours out of gamut)", report.negative),
    ):
        if counts:
            console.say(f"{text}: {', '.join(f'{count} in {name}' for name, count in counts.items())}")
    stages = {"read": "loading", "fuse": "fusing", "write": "writing"}
    times = ", ".join(f"{report.seconds[key]:.1f} s {stage}" for key, stage in stages.items())
    console.say(f"Fused with {report.model} {_device(report)} in {seconds:.1f} s ({times}).")
    console.say(f"Wrote {report.output}" + (f" and {report.preview}" if report.preview else ""))


def _device(report: FrameReport) -> str:
    provider = report.provider.removesuffix("ExecutionProvider")
    if provider == "CPU":
        return "on the CPU"
    on_cpu = report.convolutions.get("CPUExecutionProvider", 0)
    rest = f", {on_cpu} of {sum(report.convolutions.values())} convolutions on the CPU," if on_cpu else ""
    return f"on {provider}{rest}"
