# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl inspect``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from msspl_cli import console, options

EXAMPLES = """[bold]Examples[/bold]

  msspl inspect hr.exr

  msspl inspect lr.exr hr.exr

  msspl inspect hr.exr --map normal=N_bump --json
"""


def inspect(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="EXR files.", show_default=False)],
    mapping: options.Map = [],  # noqa: B006
    map_file: options.MapFile = None,
    view_layer: options.ViewLayer = None,
    model: options.Model = "auto",
    motion_format: options.MotionFormat = None,
    as_json: options.Json = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Print what a render contains, and which of its layers a model would read.

    If the next frame lies beside a file, the two verify its motion vectors. The
    two renders of a frame tell whether a pixel filter has spread their noise.
    Advice says what more would help, and what it costs.

    If a file can't be used, the reason is printed and the exit code is 2.
    """
    from oiio_msspl.inspection import inspect_file, inspect_noise

    inputs = options.make_inputs(mapping, map_file, view_layer, None, None)
    inspections = [inspect_file(path, inputs, model, motion_format) for path in files]
    inspect_noise(inspections)
    if as_json:
        data = [inspection.as_dict() for inspection in inspections]
        print(json.dumps(data if len(data) > 1 else data[0], indent=2))
    else:
        for inspection in inspections:
            console.say(str(inspection.path))
            for line in inspection.facts:
                console.say(f"  {line}")
            if inspection.layers:
                console.say("  layers:")
                several = len({row["part"] for row in inspection.layers}) > 1
                keys = ("layer", "view", "channels", "type", *(["part"] if several else []))
                console.table([[row[key] for key in keys] for row in inspection.layers], indent=4)
            if inspection.render is not None:
                console.say(f"  what {inspection.model} would read:")
                console.aov_table(inspection.aovs(), inspection.render.notes)
            for text in inspection.advice:
                console.say(f"  advice: {text}")
            for problem in inspection.problems:
                console.say(f"  can't be used: {problem}")
    if any(inspection.problems for inspection in inspections):
        raise typer.Exit(2)
