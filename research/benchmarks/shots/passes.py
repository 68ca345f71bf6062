# SPDX-License-Identifier: Apache-2.0
"""Measure what neighbouring frames gain for passes: accuracy and flicker of light groups in a shot.

    python -m research.benchmarks.shots.passes --table research/benchmarks/results/shots_passes.csv

The shot is that of :mod:`research.benchmarks.shots.moving_wall`: a wall past which the camera moves, lit by lamps. Its
clean light is known. Flicker is the mean absolute difference of the error from one frame to the next, along the motion.
"""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import numpy as np

from oiio_msspl import fuse_shot
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.fusion.passes.layers import layer_names, light_of
from oiio_msspl.image.arrays import Array
from oiio_msspl.jobs.plan import TemporalOptions
from oiio_msspl.model.catalogue import find_model
from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.shots.moving_wall import STEP, clean_frame, write_shot

SIZE, LAMPS, FRAMES = (320, 180), 4, 18
#: Frames at either end of the shot have fewer neighbours and are not scored.
ENDS = 6


def groups_of(path: Path) -> list[Array]:
    """Return the light groups of a frame, (h, w, 3) each."""
    render = map_render(open_exr(path))
    names = layer_names(render.additive_sets)
    pixels = light_of(render, names).pixels.read(render.data_window, names.values())
    return [pixels[name] for name in names.values()]


def scores(errors: Array) -> tuple[float, float]:
    """Return PSNR in dB, and flicker, of errors (frames, h, w, 3)."""
    moved = errors[1:, :, :-STEP] - errors[:-1, :, STEP:]
    return float(-10 * np.log10(np.mean(errors**2))), float(np.abs(moved).mean())


def measure(folder: Path, scale: int, quality: str, frames: str) -> Row:
    """Return the means of all passes."""
    out = folder / f"{quality} {frames}"
    out.mkdir()
    report = fuse_shot(folder / "lr", folder / "hr", out, model=quality, temporal=TemporalOptions(frames))
    if report.exit_code:
        raise SystemExit(next(result.message for result in report.results.values() if result.message))
    errors = []
    for number in range(1 + ENDS, FRAMES + 1 - ENDS):
        _, lights = clean_frame(number, FRAMES, *SIZE, LAMPS)
        fused = groups_of(out / f"hr.{number:04d}.exr")
        errors.append([image - clean for image, clean in zip(fused, lights, strict=True)])
    psnr, flicker = np.mean([scores(images) for images in np.swapaxes(np.array(errors), 0, 1)], axis=0).tolist()
    key: Row = {"scale": scale, "quality": quality, "temporal": frames, "model": find_model(scale, quality).stem}
    return key | {"of": "passes", "psnr": psnr, "flicker": flicker}


def main() -> None:
    """Measure both qualities at both scales, frame by frame and with neighbours."""
    args = results.parser(__doc__).parse_args()
    rows: list[Row] = []
    for scale in (2, 4):
        with tempfile.TemporaryDirectory() as folder:
            write_shot(Path(folder), FRAMES, *SIZE, scale, LAMPS)
            for quality, frames in itertools.product(("balanced", "best"), ("off", "auto")):
                rows.append(measure(Path(folder), scale, quality, frames))
    results.show(rows, args.table)


if __name__ == "__main__":
    main()
