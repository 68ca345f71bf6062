# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from msspl_cli import options, show

if TYPE_CHECKING:
    from collections.abc import Callable

    from oiio_msspl.files import Report

EXAMPLES = """[bold]Examples[/bold]

  msspl-fuse lr.exr hr.exr -o out.exr

  msspl-fuse lr.exr hr.exr -o out.exr --map albedo=my_albedo --layout nuke --half

  msspl-fuse lr.exr hr.exr -o out.exr --overwrite --no-preview --max-memory 2G --json > report.json
"""


def fuse(
    lr: Annotated[
        Path, typer.Argument(metavar="LR", help="Low-resolution, high-spp render (EXR).", show_default=False)
    ],
    hr: Annotated[
        Path, typer.Argument(metavar="HR", help="High-resolution, low-spp render (EXR).", show_default=False)
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="EXR to write.", show_default=False)],
    mapping: options.Map = [],  # noqa: B006
    map_file: options.MapFile = None,
    view_layer: options.ViewLayer = None,
    lr_spp: options.LrSpp = None,
    hr_spp: options.HrSpp = None,
    model: Annotated[str | None, typer.Option(help="A shipped model (msspl models) or an ONNX file.")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, tensorrt, openvino, coreml or directml.")] = "cpu",
    threads: Annotated[int, typer.Option(min=0, max=1024, help="CPU threads; 0: one a core.")] = 0,
    max_memory: Annotated[str, typer.Option(metavar="SIZE", help="Memory to stay below; tiles shrink to fit.")] = "3G",
    layout: Annotated[str, typer.Option(help="spec, nuke or multilayer.")] = "spec",
    compression: Annotated[
        str | None, typer.Option(help="Of the fused layer: zip, zips, piz, dwaa, ... [as the HR]")
    ] = None,
    half: Annotated[
        bool | None, typer.Option("--half/--float", help="Pixel type of the fused layer. [as the HR]")
    ] = None,
    preview: Annotated[bool, typer.Option(help="Write an sRGB PNG beside OUT.")] = True,
    view: Annotated[str | None, typer.Option(metavar="VIEW", help="OpenColorIO view of the preview.")] = None,
    overwrite: options.Overwrite = False,
    verbose: options.Verbose = 0,
    quiet: options.Quiet = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Fuse a low-resolution, high-spp render with a high-resolution, low-spp render of the same frame.

    OUT gets the fused beauty first and every other layer of HR as it was. The scale (x2, x4, x8) follows from the two
    display windows; layers are found whatever the renderer calls them, and what was used is printed.
    """
    options.set_up_logging(verbose, quiet)
    from oiio_msspl.assemble import WriteOptions
    from oiio_msspl.files import fuse_files

    start = time.perf_counter()
    report = fuse_files(
        lr,
        hr,
        output,
        inputs=options.make_inputs(mapping, map_file, view_layer, lr_spp, hr_spp),
        write=WriteOptions(layout, compression, None if half is None else "half" if half else "float"),
        model=model,
        device=device,
        threads=threads,
        max_memory=options.parse_bytes(max_memory),
        preview_path=output.with_suffix(".png") if preview and output.name else None,
        view_transform=view,
        overwrite=overwrite,
        progress=_bar(quiet),
    )
    if as_json:
        print(json.dumps(report.as_dict(), indent=2))
    elif not quiet:
        _print(report, time.perf_counter() - start)
    if not quiet:
        for warning in report.warnings:
            print(f"warning: {warning}", file=sys.stderr)


def _bar(quiet: bool) -> Callable[[int, int], None] | None:
    """A progress bar on a terminal; nothing in a pipe or a log."""
    if quiet or not sys.stderr.isatty():
        return None
    bar: Any = None

    def update(done: int, count: int) -> None:
        nonlocal bar
        if bar is None:
            bar = typer.progressbar(length=count, label="fusing", file=sys.stderr)
        bar.update(1)
        if done == count:
            bar.render_finish()

    return update


def _print(report: Report, seconds: float) -> None:
    spp = report.spp_avg
    print(f"{report.hr.renderer} pair at x{report.scale}" + (f", {spp:g} spp on average" if spp is not None else ""))
    show.aov_table(report.hr)
    if report.repaired:
        what = ", ".join(f"{count} in {name}" for name, count in report.repaired.items())
        print(f"repaired values that were NaN, infinite or negative: {what}")
    tiles = f", {report.tiles} tiles" if report.tiles > 1 else ""
    network = report.seconds["network"]
    print(f"{report.model} on {report.provider}{tiles}: {seconds:.1f} s, of which {network:.1f} s in the network")
    print(f"wrote {report.output}" + (f" and {report.preview}" if report.preview else ""))
