# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl compare``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from msspl_cli import console, options
from msspl_cli.options import option
from oiio_msspl.errors import InputError

if TYPE_CHECKING:
    from oiio_msspl.compare import Comparison

EXAMPLES = """[bold]Examples[/bold]

  msspl compare out.exr hr.exr lr.exr --reference ref.exr

  msspl compare out.exr hr.exr -r ref.exr --map rgb=light_key

  msspl compare out.exr hr.exr lr.exr -r ref.exr --html page.html --layers 'light*'
"""

#: A page of more bytes loads slowly.
LARGE_PAGE = 60_000_000

_REFERENCE = "Measure against this converged render. Only --html works without it."
_HTML = "Write a page to look at all pictures in a browser, with their layers and errors."
_LAYERS = "Show these layers on the page (light*). May be repeated. \\[default: those that sum to the beauty]"
_MAP = "Compare this layer of all files instead of their beauty."


def compare(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="EXRs to measure.", show_default=False)],
    reference: Annotated[Path | None, option(None, _REFERENCE, "--reference", "-r", metavar="EXR")] = None,
    html: Annotated[Path | None, option(None, _HTML, metavar="HTML")] = None,
    layers: Annotated[list[str], option(None, _LAYERS, metavar="PATTERN")] = [],  # noqa: B006
    mapping: Annotated[list[str], option(None, _MAP, "--map", metavar="rgb=LAYER")] = [],  # noqa: B006
    overwrite: options.Overwrite = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Measure images against a reference: PSNR (sRGB), RelMSE, SSIM. Look at them in a browser.

    RelMSE has two columns, one for each convention in the paper. Images smaller
    than the reference by x2, x4 or x8 are upsampled bicubically first. Of files
    with several views, the first view of the first image is compared.
    """
    from oiio_msspl.aovs.features import RGB
    from oiio_msspl.aovs.mapping import parse_map_options
    from oiio_msspl.compare import check_page, notes, open_comparison, score_images
    from oiio_msspl.compare_page import check_layers
    from oiio_msspl.image.arrays import HALF_MAX

    if reference is None and html is None:
        raise InputError("scores need --reference; without one, --html writes a page to look at")
    if layers and html is None:
        raise InputError("--layers chooses the layers of the page; add --html PAGE")
    if html is not None:
        check_page(html, [*images, reference] if reference else images, overwrite=overwrite)
    mapped = parse_map_options(mapping)
    if mapped.keys() - {RGB}:
        raise InputError("--map: only rgb is compared; write --map rgb=LAYER")
    comparison = open_comparison(images, reference, mapped.get(RGB))
    if html is not None:
        check_layers(comparison, layers)
    for note in notes(comparison):
        console.say(note, error=True)
    results = score_images(comparison) if reference else [{} for _ in images]
    for name, count in comparison.broken.items():
        counts_as = f"NaN counts as black here, infinity as {HALF_MAX:.0f}"
        console.say(f"warning: {name}: {count} values are NaN or infinite; {counts_as}", error=True)
    wrote = _write_page(html, comparison, layers, overwrite) if html else ""
    if as_json:
        # The PSNR of equal pictures is infinite, which JSON can't express.
        rows = [{k: v if math.isfinite(v) else None for k, v in scores.items()} for scores in results]
        print(json.dumps([{"image": str(p), **row} for p, row in zip(images, rows, strict=True)], indent=2))
    elif reference is not None:
        _print(images, results)
    if wrote:
        console.say(wrote, error=as_json)


def _print(images: list[Path], results: list[dict[str, float]]) -> None:
    rows = [("image", "PSNR", "RelMSE (0.5, 0.01)", "RelMSE (1, 1e-4)", "SSIM")]
    for path, scores in zip(images, results, strict=True):
        psnr, ssim = f"{scores['psnr']:.2f} dB", f"{scores['ssim']:.4f}"
        rows.append((str(path), psnr, f"{scores['relmse']:.5f}", f"{scores['relmse_gharbi']:.5f}", ssim))
    console.table(rows, header=True, indent=0)


def _write_page(html: Path, comparison: Comparison, layers: list[str], overwrite: bool) -> str:
    """Write the page, and return a sentence about it."""
    from oiio_msspl.compare_page import write_page

    with console.ProgressBar() as bar:
        size, names = write_page(
            html,
            comparison,
            layers=layers,
            overwrite=overwrite,
            progress=lambda done, total: bar.update("writing layers", done, total),
        )
    advice = "; choose fewer layers with --layers to make it smaller" if size > LARGE_PAGE else ""
    return f"Wrote {html}: {size / 1e6:.1f} MB, layers: {', '.join(names)}{advice}"
