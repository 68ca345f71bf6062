# SPDX-License-Identifier: Apache-2.0
"""Lays out the table of sequences and what it shows, and draws one of them."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Sequence as Rows
from pathlib import Path

import numpy as np

from oiio_msspl.exr.atomic import replacing
from oiio_msspl.image.arrays import Array
from research.benchmarks import results
from research.benchmarks.results import Row
from research.benchmarks.shots.methods import ALONE, NEIGHBOURS, OIDN_BEST, OIDN_NEIGHBOURS, QUALITIES, SCALES
from research.benchmarks.shots.sequence import MASKS
from research.benchmarks.versus import cell, with_interval

#: In the column ``method``: the reference itself.
REFERENCE = "reference"
#: Sequences by which the method was chosen. It was not changed after a look at the others.
DEVELOPMENT = (
    "lamp/moving", "lamp/static", "staircase2/moving", "staircase2/static",
    "room/slide", "room/shadow", "room/mirror", "room/lamp_on", "room/dolly", "room/foliage",
    "room/particles", "room/turn",
)  # fmt: skip
#: Sequences whose camera moves.
MOVING_CAMERA = ("lamp/moving", "staircase2/moving", "room/mirror", "room/foliage", "room/dolly", "cycles/slide")
STATIC_CAMERA = ("lamp/static", "staircase2/static")
#: What averaging is to gain over single frames and over OIDN at its best, in dB, with a moving camera and where nothing
#: moves.
GAIN, PEER_GAIN, STATIC_GAIN = 1.3, 0.8, 2.5
#: Largest share of single frames' and OIDN's flicker, and largest loss inside a mask, in dB.
FLICKER, LOSS = 0.7, 0.1


def layout(rows: Rows[Row]) -> str:
    """What averaging gains, and all measures of all methods."""
    return f"{summary(rows)}\n{details(rows)}"


def summary(rows: Rows[Row]) -> str:
    """For each quality: gains of averaging by sequence, and in how many it reaches what is wanted."""
    measured = {row["method"] for row in rows}
    return "\n".join(
        _summary_of(rows, quality, prefix) for quality, prefix in QUALITIES.items() if prefix + NEIGHBOURS in measured
    )


def _summary_of(rows: Rows[Row], quality: str, prefix: str) -> str:
    """The same for one quality, whose methods begin with ``prefix``."""
    found = results.index(rows, "sequence", "scale", "method")
    peers = results.index((row for row in rows if row["method"] == OIDN_BEST), "sequence")
    body = []
    compared = [row for row in rows if row["method"] == prefix + NEIGHBOURS]
    for row in compared:
        alone, peer = found[row["sequence"], row["scale"], prefix + ALONE], peers[row["sequence"]]
        averaged = found.get((row["sequence"], row["scale"], OIDN_NEIGHBOURS))
        gain, over_peer = (row["psnr"] - other["psnr"] for other in (alone, peer))
        steadier = [row["flicker"] / other["flicker"] for other in (alone, peer)]
        steadier += [math.sqrt(row["ewarp"] / other["ewarp"]) for other in (alone, peer)]
        masks = {name: row[name] - alone[name] for name in MASKS if name in row}
        worst = min(masks, key=lambda name: masks[name], default="")
        missed = _missed(row["sequence"], gain, over_peer, max(steadier[:2]), masks.get(worst, 0.0))
        body.append([
            row["sequence"], _role(row["sequence"]), f"x{row['scale']}", f"{gain:+.2f}", f"{over_peer:+.2f}",
            f"{row['psnr'] - averaged['psnr']:+.2f}" if averaged else "",
            *(f"{ratio:.2f}" for ratio in steadier), f"{masks[worst]:+.2f} ({worst})" if worst else "",
            ", ".join(missed),
        ])  # fmt: skip
    head = [f"`{quality}`", "part", "scale", "gained over single frames, dB", "over OIDN prefiltered, dB"]
    head += ["over that with neighbours, dB", "flicker, of single frames'", "of OIDN's"]
    head += ["along the motion, of single frames'", "of OIDN's"]
    head += ["least gain in a mask, dB", "targets missed"]
    lines = [results.markdown(head, body)]
    means = []
    for unit, scale, fresh in itertools.product(("psnr", "jod"), SCALES, (False, True)):
        rows_of = [row for row in compared if row["scale"] == scale and unit in row]
        rows_of = [row for row in rows_of if not fresh or row["sequence"] not in DEVELOPMENT]
        if len(rows_of) < 2:
            continue
        others = [
            [found.get((row["sequence"], scale, prefix + ALONE)) for row in rows_of],
            [peers[row["sequence"]] for row in rows_of],
            [found.get((row["sequence"], scale, OIDN_NEIGHBOURS)) for row in rows_of],
        ]
        which = f"{len(rows_of)}{' fresh' if fresh else ''}"
        means.append([unit.upper(), f"x{scale}", which, *(_gain(unit, rows_of, each) for each in others)])
    head = [f"`{quality}`: mean gain", "scale", "sequences", "over single frames", "over OIDN prefiltered"]
    lines.append(results.markdown([*head, "over that with neighbours"], means))
    return "\n".join(lines) + "\n"


def _gain(unit: str, rows: Rows[Row], others: Rows[Row | None]) -> str:
    """The mean gain of rows over others with a 95 % interval, and on how many they are better; empty if one lacks."""
    gains = [row[unit] - other[unit] for row, other in zip(rows, others, strict=True) if other and unit in other]
    if len(gains) < len(rows):
        return ""
    return f"{cell(with_interval(np.array(gains)), '+.2f')}, better on {sum(gain > 0 for gain in gains)}"


def _role(sequence: str) -> str:
    return "chosen by" if sequence in DEVELOPMENT else "fresh"


def _missed(sequence: str, gain: float, over_peer: float, flicker: float, worst: float) -> list[str]:
    """Which targets a sequence misses.

    Args:
        gain, over_peer: over single frames and over OIDN at its best, in dB.
        flicker: the larger one of its shares of their flicker.
        worst: least gain in a mask, in dB.
    """
    moves = sequence in MOVING_CAMERA
    least = GAIN if moves else STATIC_GAIN if sequence in STATIC_CAMERA else 0.0
    missed = {
        "single frames": gain < least,
        "OIDN": moves and over_peer < PEER_GAIN,
        "flicker": moves and flicker > FLICKER,
        "mask": worst < -LOSS,
    }
    return [name for name, is_missed in missed.items() if is_missed]


def details(rows: Rows[Row]) -> str:
    """All measures of all methods."""
    body = [
        [
            row["sequence"],
            f"x{row['scale']}" if row["scale"] > 1 else "",
            row["method"],
            *(f"{row[name]:.2f}" if name in row else "" for name in ("psnr", "worst")),
            _figures(row.get("relmse")),
            *(f"{255 * row[name]:.2f}" if name in row else "" for name in ("flicker", "blotches")),
            *(f"{row[name]:.2f}" if name in row else "" for name in ("tpsnr", "jod")),
            _figures(row["ewarp"]),
            *(f"{row[name]:.2f}" if name in row else "" for name in MASKS),
        ]
        for row in rows
    ]
    head = ["sequence", "scale", "method", "PSNR", "worst frame", "RelMSE", "flicker", "blotches", "tPSNR", "JOD"]
    return results.markdown([*head, "E_warp", *MASKS], body)


def _figures(value: float | None) -> str:
    """A small number with three significant digits, without an exponent."""
    return "" if value is None else np.format_float_positional(value, precision=3, fractional=False, trim="-")


def strip(path: Path, shown: dict[str, Array], frames: list[int], crop: tuple[slice, slice], row: int) -> None:
    """Write a PNG: a detail of some frames, and below it an image row over time.

    Args:
        shown: title -> sRGB (frames, h, w, 3).
        frames: indices of the frames.
        crop: rows and columns of the detail.
        row: the image row.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    height = (crop[0].stop - crop[0].start) / (crop[1].stop - crop[1].start)
    ratios = [height] * len(frames) + [0.3]
    width = 2.2
    size = (width * len(shown), width * (sum(ratios) + 0.35))
    figure, grid = plt.subplots(len(ratios), len(shown), figsize=size, height_ratios=ratios, layout="constrained")
    for column, (title, images) in zip(grid.T, shown.items(), strict=True):
        column[0].set_title(title, fontsize=9)
        for axis, frame in zip(column, frames, strict=False):
            axis.imshow(np.clip(images[frame][crop], 0, 1), interpolation="nearest", aspect="auto")
        column[-1].imshow(np.clip(images[:, row, crop[1]], 0, 1), interpolation="nearest", aspect="auto")
    labels = [*(f"frame {frame + 1}" for frame in frames), "row, over time"]
    for axis, label in zip(grid[:, 0], labels, strict=True):
        axis.set_ylabel(label, fontsize=8)
    for axis in grid.flat:
        axis.set(xticks=[], yticks=[])
    rendered = io.BytesIO()
    figure.savefig(rendered, dpi=100)
    with replacing(path, overwrite=True) as temporary:
        Image.open(rendered).convert("RGB").quantize(96).save(temporary)  # a palette needs a third of the bytes


def film(path: Path, shown: dict[str, Array], crop: tuple[slice, slice]) -> None:
    """Write an animated WebP of details side by side, which plays forwards and backwards."""
    from PIL import Image, ImageDraw

    wide = [np.clip(images[(slice(None), *crop)], 0, 1) for images in shown.values()]
    frames = []
    for t in [*range(len(wide[0])), *range(len(wide[0]) - 2, 0, -1)]:
        joined = np.concatenate([np.pad(each[t], [(12, 0), (0, 2), (0, 0)]) for each in wide], axis=1)
        picture = Image.fromarray((joined * 255 + 0.5).astype(np.uint8))
        for i, title in enumerate(shown):
            ImageDraw.Draw(picture).text((i * (wide[0].shape[2] + 2) + 3, 0), title, fill="white")
        frames.append(picture)
    with replacing(path, overwrite=True) as temporary:
        frames[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=120,
            loop=0,
            quality=80,
            method=6,
        )
