# SPDX-License-Identifier: Apache-2.0
"""``msspl compare``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from msspl_cli import console, options

EXAMPLES = """[bold]Examples[/bold]

  msspl compare out.exr hr.exr lr.exr --reference ref.exr

  msspl compare out.exr -r ref.exr --error-map error.png
"""


def compare(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="EXRs to measure.", show_default=False)],
    reference: Annotated[
        Path, typer.Option("--reference", "-r", metavar="EXR", help="The converged render.", show_default=False)
    ],
    error_map: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Write a picture of the first image's error (log RelMSE; dark is small)."),
    ] = None,
    overwrite: options.Overwrite = False,
    as_json: options.Json = False,
    debug: options.Debug = False,
    help_all: options.HelpAll = False,
) -> None:
    """Measure images against a reference: PSNR (sRGB), RelMSE, SSIM.

    RelMSE has two columns, one for each convention in the paper. Images smaller
    than the reference by x2, x4 or x8 are upsampled bicubically first.
    """
    from oiio_msspl.compare import check_error_map, compare_files, write_error_map

    if error_map is not None:
        check_error_map(error_map, [*images, reference], overwrite=overwrite)
    results = compare_files(images, reference)
    if error_map is not None:
        write_error_map(error_map, images[0], reference, overwrite=overwrite)
    if as_json:
        # The PSNR of equal pictures is infinite, which JSON can't express.
        rows = [{k: v if math.isfinite(v) else None for k, v in scores.items()} for scores in results]
        print(json.dumps([{"image": str(p), **row} for p, row in zip(images, rows, strict=True)], indent=2))
        return
    table = [("image", "PSNR", "RelMSE (0.5, 0.01)", "RelMSE (1, 1e-4)", "SSIM")]
    for path, scores in zip(images, results, strict=True):
        table.append(
            (
                str(path),
                f"{scores['psnr']:.2f} dB",
                f"{scores['relmse']:.5f}",
                f"{scores['relmse_gharbi']:.5f}",
                f"{scores['ssim']:.4f}",
            )
        )
    console.table(table, header=True, indent=0)
