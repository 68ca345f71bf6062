# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl check``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from msspl_cli import console, options
from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from oiio_msspl.jobs.pair_check import PairCheck

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
    """
    from oiio_msspl.jobs.pair_check import check_files
    from oiio_msspl.jobs.sequence import find_shot, is_sequence

    inputs = options.make_inputs(mapping, map_file, view_layer, None, None, colorspace)
    pairs: list[tuple[int | None, PairCheck]] = []
    lr, hr = options.low_and_high(renders)
    if any(is_sequence(path) for path in renders):
        shot = find_shot(lr, hr, Path(), frames)
        for frame in shot.frames:
            high = frame.hr or shot.hr.pattern.path(frame.number)
            low = None if lr is None else frame.lr or shot.lr.pattern.path(frame.number)
            pairs.append((frame.number, check_files(low, high, inputs)))
            _print(*pairs[-1], as_json)
    elif frames:
        raise InputError("--frames is for shots: give folders, or patterns such as lr.####.exr")
    else:
        pairs.append((None, check_files(lr, hr, inputs)))
        _print(*pairs[0], as_json)
    if as_json:
        data = [pair.as_dict() if number is None else {"frame": number} | pair.as_dict() for number, pair in pairs]
        print(json.dumps(data[0] if pairs[0][0] is None else data, indent=2))
    if not all(pair.fits for _, pair in pairs):
        raise typer.Exit(2)


def _print(number: int | None, pair: PairCheck, as_json: bool) -> None:
    """Print the outcome of a pair, unless JSON is printed in the end."""
    if as_json:
        return
    files = f"{pair.hr}" if pair.lr is None else f"{pair.lr} and {pair.hr}"
    name = files if number is None else f"frame {number}"
    if pair.problem is not None:
        console.say(f"{name}: can't be fused: {pair.problem}")
    else:
        console.say(f"{name}: {'fits' if pair.fits else 'does not fit'}")
    not_judged = [f"not judged: {', '.join(pair.not_judged)}"] if pair.not_judged else []
    for text in (*pair.warnings, *pair.passed_on, *not_judged):
        console.say(f"  {text}")
