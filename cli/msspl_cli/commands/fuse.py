# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from msspl_cli import options, show
from msspl_cli.show_shot import ShotPrinter
from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractContextManager

    from dask.distributed import Client

    from oiio_msspl.jobs.report import FrameReport

EXAMPLES = """[bold]Examples[/bold]

  msspl-fuse lr.exr hr.exr -o out.exr

  msspl-fuse lr.exr hr.exr -o out.exr --map albedo=my_albedo --layout nuke --half

  msspl-fuse lr.exr hr.exr -o out.exr --overwrite --no-preview --max-memory 2G --json > report.json

  msspl-fuse lr/ hr/ -o out/ --skip-existing --report shot.json

  msspl-fuse lr.####.exr hr.####.exr -o out.####.exr --frames 1001-1100x2

  msspl-fuse lr/ hr/ -o out/ --scheduler tcp://farm01:8786

[bold]Exit code[/bold]

  0: all is fused, or was there (--skip-existing). 2: a mistake in files or options. 1: any other failure, such as a
  full disk. For a shot: 1 if any frame failed that way, otherwise 2 if any frame was not fused.
"""


def fuse(
    lr: Annotated[
        Path,
        typer.Argument(
            metavar="LR",
            help="Low-resolution, high-spp render: an EXR; of a shot a folder or a pattern (lr.####.exr, lr.%04d.exr).",
            show_default=False,
        ),
    ],
    hr: Annotated[
        Path,
        typer.Argument(metavar="HR", help="High-resolution, low-spp render, likewise.", show_default=False),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="EXR, pattern or folder to write.", show_default=False)
    ],
    mapping: options.Map = [],  # noqa: B006
    map_file: options.MapFile = None,
    view_layer: options.ViewLayer = None,
    lr_spp: options.LrSpp = None,
    hr_spp: options.HrSpp = None,
    model: Annotated[
        str, typer.Option(help="auto, a family (paper), a shipped model (msspl models) or an ONNX file.")
    ] = "auto",
    device: Annotated[str, typer.Option(help="cpu, cuda, tensorrt, openvino, coreml or directml.")] = "cpu",
    threads: Annotated[int, typer.Option(min=0, max=1024, help="CPU threads; 0: one a core.")] = 0,
    max_memory: Annotated[str, typer.Option(metavar="SIZE", help="Memory to stay below; tiles shrink to fit.")] = "3G",
    layout: Annotated[str, typer.Option(help="spec, nuke or multilayer.")] = "spec",
    layers: Annotated[
        list[str],
        typer.Option(
            metavar="PATTERN", help="Pass on only these layers of HR (crypto*), or none. May be repeated. [all]"
        ),
    ] = [],  # noqa: B006
    error_layer: Annotated[
        bool, typer.Option("--error-layer", help="Add a layer 'error': how far off the model expects to be.")
    ] = False,
    compression: Annotated[
        str | None, typer.Option(help="Of the fused layer: zip, zips, piz, dwaa, ... [as the HR]")
    ] = None,
    half: Annotated[
        bool | None, typer.Option("--half/--float", help="Pixel type of the fused layer. [as the HR]")
    ] = None,
    preview: Annotated[bool, typer.Option(help="Write an sRGB PNG beside OUT.")] = True,
    view: Annotated[str | None, typer.Option(metavar="VIEW", help="OpenColorIO view of the preview.")] = None,
    overwrite: options.Overwrite = False,
    frames: Annotated[
        str | None, typer.Option(metavar="RANGE", help="Of a shot: 1001-1100x2, 1001,1005-1010. [all]")
    ] = None,
    skip_existing: Annotated[
        bool, typer.Option("--skip-existing", help="Of a shot: leave frames that are there; resumes a run.")
    ] = False,
    report_file: Annotated[
        Path | None, typer.Option("--report", metavar="FILE", help="Of a shot: JSON, kept up to date frame by frame.")
    ] = None,
    progress: Annotated[
        str | None, typer.Option(metavar="FORM", help="Of a shot: print lines for programs, openjd or json.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Of a shot: fuse on the workers of this Dask scheduler (tcp://HOST:8786)."
        ),
    ] = None,
    verbose: options.Verbose = 0,
    quiet: options.Quiet = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Fuse a low-resolution, high-spp render with a high-resolution, low-spp render of the same frame.

    OUT gets the fused beauty first and every other layer of HR as it was. The scale (x2, x4, x8) follows from the two
    display windows; layers are found whatever the renderer calls them, and what was used is printed.

    With folders or patterns, a shot: frames are paired by number, and a bad one does not stop the others.
    """
    options.set_up_logging(verbose, quiet)
    from oiio_msspl.jobs.frame import fuse_files
    from oiio_msspl.jobs.sequence import is_sequence

    common: dict[str, Any] = {
        "inputs": options.make_inputs(mapping, map_file, view_layer, lr_spp, hr_spp),
        "write": options.make_write_options(layout, compression, half, layers, error_layer),
        "model": model,
        "device": device,
        "threads": threads,
        "max_memory": options.parse_bytes(max_memory),
        "view_transform": view,
        "overwrite": overwrite,
    }
    if is_sequence(lr) or is_sequence(hr):
        from oiio_msspl.jobs.shot import fuse_shot

        if debug:
            logging.getLogger("oiio_msspl.jobs.shot").setLevel(logging.DEBUG)
        printer = ShotPrinter(verbose, quiet, as_json, progress)
        try:
            with _cluster(scheduler) as client:
                shot_report = fuse_shot(
                    lr,
                    hr,
                    output,
                    frames=frames,
                    previews=preview,
                    skip_existing=skip_existing,
                    report_path=report_file,
                    progress=printer,
                    client=client,
                    **common,
                )
        finally:
            printer.end()
        raise typer.Exit(shot_report.exit_code)

    for option, value in (
        ("--frames", frames),
        ("--skip-existing", skip_existing),
        ("--report", report_file),
        ("--progress", progress),
        ("--scheduler", scheduler),
    ):
        if value:
            raise InputError(f"{option} is for shots: give folders, or patterns such as lr.####.exr")
    start = time.perf_counter()
    report = fuse_files(
        lr,
        hr,
        output,
        preview_path=output.with_suffix(".png") if preview and output.name else None,
        progress=_bar(quiet),
        **common,
    )
    if as_json:
        print(json.dumps(report.as_dict(), indent=2))
    elif not quiet:
        _print(report, time.perf_counter() - start)
    if not quiet:
        for warning in report.warnings:
            print(f"warning: {warning}", file=sys.stderr)


def _cluster(scheduler: str | None) -> AbstractContextManager[Client | None]:
    if scheduler is None:
        return nullcontext()
    from oiio_msspl.jobs.dask_cluster import connect

    return connect(scheduler)


def _bar(quiet: bool) -> Callable[[int, int], None]:
    """A progress bar on a terminal; in a pipe or a log, lines if they are asked for (-v)."""
    if quiet or not sys.stderr.isatty():
        return lambda done, count: logging.info("tile %d of %d", done, count)
    bar: Any = None

    def update(done: int, count: int) -> None:
        nonlocal bar
        if bar is None:
            bar = typer.progressbar(length=count, label="fusing", file=sys.stderr)
        bar.update(1)
        if done == count:
            bar.render_finish()

    return update


def _print(report: FrameReport, seconds: float) -> None:
    spp = report.spp_avg
    print(f"{report.hr.renderer} pair at x{report.scale}" + (f", {spp:g} spp on average" if spp is not None else ""))
    show.aov_table(report.aovs(), report.hr.notes)
    if of_lrhs := report.found_low_aovs():
        print("  of the LRHS, too: " + ", ".join(f"{name} {layer}" for name, layer in of_lrhs.items()))
    if report.repaired:
        what = ", ".join(f"{count} in {name}" for name, count in report.repaired.items())
        print(f"repaired values that were NaN, infinite or negative: {what}")
    tiles = f", {report.tiles} tiles" if report.tiles > 1 else ""
    network = report.seconds["network"]
    print(f"{report.model} on {report.provider}{tiles}: {seconds:.1f} s, of which {network:.1f} s in the network")
    print(f"wrote {report.output}" + (f" and {report.preview}" if report.preview else ""))
