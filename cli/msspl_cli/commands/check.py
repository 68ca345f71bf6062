# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl check``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import typer

from msspl_cli import console, options
from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from oiio_msspl.jobs.fitting import PairCheck, ShotCheck

EXAMPLES = """[bold]Examples[/bold]

  msspl check lr.exr hr.exr

  msspl check lr/ hr/ --frames 1001-1100x10

[bold]Exit code[/bold]

  0: every pair fits. 2: a pair does not fit, or a mistake in files or options.
"""


def check(
    renders: options.Renders,
    mapping: options.Map = [],  # noqa: B006
    map_file: options.MapFile = None,
    view_layer: options.ViewLayer = None,
    colorspace: options.Colourspace = None,
    frames: options.Frames = None,
    as_json: options.Json = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Tell whether a render can be fused, or whether two fit, without fusing them.

    A pair does not fit if it can't be fused, or if the two renders do not seem to
    show the same frame: another camera, light, colour space, albedo or normal.
    Advice says what more would help, and what it costs.
    """
    from oiio_msspl.jobs.fitting import check_files, check_shot
    from oiio_msspl.jobs.sequence import is_sequence

    inputs = options.make_inputs(mapping, map_file, view_layer, None, None, colorspace)
    lr, hr = options.low_and_high(renders)
    result: PairCheck | ShotCheck
    if any(is_sequence(path) for path in renders):

        def show(number: int, pair: PairCheck) -> None:
            if not as_json:
                _print(f"frame {number}", pair)

        result = check_shot(lr, hr, frames, inputs, progress=show)
        if not as_json:
            for text in (*result.warnings, *([] if result.warnings else [result.temporal])):
                console.say(f"the shot: {text}")
    elif frames:
        raise InputError("--frames is for shots: give folders, or patterns such as lr.####.exr")
    else:
        result = check_files(lr, hr, inputs)
        if not as_json:
            _print(f"{hr}" if lr is None else f"{lr} and {hr}", result)
    if as_json:
        print(json.dumps(result.as_dict(), indent=2))
    else:
        for text in result.advice:
            console.say(f"  advice: {text}")
    if not result.fits:
        raise typer.Exit(2)


def _print(name: str, pair: PairCheck) -> None:
    if pair.problem is not None:
        console.say(f"{name}: can't be fused: {pair.problem}")
    else:
        console.say(f"{name}: {'fits' if pair.fits else 'does not fit'}")
    not_judged = [f"not judged: {', '.join(pair.not_judged)}"] if pair.not_judged else []
    for text in (*pair.warnings, *pair.passed_on, *not_judged):
        console.say(f"  {text}")
