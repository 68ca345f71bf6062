# SPDX-License-Identifier: Apache-2.0
"""Everything that goes wrong on a set, put through every method.

    python -m benchmarks.stability --markdown docs/stability.md --pictures docs/images/stability
    python -m benchmarks.stability VIEWS --scale 4 --model paper-x4 --model my.onnx --json results/stability.json

Without arguments: analytic scenes, and all shipped models for x4. VIEWS adds the held-out views of a folder of rendered
views (see training/data.py). See docs/stability.md for what is measured.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import quality
from benchmarks.stability import bases, cases, measures, report
from oiio_msspl import fuse, schema
from oiio_msspl.comparison import upsample_bicubic
from oiio_msspl.output import replacing
from oiio_msspl.render import Array
from oiio_msspl.session import Session, find_model, shipped_models

#: Side of the analytic frames.
SIZE = 256

#: A pair to the result and what the tool said.
Method = Callable[[bases.Pair], tuple[Array, list[str]]]


def enlarged(pair: bases.Pair) -> tuple[Array, list[str]]:
    low = measures.repaired(pair.lr.layers[schema.RGB])
    return upsample_bicubic(low, pair.hr.data_window.width, pair.hr.data_window.height), []


def oidn(pair: bases.Pair) -> tuple[Array, list[str]]:
    image = quality.oidn(pair.hr)
    assert image is not None
    return image, []


def ours(session: Session) -> Method:
    def run(pair: bases.Pair) -> tuple[Array, list[str]]:
        fused = fuse(pair.lr, pair.hr, session)
        return fused.rgb, fused.warnings

    return run


def methods_for(scale: int, sessions: list[Session]) -> dict[str, Method]:
    made: dict[str, Method] = {report.ENLARGED: enlarged}
    made |= {session.contract.name: ours(session) for session in sessions if session.contract.scale == scale}
    try:
        import pyoidn  # noqa: F401
    except ImportError:
        return made
    return made | {"OIDN on the HRLS": oidn}


def groups_of(base: bases.Base | None, scale: int, size: int) -> Iterator[tuple[str, Iterator[cases.Case]]]:
    """(group, its cases) for a base; for the analytic ones if None."""
    for name, anywhere in cases.ANYWHERE.items():
        yield name, anywhere(base or cases.room(size), scale)
    if base is None:
        for name, made in cases.MADE.items():
            yield name, made(size, scale)


def run(
    base: bases.Base | None, scale: int, methods: dict[str, Method], size: int, gallery: report.Gallery | None = None
) -> list[dict[str, Any]]:
    """A row for each case and method: ``scale, base, group, case, method`` and what :func:`measures.measure` gives."""
    rows = []
    for group, members in groups_of(base, scale, size):
        undisturbed: dict[tuple[str, bases.Pair], Array] = {}
        for case in members:
            results: dict[str, Array] = {}
            for name, method in methods.items():
                if case.clean is not None and (name, case.clean) not in undisturbed:
                    undisturbed[name, case.clean] = method(case.clean)[0]
                results[name], warnings = method(case.pair)
                clean = undisturbed[name, case.clean] if case.clean is not None else None
                figures = measures.measure(case, results[name], clean, results[report.ENLARGED], warnings)
                key = {"scale": scale, "base": base.name if base else "analytic", "group": group, "case": case.name}
                rows.append({**key, "method": name, **figures})
            if gallery is not None:
                truth, hr = case.pair.reference, case.pair.hr.layers[schema.RGB]
                gallery.add(case.name, hr, truth, results, case.factor)
        print(f"x{scale} {base.name if base else 'analytic'}: {group}", file=sys.stderr)
        if gallery is not None:
            gallery.write_group(f"x{scale}-{report.slug(group)}")
    if gallery is not None:
        gallery.write_sheet(f"x{scale}-all")
    return rows


def judged(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, each with its ``verdict`` and ``sentence``."""
    for row in rows:
        row["verdict"], row["sentence"] = measures.verdict(row)
    return rows


def document(rows: list[dict[str, Any]], pictures: Path | None, beside: Path) -> str:
    """All tables as Markdown; pictures are linked from the folder ``beside``."""
    lines = [report.INTRODUCTION]
    for scale in dict.fromkeys(row["scale"] for row in rows):
        for analytic in (True, False):
            mine = [r for r in rows if r["scale"] == scale and (r["base"] == "analytic") == analytic]
            if not mine:
                continue
            count = len({row["base"] for row in mine})
            lines.append(f"\n## x{scale}, " + ("analytic scenes" if analytic else f"{count} rendered views") + "\n")
            table = judged(report.pooled(mine))
            lines += report.summary(table)
            if analytic and pictures is not None:
                link = Path(os.path.relpath(pictures, beside)).as_posix()
                lines.append(f"\n![Error maps of all cases]({link}/x{scale}-all.png)\n")
                names = ", ".join(dict.fromkeys(row["method"] for row in table))
                lines.append(f"*log10 RelMSE from 1e-5 (black) to 1, in each case: {names}.*")
            lines += report.tables(table)
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, nargs="?", metavar="VIEWS", help="folder of rendered views")
    parser.add_argument("--model", action="append", default=[], help="ONNX file or shipped name; repeat it for more")
    parser.add_argument(
        "--scale", type=int, action="append", choices=schema.SCALES, help="default: those of --model, or 4"
    )
    parser.add_argument("--size", type=int, default=SIZE, help="side of the analytic frames (%(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="of onnxruntime; 0: one a core")
    parser.add_argument("--json", type=Path, help="write all rows here")
    parser.add_argument("--markdown", type=Path, help="write the tables here")
    parser.add_argument("--pictures", type=Path, help="write error maps into this folder")
    args = parser.parse_args()
    files = [find_model(4, name) for name in args.model] or list(shipped_models().values())
    sessions = [Session(file, threads=args.threads) for file in files]
    scales = args.scale or (sorted({session.contract.scale for session in sessions}) if args.model else [4])
    rows = []
    for scale in scales:
        methods = methods_for(scale, sessions)
        gallery = report.Gallery(args.pictures) if args.pictures else None
        rows += run(None, scale, methods, args.size, gallery)
        for view in bases.views(args.views) if args.views else []:
            rows += run(view, scale, methods, args.size)
    rows = judged(rows)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        provenance = {s.contract.name: s.contract.provenance for s in sessions if s.contract.scale in scales}
        record = {"machine": platform.machine(), "models": provenance, "rows": rows}
        with replacing(args.json, overwrite=True) as temporary:
            temporary.write_text(json.dumps(record, indent=1, default=float))
    text = document(rows, args.pictures, args.markdown.parent if args.markdown else Path.cwd())
    if args.markdown:
        args.markdown.parent.mkdir(parents=True, exist_ok=True)
        with replacing(args.markdown, overwrite=True) as temporary:
            temporary.write_text(text)
    print(text)


if __name__ == "__main__":
    with np.errstate(all="ignore"):
        main()
