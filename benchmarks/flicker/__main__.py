# SPDX-License-Identifier: Apache-2.0
"""Flicker of sequences that are fused frame by frame, beside OIDN's.

    python -m benchmarks.render.sequences SEQUENCES --scenes SCENES
    python -m benchmarks.flicker SEQUENCES --table benchmarks/results/flicker.csv --picture docs/images/flicker.png

:mod:`benchmarks.flicker.measures` defines flicker. Each method is measured three times: frame by frame; with its
outputs accumulated along the motion of the surfaces (:mod:`benchmarks.flicker.temporal`); and with its inputs
accumulated.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from benchmarks import results
from benchmarks.flicker.measures import flicker, psnr
from benchmarks.flicker.report import INPUTS, NOTHING, OIDN_FULL, OUTPUTS, Pictures, draw, layout
from benchmarks.flicker.sequence import Sequence, load
from benchmarks.flicker.temporal import LENGTH, Layers, accumulate
from benchmarks.peers import oidn
from benchmarks.render.sequences import SCALE
from benchmarks.results import Row
from oiio_msspl import Render, Session, find_model, fuse, shipped_models
from oiio_msspl.arrays import Array
from oiio_msspl.colour import srgb
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.exr.atomic import check_target

CAMERAS = ("static", "moving")

Method = Callable[[Render, Render, Render], Array]
"""From the LRHS, the HRLS and the full-resolution render with the same samples to a linear picture (h, w, 3)."""


def methods(sessions: list[Session]) -> dict[str, Method]:
    """OIDN and the models, by name."""

    def fused_by(session: Session) -> Method:
        return lambda lr, hr, full: fuse(lr, hr, session).rgb

    peers: dict[str, Method] = {
        OIDN_FULL: lambda lr, hr, full: oidn(full),
        "OIDN on the HRLS": lambda lr, hr, full: oidn(hr),
    }
    return peers | {session.contract.name: fused_by(session) for session in sessions}


def run(sequence: Sequence, sessions: list[Session]) -> Pictures:
    """The pictures of every method, without and with accumulation."""
    low_motion = [motion.reduced(SCALE) for motion in sequence.hr_motion]
    inputs = (sequence.lr, sequence.hr, sequence.full)
    motions = (low_motion, sequence.hr_motion, sequence.full_motion)
    accumulated = [accumulate(frames, motion) for frames, motion in zip(inputs, motions, strict=True)]

    def pictures(method: Method, layers: Iterable[list[Layers]]) -> list[Array]:
        return [method(*(Render.from_arrays(**render) for render in frame)) for frame in zip(*layers, strict=True)]

    found: Pictures = {}
    for name, method in methods(sessions).items():
        outputs = pictures(method, inputs)
        motion = sequence.full_motion if name == OIDN_FULL else sequence.hr_motion
        smooth = [frame["rgb"] for frame in accumulate([{"rgb": output} for output in outputs], motion)]
        found[name, NOTHING] = srgb(np.stack(outputs))
        found[name, OUTPUTS] = srgb(np.stack(smooth))
        found[name, INPUTS] = srgb(np.stack(pictures(method, accumulated)))
    return found


def measure(sequence: Sequence, pictures: Pictures) -> list[Row]:
    """A row for each result. The columns ``late_...`` leave out the frames in which an accumulation fills."""
    rows = []
    for (method, accumulated), images in pictures.items():
        start = LENGTH - 1 if len(images) > LENGTH else 0
        truth = sequence.truth[0][start:], sequence.truth[1][start:]
        late = flicker(images[start:], truth)
        by_frame = [psnr(image, halves) for image, *halves in zip(images, *sequence.truth, strict=True)]
        row: Row = {"scene": sequence.scene, "camera": sequence.camera, "method": method, "accumulated": accumulated}
        row |= flicker(images, sequence.truth)
        row |= {"psnr": float(np.mean(by_frame)), "psnr_worst": min(by_frame)}
        row |= {f"late_{name}": late[name] for name in ("rms", "rms_blotches")}
        rows.append(row | {"late_psnr": psnr(images[start:], truth)})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the sequences")
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; default: all x4")
    parser.add_argument("--picture", type=Path, help="draw a PNG: an image row over time, deviation over time")
    results.add_option(parser)
    args = parser.parse_args()
    try:
        run_all(args)
    except MssplError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def run_all(args: argparse.Namespace) -> None:
    """Measure all sequences of a folder.

    Raises:
        InputError: there are none, or the picture can't be written.
    """
    if args.picture:
        check_target(args.picture, overwrite=True)
    folders = [folder for camera in CAMERAS for folder in sorted(args.folder.glob(f"*/{camera}"))]
    if not folders:
        raise InputError(f"{args.folder}: holds no sequences; make them with python -m benchmarks.render.sequences")
    # More threads only wait for each other: the pictures are small.
    sessions = [Session(find_model(SCALE, name), threads=1) for name in args.model or shipped_models()]
    sessions = [session for session in sessions if args.model or session.contract.scale == SCALE]
    shown = []
    for folder in sorted(folders, key=lambda folder: folder.parent):
        sequence = load(folder)
        shown.append((sequence, run(sequence, sessions)))
    rows = [row for sequence, pictures in shown for row in measure(sequence, pictures)]
    print(layout(rows))
    if args.table:
        results.write(args.table, rows)
    if args.picture:
        draw(args.picture, shown)


if __name__ == "__main__":
    sys.exit(main())
