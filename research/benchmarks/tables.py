# SPDX-License-Identifier: Apache-2.0
"""Put the tables of results into the pages.

    python -m research.benchmarks.tables
    python -m research.benchmarks.tables --check

In the pages of `TABLES`, everything between ``<!-- begin: NAME -->`` and ``<!-- end -->`` is replaced by the table of
that name, with a line that says what its rows were measured with. The text around it stays. The table that
``msspl models`` prints is written, too. ``--check`` writes nothing and fails if a page is out of date.
"""

from __future__ import annotations

import argparse
import itertools
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from oiio_msspl.model.catalogue import MEASURED, shipped_models
from oiio_msspl.model.contract import ONE_SIZE, SPREAD
from research.benchmarks import detail, passes, results, runtime
from research.benchmarks.layout import Column, Line, Table, clean
from research.benchmarks.one_size import SEEDS
from research.benchmarks.results import MEAN, Row
from research.benchmarks.runtime import SAME_WORK
from research.benchmarks.scenes import NOISY_REFERENCE
from research.benchmarks.shots import methods as shots

ROOT = Path(__file__).parents[2]


FAST, BALANCED, BEST = "joint-small-x2", "joint-x2", "joint-large-x2"
ON_HRLS, SAME_SAMPLES = "OIDN prefiltered on the HRLS", "OIDN prefiltered, same samples"
JOINED = "OIDN prefiltered on both x2, together"
#: OIDN at its best on each input -> which render it gets.
PLACES = {ON_HRLS: "on the HRLS", JOINED: "on both renders, joined", SAME_SAMPLES: "at full resolution, same samples"}
SETS = {
    "Mitsuba": "accuracy",
    "box": "accuracy_box",
    "Blackman-Harris": "accuracy_blackman_harris",
    "Cycles": "accuracy_cycles",
}
BY_SCENE = ("scene", "spp", "method")
#: Instructions of a processor for networks -> how a machine's name ends.
MACHINES = {"AMX": "with AMX", "VNNI": "with VNNI", "neither": "without VNNI"}
METHODS = {
    FAST: "`--quality fast`",
    BALANCED: "`--quality balanced`",
    BEST: "`--quality best`",
    ON_HRLS: "OIDN on the HRLS, prefiltered",
    JOINED: "OIDN on both renders, prefiltered, and joined",
    SAME_SAMPLES: "OIDN at full resolution, prefiltered",
    "paper-x2": "`--model paper`",
    "balanced-x1": "`--quality balanced`",
    "best-x1": "`--quality best`",
}
SCENES = (MEAN, "cornell-box", "lamp", "spaceship", "staircase2", "tire", *NOISY_REFERENCE)
#: Pixel filters, the spread ones first.
KINDS = tuple(dict.fromkeys(row["filter"] for row in results.read("filters")))
#: The larger frame of the times on a GPU.
LARGE = {"size": "1920 x 1088"}
VERDICTS = ("holds", "suffers", "fails")
#: Wrong pairs on the page, and right ones.
PAIRS = (
    "right, whole frame",
    "crop 3 % tighter",
    "normals of another scene",
    "albedo of another scene",
    "shift by 1 LRHS pixel",
    "LRHS scaled down: lanczos3",
    "exposure one stop up",
)
PAIR, ALL_SAMPLES = "LRHS and HRLS", "one render with all samples"
#: Table and method of a line of `WHEN_IT_PAYS` -> what it needs.
NEEDS = {
    ("accuracy", BALANCED): PAIR,
    ("accuracy", BEST): PAIR,
    ("one_size", "balanced-x1"): ALL_SAMPLES,
    ("one_size", "best-x1"): ALL_SAMPLES,
    ("accuracy", ON_HRLS): "HRLS",
    ("accuracy", SAME_SAMPLES): ALL_SAMPLES,
}
#: Method of the tables of accuracy -> the one whose time is measured.
TIMED = SAME_WORK | {"balanced-x1": "joint-x1", "best-x1": "joint-large-x1"}
OF_COMMAND = {"source": "time_command", "size": "1920x1080"}
WHEN_IT_PAYS = Table(
    ("accuracy", "one_size", "time_command"),
    (*BY_SCENE, "size"),
    ("method", "needs"),
    [Line([METHODS[m], needs], {"source": source, "method": m}) for (source, m), needs in NEEDS.items()],
    [
        *(
            Column(f"{title}, {spp} spp", title.lower(), {"scene": MEAN, "spp": spp})
            for title, spp in itertools.product(("PSNR", "RelMSE"), (2, 8))
        ),
        Column("seconds of the whole command, 1080p, 2 cores", "seconds", OF_COMMAND, form="{:.0f}", renamed=TIMED),
    ],
)


ACCURACY_BY_SCENE = Table(
    ("accuracy",),
    BY_SCENE,
    ("PSNR at 2 spp",),
    [Line([title], {"method": method, "spp": 2}) for method, title in METHODS.items()],
    [Column(name, "psnr", {"scene": name}) for name in SCENES],
    means=True,
)

HOW_SURE = Table(
    tuple(SETS.values()),
    BY_SCENE,
    ("gain over prefiltered OIDN",),
    [
        Line([f"{METHODS[model]}, OIDN {place}"], {"method": model, "scene": clean}, {"method": peer})
        for (peer, place), model in itertools.product(PLACES.items(), (BALANCED, BEST))
    ],
    [
        Column(f"{name}, {spp} spp: {title}", measure, {"source": SETS[name], "spp": spp}, how)
        for name, spp in (("Mitsuba", 2), ("Mitsuba", 8), ("box", 2), ("Blackman-Harris", 2), ("Cycles", 2))
        for title, measure, how in (("PSNR", "psnr", "interval"), ("RelMSE", "relmse", "ratio interval"))
    ],
)


SAMPLE_COUNTS = Table(
    ("accuracy_box",),
    BY_SCENE,
    ("PSNR, samples of the HRLS : LRHS",),
    [Line([METHODS[method]], {"method": method, "scene": MEAN}) for method in (BALANCED, BEST, ON_HRLS, SAME_SAMPLES)],
    [
        Column(
            f"{spp} spp, {share}", "psnr", {"spp": spp}, renamed={m: f"{m}, {share}" for m in METHODS if share != "1:1"}
        )
        for spp, share in ((4, "1:1"), (4, "3:1"), (8, "1:1"), (8, "3:1"), (8, "7:1"))
    ],
)

DETAIL = Table(
    ("detail",),
    detail.KEYS,
    ("case",),
    ("case",),
    [
        Column(f"{spp}: {title}", "psnr", {"spp": spp, "method": method}, form="{:.1f}")
        for spp in ("4-1", "64-16", "256-64")
        for method, title in {
            "HRLS": "HRLS",
            "OIDN prefiltered on the HRLS": "OIDN",
            f"best{detail.NETWORK_ALONE}": "`best`, network alone",
            "best": "`best`",
        }.items()
    ]
    + [
        Column(f"one render of 128 spp: {title}", "psnr", {"spp": "256-64", "method": method}, form="{:.1f}")
        for method, title in {
            detail.ONE: "render",
            f"best, {detail.ONE}": "`best`",
            f"best, {detail.ONE}{detail.WITH_VARIANCE}": "`best`, with its variance",
        }.items()
    ],
)

SPREAD_NOISE = Table(
    ("accuracy_gauss",),
    BY_SCENE,
    ("method",),
    [
        *(Line([METHODS[m]], {"method": m.replace("-x2", f"{SPREAD}-x2")}) for m in (FAST, BALANCED, BEST)),
        Line([METHODS[SAME_SAMPLES]], {"method": SAME_SAMPLES}),
        Line(["the call above on every second pixel"], {"method": "OIDN prefiltered and split, same samples"}),
    ],
    [Column(f"{spp} spp: PSNR / RelMSE", "psnr/relmse", {"scene": MEAN, "spp": spp}) for spp in (2, 8)],
    means=True,
)

FILTERS = Table(
    ("filters",),
    ("filter", "spp", "method"),
    ("PSNR at 2 spp",),
    ("method",),
    [Column(name, "psnr", {"spp": 2, "filter": name}) for name in KINDS],
)

GPU_TIMES = Table(
    ("gpu",),
    ("size", "method"),
    ("milliseconds",),
    ("method",),
    [
        Column("1024 x 1024", "ms", {"size": "1024 x 1024"}, form="{:.1f}"),
        Column("1920 x 1088", "ms", LARGE, form="{:.1f}"),
        Column("time / OIDN's", "ms", LARGE, "ratio", against={"method": "OIDN"}),
        Column("time / prefiltered OIDN's", "ms", LARGE, "ratio", against={"method": "OIDN prefiltered"}),
        Column("with copies", "with_copies_ms", LARGE, form="{:.1f}"),
    ],
)


def _alone(row: Row) -> dict[str, str]:
    return {"method": row["method"].replace(shots.NEIGHBOURS, shots.ALONE)}


def _oidn(row: Row) -> dict[str, Any]:
    return {"method": shots.OIDN_SPLIT if row["source"] == "shots_spread" else shots.OIDN_BEST, "scale": 1}


def _averaged_oidn(row: Row) -> dict[str, Any]:
    # At scale 1, an LRHS still tests the light of OIDN's frames.
    return {"method": f"{_oidn(row)['method']}, {shots.NEIGHBOURS}", "scale": max(int(row["scale"]), 2)}


def _shot_lines(source: str, title: str, scales: Sequence[int]) -> list[Line]:
    wanted = {"source": source}
    return [
        Line(
            [f"`--quality {q}`, {'one render' if scale == ONE_SIZE else f'x{scale}'}{title}"],
            wanted | {"method": prefix + shots.NEIGHBOURS, "scale": scale},
        )
        for (q, prefix), scale in itertools.product(shots.QUALITIES.items(), scales)
    ]


SHOTS = Table(
    ("shots", "shots_spread", "shots_without_vectors"),
    ("sequence", "scale", "method"),
    ("frames averaged with neighbours",),
    [
        *_shot_lines("shots", "", (ONE_SIZE, 2, 4)),
        *_shot_lines("shots_without_vectors", ", without vectors", (2,))[1:],
        *_shot_lines("shots_spread", ", spread noise", (2,)),
    ],
    [
        Column("sequences", "psnr", how="count"),
        Column("PSNR over single frames, dB", "psnr", how="interval", against=_alone),
        Column("over OIDN at its best, dB", "psnr", how="interval", against=_oidn),
        Column("over that with neighbours, dB", "psnr", how="interval", against=_averaged_oidn),
        Column("in uncovered surfaces", "disocclusion", how="difference", against=_alone),
        Column("where light changes", "light", how="difference", against=_alone),
        Column("flicker, of single frames'", "flicker", how="ratio", against=_alone),
        Column("of OIDN's", "flicker", how="ratio", against=_oidn),
        Column("of that with neighbours", "flicker", how="ratio", against=_averaged_oidn),
    ],
)

TIME_OF_SHOTS = Table(
    ("time_shots",),
    ("quality", "temporal", "machine"),
    ("machine", "frames", "quality", "`--temporal`"),
    ("machine", "frames", "quality", "temporal"),
    [
        Column("seconds a frame", "seconds/frames", how="quotient", form="{:.2f}"),
        Column("ratio", "seconds", how="ratio", against={"temporal": "off"}),
        Column("peak MB", "peak_mb", form="{:.0f}"),
    ],
)


PASSES_SUMMARY = Table(
    ("passes",),
    ("scene", "set", "spp", "method", "layer"),
    ("layers at 2 spp",),
    [Line([method], {"method": method}) for method in (passes.PEER, "msspl-x2", "msspl-x2, best")],
    [
        Column(f"{name}: {title}", measure, {"set": name, "spp": 2, "scene": MEAN, "layer": passes.ALL})
        for name in ("light groups", "components")
        for title, measure in {"PSNR / RelMSE": "psnr/relmse", "time / OIDN's": "time"}.items()
    ],
)

STABILITY = Table(
    ("stability",),
    ("scale", "group", "case", "method"),
    ("method",),
    ("family",),
    [
        column
        for scale in (2, 4)
        for column in (
            *(Column(f"x{scale}: {v}", f"verdict={v}", {"scale": scale}, "count") for v in VERDICTS),
            Column("furthest outside", "range", {"scale": scale}, "max", "x{:.3g}"),
            Column("holes", "holes", {"scale": scale}, "sum", "{:.0f}"),
            Column("stamps", "stamps", {"scale": scale}, "sum", "{:.0f}"),
        )
    ],
)

PAIR_CHECKS = Table(
    ("pair_checks",),
    ("scenes", "pairs"),
    ("pairs",),
    [Line([name], {"pairs": name}) for name in PAIRS],
    [
        column
        for name in ("chosen", "fresh")
        for column in (
            Column(f"{name}: number", "count", {"scenes": name}, form="{:.0f}"),
            Column("with a warning", "after/count", {"scenes": name}, "quotient", "{:.1%}"),
        )
    ],
)

WORST_TENTH = "the tenth of the pixels with the largest prediction"
CONFIDENCE = Table(
    ("confidence",),
    ("method",),
    ("model",),
    ("method",),
    [
        Column("predicted error, log-encoded", "predicted", form="{:.4f}"),
        Column("actual error", "actual", form="{:.4f}"),
        Column(f"share of the error in {WORST_TENTH}", "worst_tenth", form="{:.0%}"),
        Column("correlation of logarithms, 8 x 8 pixels", "correlation"),
    ],
)

#: What a method of :mod:`research.benchmarks.one_size` gets, and its title.
INPUTS = {
    "OIDN": ("one render", "OIDN"),
    "OIDN prefiltered": ("one render", "OIDN, prefiltered"),
    "balanced-x1": ("one render", "`--quality balanced`"),
    "best-x1": ("one render", "`--quality best`"),
    "balanced-x2": ("two sizes, x2", "`--quality balanced`"),
    "best-x2": ("two sizes, x2", "`--quality best`"),
    "balanced-x4": ("two sizes, x4", "`--quality balanced`"),
    "best-x4": ("two sizes, x4", "`--quality best`"),
    f"OIDN{SEEDS}": ("two seeds", "OIDN on their mean"),
    f"OIDN prefiltered{SEEDS}": ("two seeds", "OIDN on their mean, prefiltered"),
    f"balanced-x1{SEEDS}": ("two seeds", "`--quality balanced`"),
    f"best-x1{SEEDS}": ("two seeds", "`--quality best`"),
}


def _inputs_at(spp: tuple[int, int]) -> list[Column]:
    """Return the columns of some spp: that of one render or of two sizes, and the nearest one of two seeds."""
    title, where = f"{spp[0]} spp (seeds: {spp[1]})", {"spp": lambda value: value in spp}
    return [
        Column(title, "psnr", where | {"scene": MEAN}),
        Column("minus OIDN, prefiltered", "psnr", where | {"scene": clean}, "interval"),
    ]


ONE_RENDER_OR_TWO = Table(
    ("one_size",),
    BY_SCENE,
    ("input", "PSNR of"),
    [
        Line(cells, {"method": method}, {"method": "OIDN prefiltered" + (SEEDS if method.endswith(SEEDS) else "")})
        for method, cells in INPUTS.items()
    ],
    [column for spp in ((2, 3), (8, 12), (32, 48), (128, 192)) for column in _inputs_at(spp)],
)

#: The row of :mod:`research.benchmarks.ablations` that several findings need.
RGB = "both RGB, l1"
#: A finding of the paper -> rows of :mod:`research.benchmarks.ablations` from worse to better. The paper's data was
#: never published, so only the order of its values and ours can be compared.
ABLATIONS = {
    "an HRLS beats super-resolution (table 5): none, RGB": ("HRLS: none", RGB),
    "further layers of the HRLS help: RGB, all": (RGB, "HRLS: and diffuse, specular"),
    "further layers of the LRHS do not help: all, RGB": ("LRHS: and diffuse, specular", RGB),
    "on linear radiance the robust loss is better: l1, robust": (
        "l1 of linear radiance",
        "robust loss of linear radiance, beta 0.1",
    ),
    "a beta of 0.1 is best for it: 1, 0.1": ("robust loss, beta 1", "robust loss, beta 0.1"),
}


def verdict(rows: Sequence[Row]) -> str:
    """Say whether rows get better from one to the next: PSNR must rise, and RelMSE must fall."""
    agrees = [all(before["psnr"] < after["psnr"] for before, after in itertools.pairwise(rows))]
    agrees.append(all(before["relmse"] > after["relmse"] for before, after in itertools.pairwise(rows)))
    return "agrees" if all(agrees) else "PSNR and RelMSE disagree" if any(agrees) else "**differs**"


def findings() -> str:
    """Lay out what the paper finds, and whether our figures agree."""
    ablated = results.index(results.read("ablations"), "name")
    means = results.index(results.where(results.read("accuracy"), scene=MEAN), "spp", "method")
    cases = {finding: [ablated[name] for name in names] for finding, names in ABLATIONS.items()}
    cases["x4 is best at 2 spp (table 2): x2, x4"] = [means[2, "paper-x2"], means[2, "paper-x4"]]
    cases["x2 is best at 8 spp (table 2): x4, x2"] = [means[8, "paper-x4"], means[8, "paper-x2"]]
    body = []
    for finding, rows in cases.items():
        relmse = ", ".join(f"{row['relmse']:.4f}" for row in rows)
        body.append([finding, ", ".join(f"{row['psnr']:.2f}" for row in rows), relmse, verdict(rows)])
    table = results.markdown(["the paper finds", "PSNR here", "RelMSE here", "our figures"], body)
    return f"{table}\n{results.stamp_note(row for rows in cases.values() for row in rows)}\n"


Block = Table | Callable[[], str]
TABLES: dict[Path, dict[str, Block]] = {
    ROOT / "README.md": {"when_it_pays": WHEN_IT_PAYS},
    ROOT / "docs/design/results.md": {
        "accuracy_by_scene": ACCURACY_BY_SCENE,
        "one_render_or_two": ONE_RENDER_OR_TWO,
        "how_sure": HOW_SURE,
        "detail": DETAIL,
        "sample_counts": SAMPLE_COUNTS,
        "spread_noise": SPREAD_NOISE,
        "shots": SHOTS,
        "passes_summary": PASSES_SUMMARY,
        "stability": STABILITY,
        "pair_checks": PAIR_CHECKS,
    },
    ROOT / "docs/design/model.md": {"confidence": CONFIDENCE, "filters": FILTERS},
    ROOT / "docs/design/training.md": {"paper": findings},
    ROOT / "docs/guide/gpu.md": {"gpu_times": GPU_TIMES},
    ROOT / "docs/design/temporal.md": {"temporal_time": TIME_OF_SHOTS},
}


def measured_models() -> str:
    """Return the table of :func:`oiio_msspl.model.catalogue.measured`, which ``msspl models`` prints."""
    sets = [results.where(results.read(table), scene=MEAN) for table in ("accuracy", "accuracy_gauss")]
    means = [results.index(rows, "spp", "method") for rows in sets]
    times = results.read("time_frame")
    runs = [
        results.index([row for row in times if row["machine"].endswith(ending)], "method")
        for ending in MACHINES.values()
    ]
    lines = [",".join(["model,psnr_2spp,relmse_2spp,psnr_8spp,relmse_8spp", *(f"time_{x.lower()}" for x in MACHINES)])]
    for name in shipped_models():
        rows = [means[f"{SPREAD}-x" in name].get((spp, name)) for spp in (2, 8)]
        cells = [f"{row[m]:.4g}" if row else "" for row in rows for m in ("psnr", "relmse")]
        cells += [f"{run[name]['seconds'] / run[runtime.OIDN]['seconds']:.3g}" if name in run else "" for run in runs]
        lines.append(",".join([name, *cells]))
    return "\n".join(lines) + "\n"


def laid_out(page: str, blocks: Mapping[str, Block]) -> str:
    """Return the text of a page with its blocks replaced.

    Raises:
        SystemExit: the page has no place for one of them.
    """
    for name, block in blocks.items():
        place = re.compile(rf"(<!-- begin: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not place.search(page):
            raise SystemExit(f"no <!-- begin: {name} --> ... <!-- end -->")
        made = (block.text() if isinstance(block, Table) else block()).strip("\n")
        page = place.sub(lambda found, made=made: f"{found[1]}{made}\n{found[2]}", page)  # type: ignore[misc]
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a page is out of date")
    args = parser.parse_args()
    made = {path: laid_out(path.read_text(), blocks) for path, blocks in TABLES.items()}
    made[MEASURED] = measured_models()
    old = [path for path, text in made.items() if path.read_text() != text]
    if args.check:
        sys.exit("\n".join(f"{path.relative_to(ROOT)}: out of date" for path in old) or None)
    for path in old:
        path.write_text(made[path])


if __name__ == "__main__":
    main()
