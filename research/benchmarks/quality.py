# SPDX-License-Identifier: Apache-2.0
"""Accuracy on the development scenes, for every method at equal average samples.

    python -m research.benchmarks.quality RENDERS --flip --table research/benchmarks/results/quality.csv
    python -m research.benchmarks.quality VIEWS --flip --table research/benchmarks/results/quality_cycles.csv
    python -m research.benchmarks.quality RENDERS --flip --methods '*prefiltered*' --table
    research/benchmarks/results/quality.csv

:mod:`research.benchmarks.scenes` says what the folders hold. A frame has 2, 4 or 8 spp on average: spp_LRHS / s^2 +
spp_HRLS.

Methods that get an LRHS and an HRLS, each with half of the samples as in the paper:

- the models of this project, by name. "joint-x2, 3:1" has three quarters of the samples in the HRLS.
  "joint-x2, nearest" has the paper's LRHS, which keeps one of s x s pixels; a renderer averages them.
- "OIDN on both x2": OIDN on the HRLS, with the local means of OIDN on the LRHS.
- "OIDN on both x2, together": the same with the local means of :func:`research.benchmarks.peers.oidn_on_average`. "OIDN
  prefiltered on both x2, together" has prefiltered OIDN on the HRLS.

Methods that get one render: "HRLS", "LRHS x2 bicubic", "OIDN on the HRLS" (half of the samples), "full resolution" and
"OIDN, same samples" (all samples at full resolution). "OIDN fast" has the quality "fast". "OIDN prefiltered" is
:func:`research.benchmarks.oidn.denoise_prefiltered`; "with base guides" has OIDN's base networks for albedo and
normal, which saves a third of its time. "OIDN prefiltered and split" is that on every second pixel
(:mod:`research.benchmarks.every_second_pixel`). All others are OIDN's plain call with the quality "high".
"""

from __future__ import annotations

import argparse
import fnmatch
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.compare import scores, upsample_bicubic
from oiio_msspl.exr.render import ReadableRender
from oiio_msspl.image.arrays import Array
from oiio_msspl.image.colour import srgb
from oiio_msspl.model.catalogue import load_model, shipped_models
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.session import Session
from research.benchmarks import results, scenes
from research.benchmarks.peers import match_local_means, oidn, oidn_on_average, oidn_prefiltered, oidn_split
from research.benchmarks.results import MEAN, Row
from research.benchmarks.scenes import NOISY_REFERENCE, beauty

#: Average spp. The HRLS and the LRHS have half of it each, as in the paper's tables.
AVERAGES = (2, 4, 8)
#: Other divisions of the samples, HRLS : LRHS. They are measured where they give whole numbers.
UNEVEN = ((3, 1), (7, 1))
#: Column -> its title and its format.
MEASURES = {
    "psnr": ("PSNR (sRGB, dB)", "{:.2f}"),
    "relmse": ("RelMSE (0.5, 0.01)", "{:.4f}"),
    "relmse_gharbi": ("RelMSE (1, 1e-4)", "{:.3f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "flip": ("FLIP", "{:.4f}"),
}
#: Columns that tell the rows apart.
KEYS = ("scene", "spp", "method")


def methods(scene: scenes.Scene, sessions: Sequence[Session], spp: int) -> Iterator[tuple[str, Callable[[], Array]]]:
    """Every method's name, and a function that computes its picture (h, w, 3) for this scene and average spp."""
    height, width = scene.reference.shape[:2]
    hr, full = scene.hrls(spp // 2), scene.hrls(spp)

    def fused(session: Session, lr: ReadableRender, hr: ReadableRender) -> Array:
        return fuse(lr, hr, session).rgb

    denoised = functools.cache(lambda: oidn(hr))
    yield "HRLS", lambda: beauty(hr)
    yield "OIDN on the HRLS", denoised
    yield "OIDN fast on the HRLS", lambda: oidn(hr, "fast")
    prefiltered = functools.cache(lambda: oidn_prefiltered(hr))
    yield "OIDN prefiltered on the HRLS", prefiltered
    yield "OIDN prefiltered with base guides on the HRLS", lambda: oidn_prefiltered(hr, "balanced")
    yield "full resolution", lambda: beauty(full)
    yield "OIDN, same samples", lambda: oidn(full)
    yield "OIDN prefiltered, same samples", lambda: oidn_prefiltered(full)
    yield "OIDN prefiltered with base guides, same samples", lambda: oidn_prefiltered(full, "balanced")
    yield "OIDN prefiltered and split, same samples", lambda: oidn_split(full)
    for scale in SCALES:
        lr, nearest = scene.lrhs(scale, spp // 2), scene.nearest(scale, spp // 2)
        denoised_low = functools.cache(functools.partial(oidn, lr))
        yield f"LRHS x{scale} nearest", lambda lr=lr, s=scale: beauty(lr).repeat(s, 0).repeat(s, 1)
        yield f"LRHS x{scale} bicubic", lambda lr=lr: upsample_bicubic(beauty(lr), width, height)
        yield (
            f"OIDN on the LRHS x{scale}, bicubic",
            lambda low=denoised_low: upsample_bicubic(low(), width, height),
        )
        yield f"OIDN on both x{scale}", lambda low=denoised_low: match_local_means(denoised(), low())
        average = functools.cache(functools.partial(oidn_on_average, lr, hr))
        for call, picture in (("OIDN", denoised), ("OIDN prefiltered", prefiltered)):
            yield (
                f"{call} on both x{scale}, together",
                lambda average=average, picture=picture: match_local_means(picture(), average()),
            )
        for session in sessions:
            if session.contract.scale == scale:
                name = session.name
                yield name, functools.partial(fused, session, lr, hr)
                if nearest is not None:
                    yield f"{name}, nearest", functools.partial(fused, session, nearest, hr)
    for more, less in UNEVEN:
        share, rest = divmod(spp, more + less)
        if rest or not scene.has(share * more):
            continue
        hr_more, division = scene.hrls(share * more), f"{more}:{less}"
        yield f"OIDN on the HRLS, {division}", functools.partial(oidn, hr_more)
        yield f"OIDN prefiltered on the HRLS, {division}", functools.partial(oidn_prefiltered, hr_more)
        for session in sessions:
            lr = scene.lrhs(session.contract.scale, share * less)
            yield f"{session.name}, {division}", functools.partial(fused, session, lr, hr_more)


def load_models(names: Sequence[str], pattern: str) -> list[Session]:
    """Sessions of the models for which :func:`methods` has a name that matches the pattern."""
    endings = ("", ", nearest", *(f", {more}:{less}" for more, less in UNEVEN))
    sessions = [load_model(0, name) for name in names]
    return [
        session
        for session in sessions
        if any(fnmatch.fnmatchcase(session.name + ending, pattern) for ending in endings)
    ]


def measure(scene: scenes.Scene, sessions: Sequence[Session], *, flip: bool = False, pattern: str = "*") -> list[Row]:
    """A row for each average spp and each method whose name matches the pattern."""
    rows = []
    for spp in AVERAGES:
        for method, picture in methods(scene, sessions, spp):
            if fnmatch.fnmatchcase(method, pattern):
                image = picture()
                row: Row = {"scene": scene.name, "spp": spp, "method": method, **scores(image, scene.reference)}
                rows.append(row | ({"flip": mean_flip(image, scene.reference)} if flip else {}))
    return rows


def mean_flip(image: Array, reference: Array) -> float:
    """Mean FLIP of two sRGB pictures, seen at 67 pixels per degree."""
    import flip_evaluator

    return float(flip_evaluator.evaluate(srgb(reference), srgb(image), "LDR", applyMagma=False)[1])


def with_means(rows: list[Row]) -> list[Row]:
    """One row for each scene, average spp and method, and means over all scenes whose reference is clean.

    A scene with several views counts once. A method that was not measured on all of these scenes gets no mean.
    """
    views: dict[tuple[int, str, str], list[Row]] = {}
    for row in rows:
        views.setdefault((row["spp"], row["method"], row["scene"]), []).append(row)
    of_scenes = [_mean(members, members[0]["scene"]) for members in views.values()]
    clean = {row["scene"] for row in rows} - NOISY_REFERENCE
    by_method: dict[tuple[int, str], list[Row]] = {}
    for row in of_scenes:
        if row["scene"] in clean:
            by_method.setdefault((row["spp"], row["method"]), []).append(row)
    return [_mean(members, MEAN) for members in by_method.values() if len(members) == len(clean)] + of_scenes


def _mean(rows: Sequence[Row], scene: str) -> Row:
    measured = {measure: float(np.mean([row[measure] for row in rows])) for measure in MEASURES if measure in rows[0]}
    return {"scene": scene, "spp": rows[0]["spp"], "method": rows[0]["method"], **measured}


def layout(rows: Sequence[Row]) -> str:
    """For each average spp a table of PSNR and RelMSE by scene, and one of the means of all measures."""
    names = list(dict.fromkeys(row["scene"] for row in rows if row["scene"] != MEAN))
    found = results.index(rows, *KEYS)
    shown = {measure: title for measure, (title, _) in MEASURES.items() if measure in rows[0]}
    text = mean_note(rows) + "\n"
    for spp in dict.fromkeys(row["spp"] for row in rows):
        listed = list(dict.fromkeys(row["method"] for row in rows if row["spp"] == spp))
        text += f"\n### PSNR and RelMSE at {spp} spp on average\n\n"
        body = [
            [method, *(cell(found.get((name, spp, method)), "psnr", "relmse") for name in (MEAN, *names))]
            for method in listed
        ]
        text += results.markdown(["PSNR / RelMSE", MEAN, *names], body)
        text += f"\n### All measures at {spp} spp on average, means\n\n"
        body = [[method, *(cell(found.get((MEAN, spp, method)), m) for m in shown)] for method in listed]
        text += results.markdown(["", *shown.values()], body)
    return text


def mean_note(rows: Sequence[Row]) -> str:
    """A sentence that says what the means are over."""
    names = list(dict.fromkeys(row["scene"] for row in rows if row["scene"] != MEAN))
    clean = [name for name in names if name not in NOISY_REFERENCE]
    left_out = [name for name in names if name in NOISY_REFERENCE]
    note = f"Means are over {len(clean)} scenes: {', '.join(clean)}."
    return note + f" Left out, because the reference is noisy: {', '.join(left_out)}." * bool(left_out)


def cell(row: Row | None, *measures: str) -> str:
    """Some measures of a row; empty if there is none."""
    return " / ".join(_digits(measure, row[measure]) for measure in measures) if row else ""


def _digits(measure: str, value: float) -> str:
    """A value as text, with no more than the four digits that the table has."""
    return f"{value:.4g}" if "relmse" in measure and value >= 1 else MEASURES[measure][1].format(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="renders or views")
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; default: all")
    parser.add_argument("--methods", metavar="PATTERN", help="measure only these; --table then keeps its other rows")
    parser.add_argument("--flip", action="store_true", help="also measure FLIP, which takes most of the time")
    results.add_option(parser)
    args = parser.parse_args()
    pattern = args.methods or "*"
    sessions = load_models(args.model or list(shipped_models()), pattern)
    rows = [
        row for scene in scenes.load(args.folder) for row in measure(scene, sessions, flip=args.flip, pattern=pattern)
    ]
    if not rows:
        parser.error(f"no method matches {args.methods}")
    rows = with_means(rows)
    print(layout(rows))
    if args.table and args.methods:
        results.merge(args.table, rows, KEYS)
    elif args.table:
        results.write(args.table, rows)


if __name__ == "__main__":
    main()
