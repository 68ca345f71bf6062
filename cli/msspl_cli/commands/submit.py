# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl submit``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from msspl_cli import console, options
from msspl_cli.commands import fuse
from oiio_msspl.errors import InputError

#: The command accepts arguments that it does not know. msspl-fuse's own parser reads them.
SETTINGS = {"allow_extra_args": True, "ignore_unknown_options": True}
USAGE = "[LR] HR -o OUT --bundle DIR [OPTION]..."

EXAMPLES = """[bold]Examples[/bold]

  msspl submit lr/ hr/ -o out/ --bundle job/

  msspl submit lr.####.exr hr.####.exr -o out.####.exr --frames 1001-1100 --chunk 5 --layout nuke --bundle job/

  openjd run job/template.json --job-param file://job/openjd_values.json

  deadline bundle submit job/
"""

#: Parameters of msspl-fuse that :func:`oiio_msspl.jobs.farm.openjd.make_job` takes itself, or that every task has.
_TAKEN = {"renders", "output", "frames", "model", "quality", "map_file", "device", "view", "skip_existing"}
#: Parameters of msspl-fuse that a job can't have: a task skips existing frames and reports to the farm.
_REFUSED = {"overwrite", "report_file", "progress", "as_json", "scheduler"}
_PATHS = ("output", "map_file")


def submit(
    context: typer.Context,
    bundle: Annotated[Path, typer.Option(metavar="DIR", help="Write to this new folder.", show_default=False)],
    chunk: Annotated[int, typer.Option(metavar="N", min=1, max=100_000, help="Fuse N frames in each task.")] = 10,
    timeout: Annotated[
        int,
        typer.Option(
            metavar="SECONDS", min=1, max=1_000_000, help="Limit the time of a frame. A task gets N times as long."
        ),
    ] = 1800,
    # Typer splits a short option that it does not know into letters: in -o/path it would find the -h of --help.
    output: Annotated[str | None, typer.Option("--output", "-o", metavar="OUT", hidden=True)] = None,
    help_all: Annotated[
        bool,
        typer.Option(
            "--help-all",
            help="Show the options of msspl-fuse and exit.",
            is_eager=True,
            callback=lambda wanted: _parse(["--help-all"]) if wanted else None,
        ),
    ] = False,
) -> None:
    """Write a shot as a job for a farm: an Open Job Description bundle.

    openjd and Deadline Cloud run it. LR, HR, OUT and all other options are those
    of [bold]msspl-fuse[/bold]. Each task runs msspl-fuse on N frames. A task that
    runs again fuses only the frames that do not exist.
    """
    given, passed_on = _parse([*context.args, *(() if output is None else ("--output", output))])
    options.set_up_logging(given["verbose"], given["quiet"])
    from oiio_msspl.image.parallel import limit_threads
    from oiio_msspl.jobs.checks import check_first_pair, check_temporal, check_wanted_outputs
    from oiio_msspl.jobs.farm.openjd import OPENJD_VALUES, TEMPLATE, make_job, write_bundle
    from oiio_msspl.jobs.plan import TemporalOptions
    from oiio_msspl.jobs.sequence import format_frames
    from oiio_msspl.jobs.settings import bytes_of

    # A wrong value is refused here, and not by every task.
    names = ("mapping", "map_file", "view_layer", "lr_spp", "hr_spp", "colorspace", "sums")
    inputs = options.make_inputs(*(given[name] for name in names))
    written = ("layout", "compression", "half", "layers", "passes", "trust")
    added = ("error_layer", "frames_layer", "trust_layer", "data_passes")
    write = options.make_write_options(**{name: given[name] for name in (*written, *added)})
    temporal = TemporalOptions(given["temporal"], given["motion_format"])
    max_memory = bytes_of(given["max_memory"])
    model = options.choose_model(given["model"], given["quality"])
    settings: dict[str, Any] = {name: given[name] for name in ("frames", "map_file", "device", "view")}
    settings |= {"inputs": inputs, "model": model, "options": passed_on, "chunk": chunk, "timeout": timeout}
    job = make_job(*options.low_and_high(given["renders"]), given["output"], **settings)
    check_wanted_outputs(job.shot.frames, inputs, write, model, max_memory)
    with limit_threads(given["threads"]):
        check_temporal(job.shot, inputs, temporal, model, write)
    doubts = check_first_pair(job.shot.frames, inputs)
    write_bundle(bundle, job)
    for doubt in doubts:
        console.say(f"warning: {doubt}", error=True)
    for pattern, frames in job.missing:
        text = f"warning: {pattern} lacks {format_frames(frames)}: their tasks fail unless these files appear"
        console.say(text, error=True)
    if given["quiet"]:
        return
    skips = "are skipped unless an input is newer" if given["update"] else "will be skipped"
    skipped = f"; {job.existing} exist and {skips}" if job.existing else ""
    console.say(f"{len(job.shot.frames)} frames{skipped}. To run the job:")
    values = f"file://{bundle / OPENJD_VALUES}"
    console.say(f"  openjd run {shlex.quote(str(bundle / TEMPLATE))} --job-param {shlex.quote(values)}")
    console.say(f"  deadline bundle submit {shlex.quote(str(bundle))}")


def _parse(arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Read arguments as msspl-fuse does.

    Returns:
        The value of each parameter, and the arguments that every task gets unchanged.

    Raises:
        InputError: an option that a job can't have.
    """
    program = typer.Typer(add_completion=False, rich_markup_mode="rich")
    program.command()(fuse.fuse)
    command = typer.main.get_command(program)
    context = command.make_context("msspl submit", list(arguments))
    passed_on = []
    for parameter in command.params:
        name = parameter.name or ""
        value: Any = context.params.get(name)
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE" or name in _TAKEN:
            continue
        if name in _REFUSED:
            raise InputError(
                f"{parameter.opts[0]} has no meaning in a job: its tasks skip existing frames and report to the farm"
            )
        if isinstance(value, bool):
            passed_on.append((parameter.opts if value else parameter.secondary_opts)[0])
        elif getattr(parameter, "count", False):
            passed_on += [parameter.opts[0]] * value
        else:
            for text in value if isinstance(value, list | tuple) else [value]:
                passed_on += [parameter.opts[0], _full_path(text) if name == "mapping" else str(text)]
    # Some versions of typer convert paths only when they call the command.
    paths = {name: Path(context.params[name]) for name in _PATHS if context.params[name] is not None}
    renders = [Path(path) for path in context.params["renders"]]
    return context.params | paths | {"renders": renders}, passed_on


def _full_path(mapping: str) -> str:
    """Make the path of a ``--map`` absolute if it names an EXR, because tasks run in other folders."""
    from oiio_msspl.aovs.mapping import is_exr

    feature, equals, layer = mapping.partition("=")
    return f"{feature}{equals}{Path(layer).absolute()}" if is_exr(layer) else mapping
