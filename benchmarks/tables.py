# SPDX-License-Identifier: Apache-2.0
"""Lay out what was measured: README.md, docs/results.md and docs/mix.md have the figures of
`benchmarks/results/*.json`.

    python -m benchmarks.tables

What lies between ``<!-- begin: NAME -->`` and ``<!-- end -->`` is replaced; the sentences around it are not.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks import confidence, quality
from benchmarks.paper import Rows, result, table
from oiio_msspl.schema import SCALES

ROOT = Path(__file__).parents[1]
FAMILIES = ("paper", "pyramid", "mix", "joint")
#: Those that gain most by an uneven division of the samples.
DIVIDED = ("mix", "joint")
#: What a user would do instead, by its name in the rows.
PEERS = {
    "OIDN fast on the HRLS": "OIDN 2.5.1 on the HRLS, quality fast",
    "OIDN on the HRLS": "OIDN 2.5.1 on the HRLS",
    "OIDN on both x2, together": "OIDN 2.5.1 on both together, x2 (no network of ours)",
    "OIDN, same samples": "OIDN 2.5.1 on full resolution, same samples",
}
OIDN = "OIDN 2.5.1, quality high"
BEST = "joint-x2"
FORMS = {measure: form for measure, (_, form) in quality.MEASURES.items()}


def rows_of(name: str) -> Rows:
    rows: Rows = result(name)["rows"]
    return rows


def code(name: str) -> str:
    """A method's name, as code if it is a model's."""
    return f"`{name}`" if name.startswith(FAMILIES) else name


def models(scales: Sequence[int] = SCALES, families: Sequence[str] = FAMILIES) -> list[str]:
    return [f"{family}-x{scale}" for family in families for scale in scales]


def accuracy() -> str:
    """README: PSNR and RelMSE of all models and peers at every average spp."""
    rows = rows_of("quality")

    def line(title: str, methods: Sequence[str]) -> list[str]:
        cells = [title]
        for spp in quality.AVERAGES:
            if not any(row["method"] in methods and row["spp"] == spp for row in rows):
                cells += ["", ""]  # that many samples can't be divided so
                continue
            psnr, relmse = ([quality.mean_of(rows, m, spp, k) for m in methods] for k in ("psnr", "relmse"))
            cells += [FORMS["psnr"].format(max(psnr)), FORMS["relmse"].format(min(relmse))]
        return cells

    body = [
        line("HRLS alone (1, 2 and 4 spp)", ["HRLS"]),
        line("full resolution, same samples", ["full resolution"]),
        line("LRHS bicubic, best scale for each number", [f"LRHS x{scale} bicubic" for scale in SCALES]),
        *(line(code(name), [name]) for name in models()),
        *(line(f"{code(BEST)}, HRLS {a}/{a + b} of the samples", [f"{BEST}, {a}:{b}"]) for a, b in quality.UNEVEN),
        *(line(title, [method]) for method, title in PEERS.items()),
    ]
    return table(["", *(cell for spp in quality.AVERAGES for cell in (f"{spp} spp: PSNR", "RelMSE"))], body)


def runtime() -> str:
    """README: time and memory."""
    results = result("runtime")["results"]
    base = np.median(results[OIDN]["seconds"])
    body = []
    for name in [*models(), OIDN, "OIDN 2.5.1, quality fast"]:
        seconds = np.median(results[name]["seconds"])
        body.append([code(name), f"{seconds:.2f}", f"{seconds / base:.2f}", f"{results[name]['peak_mb']:.0f}"])
    machine = result("runtime")["machine"]
    return table([f"1024 x 1024, two cores of an {machine}", "median s", "of OIDN's time", "peak MB"], body)


def scenes() -> str:
    """All measures of all methods, per scene."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        quality.print_tables(rows_of("quality"))
    return printed.getvalue().strip() + "\n"


def _cells(rows: Rows, method: str, measures: Sequence[str]) -> list[str]:
    """A cell an average spp; empty where the views have too few samples for a method."""
    measured = {(row["method"], row["spp"]) for row in rows}
    return [
        " / ".join(FORMS[measure].format(quality.mean_of(rows, method, spp, measure)) for measure in measures)
        if (method, spp) in measured
        else ""
        for spp in quality.AVERAGES
    ]


def filters() -> str:
    """Either pixel filter, with all layers; then the best model against OIDN with the same samples, per scene."""
    sets = {"box": rows_of("quality_box"), "Blackman-Harris": rows_of("quality_bh")}
    methods = [*list(PEERS)[1:], *models(SCALES[:2], FAMILIES[1:])]
    methods += [f"{name}, {more}:{less}" for name in models(SCALES[:2], DIVIDED) for more, less in quality.UNEVEN]
    head = ["PSNR / RelMSE", *(f"{name}, {spp} spp" for name in sets for spp in quality.AVERAGES)]
    body = [
        [code(m), *(cell for rows in sets.values() for cell in _cells(rows, m, ("psnr", "relmse")))] for m in methods
    ]
    judged = [
        name for name in dict.fromkeys(row["scene"] for row in sets["box"]) if name not in quality.NOISY_REFERENCE
    ]
    differences = []
    for name, rows in sets.items():
        psnr = {(row["method"], row["spp"], row["scene"]): row["psnr"] for row in rows}
        for spp in quality.AVERAGES:
            by_scene = (psnr[BEST, spp, s] - psnr["OIDN, same samples", spp, s] for s in judged)
            differences.append([f"{name}, {spp}", *(f"{value:+.2f}" for value in by_scene)])
    between = f"\nPSNR of `{BEST}` less that of OIDN on full resolution with the same samples, per scene:\n\n"
    return table(head, body) + between + table(["filter, spp", *judged], differences)


def division() -> str:
    """What it is worth to give the HRLS more than half of the samples: box filter, all layers."""
    rows = rows_of("quality_box")
    measured = {(row["method"], row["spp"]) for row in rows}
    ways = ["", *(f", {more}:{less}" for more, less in quality.UNEVEN)]
    columns = [(spp, way) for spp in quality.AVERAGES[1:] for way in ways if (BEST + way, spp) in measured]
    body = [
        [code(name)]
        + [
            FORMS["psnr"].format(quality.mean_of(rows, name + way, spp, "psnr"))
            if (name + way, spp) in measured
            else ""  # OIDN has one render
            for spp, way in columns
        ]
        for name in ("joint-x2", "joint-x4", "pyramid-x4", "OIDN, same samples")
    ]
    return table(["", *(f"{spp} spp{way or ', 1:1'}" for spp, way in columns)], body)


def cycles() -> str:
    """Views by Cycles, with both footprints of the LRHS."""
    rows = rows_of("quality_cycles")
    methods = [*list(PEERS)[1:]]
    for name in models():
        methods += [m for m in (name, f"{name}, nearest") if any(row["method"] == m for row in rows)]
    head = ["PSNR / RelMSE / FLIP", *(f"{spp} spp" for spp in quality.AVERAGES)]
    return table(head, [[code(m), *_cells(rows, m, ("psnr", "relmse", "flip"))] for m in methods])


#: Seconds that a sample of a frame may take.
_COSTS = tuple(np.geomspace(0.1, 100, 301))


def total() -> str:
    """What is gained on OIDN at the same time in all, render included, and how slow or fast a render must be to gain.

    OIDN's PSNR at the samples that our time would have bought is interpolated over the logarithm of its own.
    """
    rows, results, renders = rows_of("quality"), result("runtime")["results"], result("render_time")["seconds_per_spp"]
    seconds = {name: float(np.median(entry["seconds"])) for name, entry in results.items()}
    psnr = {(row["method"], row["spp"], row["scene"]): row["psnr"] for row in rows}
    judged = [name for name in renders if name not in quality.NOISY_REFERENCE]
    # On the HRLS of 1 spp, and on full resolution
    known = [("OIDN on the HRLS", 2), *(("OIDN, same samples", spp) for spp in quality.AVERAGES)]
    octaves = np.log2([1, *quality.AVERAGES])

    def gain(name: str, spp: int, scene: str, more: float) -> float:
        """On OIDN with so many more samples; beyond the most that were measured, it goes on as before."""
        values = [psnr[method, n, scene] for method, n in known]
        at = np.log2(max(spp + more, 1.0))  # with less it has no picture to show
        beyond = max(at - octaves[-1], 0.0) * (values[-1] - values[-2]) / (octaves[-1] - octaves[-2])
        return psnr[name, spp, scene] - float(np.interp(at, octaves, values)) - beyond

    body = []
    for model in ("joint-x2", "joint-x4"):
        slower = seconds[model] - seconds[OIDN]
        for spp in quality.AVERAGES:
            for name in [model, *(f"{model}, {a}:{b}" for a, b in quality.UNEVEN)]:
                if (name, spp, judged[0]) not in psnr:
                    continue
                gains = [gain(name, spp, scene, slower / renders[scene]["hrls"]) for scene in judged]
                pays = [
                    cost for cost in _COSTS if np.mean([gain(name, spp, scene, slower / cost) for scene in judged]) >= 0
                ]
                cells = (f"{value:+.2f}" for value in (float(np.mean(gains)), *gains))
                body.append([code(name), str(spp), _between(pays), *cells])
    return table(["", "spp", "pays, a spp", "mean", *judged], body)


def _between(paying: list[float]) -> str:
    """Which of ``_COSTS`` these are: a method slower than the other pays from some cost on, a faster one up to one."""
    if len(paying) in (0, len(_COSTS)):
        return "always" if paying else "never"
    return f"up to {paying[-1]:.2g} s" if paying[0] == _COSTS[0] else f"from {paying[0]:.2g} s"


def errors() -> str:
    """Predicted errors against actual ones."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        confidence.print_table(result("confidence"))
    return printed.getvalue()


TABLES: dict[Path, tuple[Callable[[], str], ...]] = {
    ROOT / "README.md": (accuracy, runtime),
    ROOT / "docs/results.md": (scenes, total, filters, cycles, errors),
    ROOT / "docs/mix.md": (division,),
}


def laid_out(text: str, tables: Sequence[Callable[[], str]]) -> str:
    """A page with these tables anew.

    Raises:
        SystemExit: there is no place for one.
    """
    for make in tables:
        place = re.compile(rf"(<!-- begin: {make.__name__} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not place.search(text):
            raise SystemExit(f"no <!-- begin: {make.__name__} --> ... <!-- end -->")
        made = make()
        text = place.sub(lambda found, made=made: f"{found[1]}\n{made}\n{found[2]}", text)  # type: ignore[misc]
    return text


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for path, tables in TABLES.items():
        path.write_text(laid_out(path.read_text(), tables))


if __name__ == "__main__":
    main()
