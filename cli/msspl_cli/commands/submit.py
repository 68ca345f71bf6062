# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl submit``."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from msspl_cli import console, options
from msspl_cli.commands import fuse
from msspl_cli.options import option

EXAMPLES = """[bold]Examples[/bold]

  msspl submit lr/ hr/ -o out/ --bundle job/

  msspl submit lr.####.exr hr.####.exr -o out.####.exr --frames 1001-1100 --chunk 5 --layout nuke --bundle job/

  openjd run job/template.json --job-param file://job/openjd_values.json

  deadline bundle submit job/
"""

_COMMAND = "Run this on the workers: a path, or a launcher such as 'rez env oiio_msspl -- msspl-fuse'."
#: The group of its own options in the help text.
JOB = "Job"
#: Parameters of msspl-fuse that :func:`oiio_msspl.jobs.farm.openjd.make_job` takes itself, that every task has, or
#: that are about this command.
_TAKEN = {
    *("renders", "output", "frames", "model", "quality", "map_file", "device", "view", "preview", "max_memory"),
    *("skip_existing", "update", "debug", "help_all", "version"),
}
#: Parameters of msspl-fuse that a job can't have: a task skips existing frames and reports to the farm.
_LEFT_OUT = {"overwrite", "report_file", "progress", "as_json", "scheduler"}


def _with_options_of_fuse(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the parameters of msspl-fuse, but for ``_LEFT_OUT``, in the place of its ``**given``."""
    own, fuses = (inspect.signature(function, eval_str=True).parameters for function in (command, fuse.fuse))
    shared = [parameter for name, parameter in fuses.items() if name not in _LEFT_OUT]
    parameters = [
        # A farm has nobody to look at previews.
        each.replace(kind=each.KEYWORD_ONLY, default=False if each.name == "preview" else each.default)
        for each in [*shared, *own.values()]
        if each.kind != each.VAR_KEYWORD
    ]

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


@_with_options_of_fuse
def submit(
    context: typer.Context,
    bundle: Annotated[Path, option(JOB, "Write to this new folder.", metavar="DIR", show_default=False)],
    chunk: Annotated[int, option(JOB, "Fuse N frames in each task.", metavar="N", min=1, max=100_000)] = 10,
    timeout: Annotated[
        int,
        option(JOB, "Limit the time of a frame. A task gets N times as long.", metavar="SECONDS", min=1, max=1_000_000),
    ] = 1800,
    name: Annotated[
        str | None,
        option(JOB, "Name the job. \\[default: folders and name of the renders, and the frames]", metavar="TEXT"),
    ] = None,
    command: Annotated[str, option(JOB, _COMMAND, metavar="COMMAND")] = "msspl-fuse",
    conda: Annotated[
        str | None, option(JOB, "Ask the queue for these Conda packages (CondaPackages).", metavar="PACKAGES")
    ] = None,
    rez: Annotated[
        str | None, option(JOB, "Ask the queue for these Rez packages (RezPackages).", metavar="PACKAGES")
    ] = None,
    **given: Any,
) -> None:
    """Write a shot as a job for a farm: an Open Job Description bundle.

    openjd and Deadline Cloud run it. Each task runs [bold]msspl-fuse[/bold] on N
    frames with the same options. A task that runs again fuses only the frames
    that do not exist, or are older than their renders. A worker needs the memory
    of --max-memory, and a GPU if --device is one.
    """
    options.set_up_logging(given["verbose"], given["quiet"])
    from oiio_msspl.image.parallel import limit_threads
    from oiio_msspl.jobs.checks import check_first_pair, check_wanted_outputs
    from oiio_msspl.jobs.farm.openjd import OPENJD_VALUES, TEMPLATE, make_job, write_bundle
    from oiio_msspl.jobs.plan import TemporalOptions, plan_temporal
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
    job = make_job(
        *options.low_and_high(given["renders"]),
        given["output"],
        inputs=inputs,
        model=model,
        options=_passed_on(context, given),
        chunk=chunk,
        timeout=timeout,
        previews=given["preview"],
        name=name,
        command=command,
        packages={key: wanted for key, wanted in (("conda", conda), ("rez", rez)) if wanted},
        **{name: given[name] for name in ("frames", "map_file", "device", "view", "max_memory")},
    )
    check_wanted_outputs(job.shot.frames, inputs, write, model, max_memory)
    # Files of the mapping may exist on the workers only. Without them, the motion can't be looked at.
    if all(path.exists() for hr in job.shot.hr.files.values() for path in inputs.files(hr, None)):
        with limit_threads(given["threads"]):
            plan_temporal(job.shot, inputs, temporal, model, write)
    doubts = check_first_pair(job.shot.frames, inputs)
    write_bundle(bundle, job)
    for doubt in doubts:
        console.say(f"warning: {doubt}", error=True)
    for pattern, frames in job.missing:
        text = f"warning: {pattern} lacks {format_frames(frames)}: their tasks fail unless these files appear"
        console.say(text, error=True)
    if given["quiet"]:
        return
    skipped = f"; {job.existing} exist and are skipped unless an input is newer" if job.existing else ""
    console.say(f"{len(job.shot.frames)} frames{skipped}. To run the job:")
    values = f"file://{bundle / OPENJD_VALUES}"
    console.say(f"  openjd run {shlex.quote(str(bundle / TEMPLATE))} --job-param {shlex.quote(values)}")
    console.say(f"  deadline bundle submit {shlex.quote(str(bundle))}")


def _passed_on(context: typer.Context, given: dict[str, Any]) -> list[str]:
    """Return the arguments that every task gets: those that are not the default of their option."""
    from oiio_msspl.aovs.mapping import is_exr

    defaults = {name: parameter.default for name, parameter in inspect.signature(fuse.fuse).parameters.items()}
    arguments = []
    for parameter in context.command.params:
        name = parameter.name or ""
        value: Any = given.get(name)
        if name not in given or name in _TAKEN or value == defaults[name]:
            continue
        if isinstance(value, bool):
            arguments.append((parameter.opts if value else parameter.secondary_opts)[0])
        elif name == "verbose":
            arguments += [parameter.opts[0]] * value
        else:
            for text in map(str, value if isinstance(value, list | tuple) else [value]):
                feature, _, layer = text.partition("=")
                if name == "mapping" and is_exr(layer):  # tasks run in other folders
                    text = f"{feature}={Path(layer).absolute()}"
                arguments += [parameter.opts[0], text]
    return arguments
