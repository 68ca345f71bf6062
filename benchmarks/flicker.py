# SPDX-License-Identifier: Apache-2.0
"""Flicker of sequences that are fused frame by frame, against OIDN's and against the reference.

    python -m benchmarks.flicker render SEQUENCES --scenes ../shared/scenes
    python -m benchmarks.flicker measure SEQUENCES --json results/flicker.json --picture docs/images/flicker.png

`render` (benchmarks.flicker_render) makes the sequences with Mitsuba 3, `measure` prints the tables. Flicker is what
changes from frame to frame beyond what changes in the reference: the mean of |(O[t+1] - O[t]) - (R[t+1] - R[t])| and
its root mean square, in 8-bit levels of sRGB; also of the picture blurred by a Gaussian of 8 pixels (blotches), and of
what the blur takes away. The reference comes in two halves of independent noise, and a square is the product of the
differences to each: so its noise cancels out, of PSNR too. From the mean absolute value it does not, which is therefore
given for a static camera alone: there the reference does not change.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from benchmarks.flicker_render import SCALE, SCENES, render_sequences
from benchmarks.quality import oidn
from benchmarks.scenes import beauty
from benchmarks.temporal import LENGTH, Layers, Motion, accumulate
from oiio_msspl import Render, Session, find_model, fuse, open_exr, resolve, shipped_models
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.output import check_target, replacing
from oiio_msspl.render import Array
from oiio_msspl.transforms import srgb

#: Standard deviation of the Gaussian that parts blotches from grain, in pixels.
BLUR = 8.0
CAMERAS = ("static", "moving")
#: By how much the picture enlarges deviations.
GAIN = 4
OIDN_HRLS, OIDN_FULL = "OIDN on the HRLS", "OIDN, same samples"
#: How frames know of each other: not at all, by outputs that are accumulated, by inputs that are.
FRAME_BY_FRAME, OUTPUTS, INPUTS = "frame by frame", "outputs accumulated", "inputs accumulated"
MARKS = "<!-- benchmarks.flicker: tables -->", "<!-- end -->"

Method = Callable[[Render, Render, Render], Array]
"""From the LRHS, the HRLS and the full-resolution render of the same samples to a picture, scene linear (h, w, 3)."""


@dataclass(frozen=True)
class Sequence:
    """The renders of one scene and camera."""

    scene: str
    camera: str
    lr: list[Layers]
    hr: list[Layers]
    full: list[Layers]
    hr_motion: list[Motion]
    full_motion: list[Motion]
    truth: tuple[Array, Array]
    """Two halves of the reference, sRGB (frames, h, w, 3)."""


def flicker(images: Array, truth: tuple[Array, Array]) -> dict[str, float]:
    """Change from frame to frame beyond the reference's.

    Args:
        images: (frames, h, w, 3), display values.
        truth: two references of independent noise, likewise; the same twice if they have none.

    Returns:
        ``mean_abs``, ``rms``, and ``rms_low`` and ``rms_rest`` of the blurred picture and what the blur takes away.
    """
    first, second = (np.diff(images - t, axis=0) for t in truth)
    first_low, second_low = blur(first), blur(second)
    return {
        "mean_abs": float(np.abs((first + second) / 2).mean()),
        "rms": _root(first, second),
        "rms_low": _root(first_low, second_low),
        "rms_rest": _root(first - first_low, second - second_low),
    }


def psnr(image: Array, truth: tuple[Array, Array]) -> float:
    """In dB, of display values, against two references of independent noise."""
    error = _root(image - truth[0], image - truth[1])
    return math.inf if error == 0 else -20 * math.log10(error)


def _root(first: Array, second: Array) -> float:
    """Root of the mean product: of two measurements of the same, it leaves out what only one of them saw."""
    return math.sqrt(max(float(np.mean(first.astype(np.float64) * second)), 0.0))


def blur(images: Array) -> Array:
    """(frames, h, w, c) under a Gaussian of `BLUR` pixels; weights beyond the border count for nothing."""
    kernels = []
    for size in images.shape[1:3]:
        position = np.arange(size, dtype=np.float32)
        kernel = np.exp(-0.5 * np.square((position[:, None] - position) / BLUR))
        kernels.append(kernel / kernel.sum(axis=1, keepdims=True))
    return np.einsum("yj,xk,tjkc->tyxc", *kernels, images, optimize=True)


def load(folder: Path) -> Sequence:
    """Raises InputError where files are missing."""
    paths = {kind: sorted(folder.glob(f"{kind}.*.exr")) for kind in ("lr", "hr", "full", "ref_a", "ref_b")}
    count, references = len(paths["hr"]), 1 if folder.name == "static" else len(paths["hr"])
    if count < 2 or [len(files) for files in paths.values()] != [count] * 3 + [references] * 2:
        raise InputError(f"{folder}: the sequence is not complete; render again to make what is missing")

    def layers(kind: str) -> list[Layers]:
        return [resolve(open_exr(path)).load().layers for path in paths[kind]]

    first, second = (srgb(np.stack([beauty(resolve(open_exr(p))) for p in paths[kind]])) for kind in ("ref_a", "ref_b"))
    shape = (count, *first.shape[1:])
    return Sequence(
        folder.parent.name,
        folder.name,
        layers("lr"),
        layers("hr"),
        layers("full"),
        [read_motion(path) for path in paths["hr"]],
        [read_motion(path) for path in paths["full"]],
        (np.broadcast_to(first, shape), np.broadcast_to(second, shape)),
    )


def read_motion(path: Path) -> Motion:
    image = oiio.ImageBuf(str(path))
    names = [image.spec().channelnames.index(name) for name in ("motion.X", "motion.Y", "dd.T")]
    values = np.asarray(image.get_pixels(oiio.FLOAT))[..., names]
    return Motion(values[..., :2], values[..., 2])


def methods(sessions: list[Session]) -> dict[str, Method]:
    """OIDN, if pyoidn is installed, and the models, by name."""

    def fused_by(session: Session) -> Method:
        return lambda lr, hr, full: fuse(lr, hr, session).rgb

    ours = {session.contract.name: fused_by(session) for session in sessions}
    try:
        import pyoidn  # noqa: F401
    except ImportError:
        return ours
    peers: dict[str, Method] = {OIDN_FULL: lambda lr, hr, full: oidn(full), OIDN_HRLS: lambda lr, hr, full: oidn(hr)}
    return peers | ours


def run(sequence: Sequence, sessions: list[Session]) -> dict[tuple[str, str], Array]:
    """(method, how) -> sRGB pictures (frames, h, w, 3)."""
    low_motion = [motion.reduced(SCALE) for motion in sequence.hr_motion]
    inputs = (sequence.lr, sequence.hr, sequence.full)
    motions = (low_motion, sequence.hr_motion, sequence.full_motion)
    accumulated = [accumulate(frames, motion) for frames, motion in zip(inputs, motions, strict=True)]

    def pictures(method: Method, layers: Iterable[list[Layers]]) -> list[Array]:
        return [method(*(Render.from_arrays(**render) for render in frame)) for frame in zip(*layers, strict=True)]

    results = {}
    for name, method in methods(sessions).items():
        outputs = pictures(method, inputs)
        motion = sequence.full_motion if name == OIDN_FULL else sequence.hr_motion
        smooth = [frame["rgb"] for frame in accumulate([{"rgb": output} for output in outputs], motion)]
        results[name, FRAME_BY_FRAME] = srgb(np.stack(outputs))
        results[name, OUTPUTS] = srgb(np.stack(smooth))
        results[name, INPUTS] = srgb(np.stack(pictures(method, accumulated)))
    return results


def measure(sequence: Sequence, results: dict[tuple[str, str], Array]) -> list[dict[str, Any]]:
    """One row a method and way; ``settled`` leaves out the frames in which an accumulation fills."""
    rows = []
    for (method, how), images in results.items():
        start = LENGTH - 1 if len(images) > LENGTH else 0
        late = tuple(t[start:] for t in sequence.truth)
        rows.append(
            {
                "scene": sequence.scene,
                "camera": sequence.camera,
                "method": method,
                "how": how,
                **flicker(images, sequence.truth),
                "psnr": [psnr(image, truth) for image, *truth in zip(images, *sequence.truth, strict=True)],
                "settled": flicker(images[start:], late) | {"psnr": psnr(images[start:], late)},
            }
        )
    return rows


def tables(rows: list[dict[str, Any]]) -> str:
    """Markdown: flicker frame by frame, and what accumulation makes of it."""

    def levels(value: float) -> str:
        return f"{255 * value:.2f}"

    def of_oidn(row: dict[str, Any], measure: str) -> str:
        for other in rows:
            same = all(other[key] == row[key] for key in ("scene", "camera", "how"))
            if same and other["method"] == OIDN_FULL and other[measure] > 0:
                return f"{row[measure] / other[measure]:.2f}"
        return "-"

    lines = [
        "| scene | camera | method | mean abs. | RMS | of OIDN's | blurred | of OIDN's | rest | PSNR | worst frame |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row["how"] == FRAME_BY_FRAME:
            cells = [
                levels(row["mean_abs"]) if row["camera"] == "static" else "-",
                levels(row["rms"]),
                of_oidn(row, "rms"),
                levels(row["rms_low"]),
                of_oidn(row, "rms_low"),
                levels(row["rms_rest"]),
                f"{np.mean(row['psnr']):.2f}",
                f"{min(row['psnr']):.2f}",
            ]
            lines.append("| " + " | ".join([row["scene"], row["camera"], row["method"], *cells]) + " |")
    ways = (FRAME_BY_FRAME, OUTPUTS, INPUTS)
    lines += [
        "",
        f"Accumulated over {LENGTH} frames (flicker: RMS and blurred; PSNR; of the frames from the fifth on):",
        "",
        "| scene | camera | method | " + " | ".join(ways) + " |",
        "|---|---|---|---|---|---|",
    ]
    for key in dict.fromkeys((row["scene"], row["camera"], row["method"]) for row in rows):
        cells = []
        for how in ways:
            (row,) = (r["settled"] for r in rows if (r["scene"], r["camera"], r["method"], r["how"]) == (*key, how))
            cells.append(f"{levels(row['rms'])}, {levels(row['rms_low'])}, {row['psnr']:.2f} dB")
        lines.append("| " + " | ".join([*key, *cells]) + " |")
    return "\n".join(lines)


def around_marks(path: Path) -> tuple[str, str]:
    """What stands before and after `MARKS` in a file, marks included.

    Raises:
        InputError: it has none, or can't be written.
    """
    start, end = MARKS
    whole = check_target(path, overwrite=True).read_text()
    before, found, rest = whole.partition(start)
    _, ended, after = rest.partition(end)
    if not found or not ended:
        raise InputError(f"{path}: has no lines {start} and {end} to put the tables between")
    return before + found, ended + after


def draw(path: Path, shown: list[tuple[Sequence, dict[tuple[str, str], Array]]]) -> None:
    """A PNG: one image row over time, and how far a static camera's pixels deviate over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    names = [name for name, how in shown[0][1] if how == FRAME_BY_FRAME]
    heights = [h for sequence, _ in shown for h in ((1, 2) if sequence.camera == "static" else (1,))]
    figure = plt.figure(figsize=(2.7 * (len(names) + 1), sum(heights)), layout="constrained")
    grid = figure.subplots(len(heights), len(names) + 1, height_ratios=heights, squeeze=False)
    for axis, name in zip(grid[0], ("reference", *names), strict=True):
        axis.set_title(name)
    lines = iter(grid)
    for sequence, results in shown:
        truth = (sequence.truth[0] + sequence.truth[1]) / 2
        row = truth.shape[1] // 2
        line = next(lines)
        line[0].set_ylabel(f"{sequence.scene}\n{sequence.camera}" + f", x{GAIN}" * (sequence.camera == "static"))
        for axis, values in zip(line, (truth, *(results[name, FRAME_BY_FRAME] for name in names)), strict=True):
            over_time = values[:, row]
            if sequence.camera == "static":
                over_time = 0.5 + GAIN * (over_time - over_time.mean(axis=0))
            axis.imshow(np.clip(over_time, 0, 1), aspect="auto", interpolation="nearest")
        if sequence.camera == "static":
            line = next(lines)
            line[0].set_ylabel("deviation\nover time")
            line[0].imshow(truth[0])
            line[0].axhline(row, color="red", linewidth=0.8)
            deviations = [255 * results[name, FRAME_BY_FRAME].std(axis=0).mean(axis=-1) for name in names]
            top = float(np.percentile(deviations, 99))
            for axis, deviation in zip(line[1:], deviations, strict=True):
                drawn = axis.imshow(deviation, vmin=0, vmax=top, cmap="inferno")
            figure.colorbar(drawn, ax=line[-1], label="8-bit levels")
    for axis in grid.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    rendered = io.BytesIO()
    figure.savefig(rendered, dpi=75)
    with replacing(path, overwrite=True) as temporary:
        Image.open(rendered).convert("RGB").quantize(128).save(temporary)  # a palette: a third of the size


def run_measure(args: argparse.Namespace) -> None:
    around = around_marks(args.markdown) if args.markdown else None
    if args.picture:
        check_target(args.picture, overwrite=True)
    # One thread: threads that wait for each other in so small pictures crawl on a machine with other work.
    sessions = [Session(find_model(SCALE, name), threads=1) for name in args.model or shipped_models()]
    sessions = [session for session in sessions if args.model or session.contract.scale == SCALE]
    folders = [folder for camera in CAMERAS for folder in sorted(args.folder.glob(f"*/{camera}"))]
    if not folders:
        raise InputError(f"{args.folder}: holds no sequences; make them with python -m benchmarks.flicker render")
    shown = []
    for folder in sorted(folders, key=lambda folder: folder.parent):
        sequence = load(folder)
        shown.append((sequence, run(sequence, sessions)))
    rows = [row for sequence, results in shown for row in measure(sequence, results)]
    text = tables(rows)
    print(text)
    if around:
        with replacing(args.markdown, overwrite=True) as temporary:
            temporary.write_text("\n".join((around[0], text, around[1])))
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        models = {session.contract.name: session.contract.provenance for session in sessions}
        args.json.write_text(json.dumps({"models": models, "rows": rows}, indent=1))
    if args.picture:
        draw(args.picture, shown)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    render = commands.add_parser("render", help="make the sequences; files that exist are kept")
    render.add_argument("folder", type=Path)
    render.add_argument("--scenes", type=Path, required=True, help="folder with one folder a scene, scene.xml in it")
    render.add_argument("--scene", action="append", default=[], help=f"{', '.join(SCENES)}; both if none")
    measured = commands.add_parser("measure", help="fuse, denoise and compare")
    measured.add_argument("folder", type=Path)
    measured.add_argument(
        "--model", action="append", default=[], help="a shipped model or an ONNX file; all of x4 if none"
    )
    measured.add_argument("--json", type=Path, help="write what was measured")
    measured.add_argument("--picture", type=Path, help="write a PNG: an image row over time, deviation over time")
    measured.add_argument("--markdown", type=Path, help=f"put the tables into this file, after {MARKS[0]}")
    args = parser.parse_args()
    try:
        if args.command == "render":
            render_sequences(args.folder, args.scenes, args.scene or list(SCENES))
        else:
            run_measure(args)
    except MssplError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
