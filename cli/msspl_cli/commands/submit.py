# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from msspl_cli import options
from msspl_cli.commands import fuse
from oiio_msspl.errors import InputError

#: The command takes every word that it does not know itself, and hands it to msspl-fuse's own parser.
SETTINGS = {"allow_extra_args": True, "ignore_unknown_options": True}
USAGE = "LR HR -o OUT --bundle DIR [OPTION]..."

EXAMPLES = """[bold]Examples[/bold]

  msspl submit lr/ hr/ -o out/ --bundle job/

  msspl submit lr.####.exr hr.####.exr -o out.####.exr --frames 1001-1100 --chunk 5 --layout nuke --bundle job/

  openjd run job/template.json --job-param file://job/openjd_values.json

  deadline bundle submit job/
"""

#: Parameters of msspl-fuse that are said otherwise in a job, and those that have no meaning in one.
_SAID = {"lr", "hr", "output", "frames", "model", "map_file", "skip_existing"}
_MEANINGLESS = {"overwrite", "report_file", "progress", "as_json", "scheduler"}
_PATHS = ("lr", "hr", "output", "map_file")


def submit(
    context: typer.Context,
    bundle: Annotated[Path, typer.Option(metavar="DIR", help="New folder for the job bundle.", show_default=False)],
    chunk: Annotated[int, typer.Option(metavar="N", min=1, help="Frames a task.")] = 10,
    timeout: Annotated[
        int, typer.Option(metavar="SECONDS", min=1, help="For a frame; a task is ended after N times that.")
    ] = 1800,
) -> None:
    """Write a shot as a job for a farm: an Open Job Description bundle, which openjd and Deadline Cloud run.

    LR, HR, OUT and all other options are those of [bold]msspl-fuse[/bold]. Every task is msspl-fuse on a chunk of the
    frames. A task that is run again does only the frames that are not there.
    """
    given, passed_on = _parse(context.args)
    options.set_up_logging(given["verbose"], given["quiet"])
    from oiio_msspl.exr.preview import check_view
    from oiio_msspl.jobs.openjd import OPENJD_VALUES, TEMPLATE, make_job, write_bundle
    from oiio_msspl.jobs.sequence import find_shot, format_frames, is_sequence
    from oiio_msspl.jobs.shot import check_no_input
    from oiio_msspl.model.catalogue import AUTO, WITHOUT_OIDN, find_model, shipped_models
    from oiio_msspl.model.contract import SCALES, Contract
    from oiio_msspl.model.session import PROVIDERS

    # What is wrong for every frame is said here, not by every task.
    options.make_inputs(*(given[name] for name in ("mapping", "map_file", "view_layer", "lr_spp", "hr_spp")))
    options.make_write_options(*(given[name] for name in ("layout", "compression", "half", "layers", "error_layer")))
    options.parse_bytes(given["max_memory"])
    if given["view"] is not None:
        check_view(given["view"])
    if given["device"] not in PROVIDERS:  # what is usable here need not be there, nor the other way round
        raise InputError(f"--device {given['device']!r}: use one of {', '.join(PROVIDERS)}")
    files = {"--map-file": given["map_file"]} if given["map_file"] else {}
    # Tasks must not choose for themselves, each on its machine.
    model = WITHOUT_OIDN if given["model"] in (None, AUTO) else given["model"]
    if shipped_models().keys() & {model, *(f"{model}-x{scale}" for scale in SCALES)}:
        passed_on += ["--model", model]
    else:
        files["--model"] = find_model(0, model)
        Contract.of_file(files["--model"])

    paths = given["lr"], given["hr"], given["output"]
    if not any(map(is_sequence, paths[:2])):
        raise InputError(f"{given['lr']}: a job is for a shot: give folders, or patterns such as lr.####.exr")
    shot = find_shot(*paths, given["frames"])
    lacking = {name: [f.number for f in shot.frames if getattr(f, name) is None] for name in ("lr", "hr")}
    if not any(frame.lr and frame.hr for frame in shot.frames):
        raise InputError(f"no frame is in both {shot.lr.pattern} and {shot.hr.pattern}; nothing to submit")
    check_no_input(shot)
    folder = shot.output.folder if shot.output.folder.exists() else shot.output.folder.parent
    if not folder.is_dir():
        raise InputError(f"{given['output']}: the folder {folder} does not exist; create it first")
    write_bundle(bundle, *make_job(*paths, shot, options=passed_on, files=files, chunk=chunk, timeout=timeout))
    for name, sequence in (("lr", shot.lr), ("hr", shot.hr)):
        if lacking[name]:
            frames = format_frames(sorted(lacking[name]))
            print(f"warning: {sequence.pattern} lacks {frames}: unless they come, their tasks fail", file=sys.stderr)
    if given["quiet"]:
        return
    there = sum(frame.output.exists() for frame in shot.frames)
    print(f"{len(shot.frames)} frames" + (f", {there} of which are there and will be skipped" if there else ""))
    values = f"file://{bundle / OPENJD_VALUES}"
    print(f"  openjd run {shlex.quote(str(bundle / TEMPLATE))} --job-param {shlex.quote(values)}")
    print(f"  deadline bundle submit {shlex.quote(str(bundle))}")


def _parse(arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Every parameter of msspl-fuse, and the options that were given and are passed on as they are."""
    program = typer.Typer(add_completion=False, rich_markup_mode="rich")
    program.command()(fuse.fuse)
    command = typer.main.get_command(program)
    context = command.make_context("msspl submit", list(arguments))
    passed_on = []
    for parameter in command.params:
        name = parameter.name or ""
        value: Any = context.params.get(name)
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE" or name in _SAID:
            continue
        if name in _MEANINGLESS:
            raise InputError(
                f"{parameter.opts[0]} has no meaning in a job: its tasks leave finished frames alone and tell the farm "
                "of the others"
            )
        if isinstance(value, bool):
            passed_on.append((parameter.opts if value else parameter.secondary_opts)[0])
        elif getattr(parameter, "count", False):
            passed_on += [parameter.opts[0]] * value
        else:
            for each in value if isinstance(value, list | tuple) else [value]:
                passed_on += [parameter.opts[0], _full_path(each) if name == "mapping" else str(each)]
    # Some versions of typer make paths only when they call the command.
    paths = {name: Path(context.params[name]) for name in _PATHS if context.params[name] is not None}
    return context.params | paths, passed_on


def _full_path(mapping: str) -> str:
    """A ``--map`` that names an EXR, for tasks that run in other folders."""
    feature, equals, layer = mapping.partition("=")
    return f"{feature}{equals}{Path(layer).absolute()}" if layer.lower().endswith(".exr") else mapping
