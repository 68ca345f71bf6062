# SPDX-License-Identifier: Apache-2.0
"""Puts the tables of `research/benchmarks/results` into the pages.

    python -m research.benchmarks.tables

In the pages of `TABLES`, everything between ``<!-- begin: NAME -->`` and ``<!-- end -->`` is replaced by what the
function NAME returns. The text around it stays. The table that ``msspl models`` prints is written, too.
"""

from __future__ import annotations

import argparse
import itertools
import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from oiio_msspl.model.catalogue import MEASURED, shipped_models
from oiio_msspl.model.contract import SCALES, SPREAD
from research.benchmarks import (
    confidence,
    goals,
    layers,
    quality,
    results,
    runtime_files,
    runtime_passes,
    runtime_temporal,
    versus,
)
from research.benchmarks import pair_checks as pair_checks_benchmark
from research.benchmarks import passes as passes_benchmark
from research.benchmarks import runtime as runtimes
from research.benchmarks import temporal_passes as temporal_passes_benchmark
from research.benchmarks.results import MEAN, Row
from research.benchmarks.runtime import OIDN, OIDN_PREFILTERED, SAME_WORK
from research.benchmarks.scenes import NOISY_REFERENCE
from research.benchmarks.stability import report as stability_report
from research.benchmarks.temporal import report as temporal_report
from research.benchmarks.temporal.methods import (
    ALONE,
    NEIGHBOURS,
    OIDN_BEST,
    OIDN_SPLIT,
    OIDN_SPLIT_NEIGHBOURS,
    QUALITIES,
)
from research.benchmarks.temporal.methods import SCALES as TEMPORAL_SCALES
from research.benchmarks.temporal.sequence import MASKS

ROOT = Path(__file__).parents[2]
FAMILIES = ("paper", "joint-small", "joint", "joint-large")
#: OIDN on both renders at its best: see :func:`research.benchmarks.peers.match_local_means`.
JOINED = "OIDN prefiltered on both x2, together"
#: Methods of :mod:`research.benchmarks.quality` that most tables compare the models with.
PEERS = (
    "OIDN on the HRLS",
    "OIDN prefiltered on the HRLS",
    "OIDN on both x2, together",
    JOINED,
    "OIDN, same samples",
    "OIDN prefiltered, same samples",
)
DEFAULT = "joint-x2"
#: Models of the qualities "balanced" and "best", and the latter with most samples in the HRLS.
BETTER = (DEFAULT, "joint-large-x2", "joint-large-x2, 7:1")
#: A method of README's table -> its title, and what it needs.
WHEN_IT_PAYS = {
    "joint-small-x2": ("`--quality fast` (`joint-small-x2`)", "LRHS and HRLS"),
    "joint-x2": ("`--quality balanced` (`joint-x2`)", "LRHS and HRLS"),
    "joint-large-x2": ("`--quality best` (`joint-large-x2`)", "LRHS and HRLS"),
    "OIDN on the HRLS": ("OIDN on the HRLS", "HRLS"),
    "OIDN prefiltered on the HRLS": ("OIDN on the HRLS, prefiltered", "HRLS"),
    "OIDN prefiltered with base guides on the HRLS": ("the same with base networks for albedo and normal", "HRLS"),
    JOINED: ("OIDN on both renders, prefiltered, and joined", "LRHS and HRLS"),
    "OIDN, same samples": ("OIDN at full resolution", "all samples at full resolution"),
    "OIDN prefiltered, same samples": ("OIDN at full resolution, prefiltered", "all samples at full resolution"),
}
#: OIDN at its best -> which render it gets.
AT_ITS_BEST = {
    "OIDN prefiltered on the HRLS": "on the HRLS",
    "OIDN prefiltered, same samples": "at full resolution",
}
#: OIDN's calls on the renders by LuxCore.
LUXCORE_PEERS = (
    "OIDN on the HRLS",
    "OIDN prefiltered on the HRLS",
    "OIDN, same samples",
    "OIDN prefiltered, same samples",
)
#: Tables of accuracy on all methods, and the renders they are about.
SETS = {
    "Mitsuba": "quality",
    "box": "quality_box",
    "Blackman-Harris": "quality_blackman_harris",
    "Cycles": "quality_cycles",
}

#: Instructions of a processor for networks -> tables of times that were measured on it: of methods, and of rendering.
MACHINES = {
    "AMX": ("runtime_amx", "render_time_amx"),
    "VNNI": ("runtime_vnni", "render_time_vnni"),
    "neither": ("runtime", "render_time"),
}

#: Methods that are compared on the same views with two pixel filters.
SAME_VIEWS = (
    "joint-small-x2",
    "joint-x2",
    "OIDN on the HRLS",
    "OIDN prefiltered on the HRLS",
    "OIDN, same samples",
    "OIDN prefiltered, same samples",
)

Found = Mapping[Hashable, Row]
#: Methods of README's table of spread noise, and their titles.
SPREAD_NOISE = {
    "HRLS": "HRLS alone",
    "joint-x2": "`joint-x2`",
    "joint-small-spread-x2": "`--quality fast` (`joint-small-spread-x2`)",
    "joint-spread-x2": "`--quality balanced` (`joint-spread-x2`)",
    "joint-large-spread-x2": "`--quality best` (`joint-large-spread-x2`)",
    "paper-x2": "`paper-x2`",
    "OIDN on the HRLS": "OIDN on the HRLS",
    "OIDN prefiltered on the HRLS": "OIDN on the HRLS, prefiltered",
    "OIDN, same samples": "OIDN at full resolution",
    "OIDN prefiltered, same samples": "OIDN at full resolution, prefiltered",
    "OIDN prefiltered and split, same samples": "the same on every second pixel",
}


def title(method: str) -> str:
    """A method's name, as code if it is a model's."""
    return f"`{method}`" if method.startswith(FAMILIES) else method


def models(scales: Sequence[int] = SCALES, families: Sequence[str] = FAMILIES) -> list[str]:
    """Names of the shipped models."""
    return [f"{family}-x{scale}" for family in families for scale in scales]


def means_of(rows: Iterable[Row]) -> Found:
    """The mean rows of :mod:`research.benchmarks.quality` by (spp, method)."""
    return results.index((row for row in rows if row["scene"] == MEAN), "spp", "method")


def share_of_oidn(times: Found, method: str) -> str:
    """Time of a method of :mod:`research.benchmarks.quality` as a share of OIDN's; empty if it was not measured.

    Args:
        times: rows of :mod:`research.benchmarks.runtime` by method.
    """
    time = times.get(SAME_WORK.get(method, method))
    return f"{time['seconds'] / times[OIDN]['seconds']:.2f}" if time else ""


def when_it_pays() -> str:
    """Accuracy at 2 and 8 spp on average, and time, of what a user can choose from."""
    rows = results.read("quality")
    runs = [results.index(results.read(table), "method") for table, _ in MACHINES.values()]
    means = means_of(rows)
    body = []
    for method, (name, needs) in WHEN_IT_PAYS.items():
        relative = [share_of_oidn(times, method) for times in runs]
        cells = [quality.cell(means.get((spp, method)), measure) for spp in (2, 8) for measure in ("psnr", "relmse")]
        body.append([name, needs, *cells, *relative])
    head = ["method", "needs", "2 spp: PSNR", "RelMSE", "8 spp: PSNR", "RelMSE"]
    head += [f"time / OIDN's, {name}" for name in MACHINES]
    return f"{results.markdown(head, body)}\n{quality.mean_note(rows)}\n"


def how_sure() -> str:
    """The qualities "balanced" and "best" against OIDN at its best, by scene."""
    rows = results.read("quality")
    peers = AT_ITS_BEST | {JOINED: "on both renders, joined"}
    body = []
    for (peer, render), model, spp in itertools.product(peers.items(), BETTER, (2, 8)):
        if peer != goals.SAME_SAMPLES:  # it reads the HRLS that the model reads, which may have most of the samples
            peer = ", ".join([peer, *model.split(", ")[1:]])
        if found := versus.compare(rows, model, peer, spp):
            cells = [versus.cell(found.psnr, "+.2f"), f"{found.without_too_easy:+.2f}", found.wins]
            body.append([render, title(model), str(spp), *cells, ", ".join(found.verdicts)])
    head = ["against OIDN, prefiltered", "model", "spp", "PSNR gained, dB", f"without {versus.TOO_EASY}", "better on"]
    return results.markdown([*head, "PSNR, RelMSE"], body)


def against_oidn() -> str:
    """Models against OIDN at its best, with intervals, on all renders on which both were measured."""
    tables = {name: results.read(table) for name, table in SETS.items()}
    text = versus.table(
        tables,
        ("joint-large-x2", "joint-large-x4", "joint-x2", "joint-x4", "joint-small-x4"),
        AT_ITS_BEST,
        quality.AVERAGES,
    )
    missing = [name for name, rows in tables.items() if not versus.compare(rows, DEFAULT, next(iter(AT_ITS_BEST)), 2)]
    return text + f"\nPrefiltered OIDN was not measured on these renders: {', '.join(missing)}.\n" * bool(missing)


def goals_of_accuracy() -> str:
    """What the qualities were to reach in accuracy, and what they reach."""
    return goals.accuracy({title: results.read(table) for title, table in SETS.items()})


def goals_of_time() -> str:
    """The same for time."""
    return goals.time({title: results.read(table) for title, (table, _) in MACHINES.items()})


def spread_noise() -> str:
    """Accuracy on renders whose pixel filter has spread the noise, on how many scenes that is best, and time."""
    rows = results.read("quality_gauss")
    times = results.index(results.read(MACHINES["VNNI"][0]), "method")
    means, found = means_of(rows), results.index(rows, *quality.KEYS)
    clean = versus.clean_scenes(rows)
    body = []
    for method, name in SPREAD_NOISE.items():
        cells = [quality.cell(means.get((spp, method)), measure) for spp in (2, 8) for measure in ("psnr", "relmse")]
        best = sum(max(SPREAD_NOISE, key=lambda m, s=scene: found[s, 2, m]["psnr"]) == method for scene in clean)
        body.append([name, *cells, f"{best} of {len(clean)}", share_of_oidn(times, method)])
    head = ["method", "2 spp: PSNR", "RelMSE", "8 spp: PSNR", "RelMSE", "scenes on which it is best (PSNR, 2 spp)"]
    head.append("time / OIDN's, VNNI")
    return f"{results.markdown(head, body)}\n{quality.mean_note(rows)}\n"


def same_views() -> str:
    """The same views with a box filter, and with a Gaussian that spreads samples, for which other models are made."""
    films = {name: results.read(f"quality_film_{name}") for name in ("box", "gaussian")}
    found = {name: results.index(rows, *quality.KEYS) for name, rows in films.items()}
    clean = versus.clean_scenes(films["box"])
    body = []
    for method in SAME_VIEWS:
        spread = method.replace("-x", f"{SPREAD}-x") if method.startswith(FAMILIES) else method
        names = {"box": method, "gaussian": spread}
        line = [title(method)]
        for spp in (2, 8):
            line += [quality.cell(found[film][MEAN, spp, name], "psnr", "relmse") for film, name in names.items()]
            box, gaussian = ([found[film][n, spp, name]["psnr"] for n in clean] for film, name in names.items())
            line.append(versus.cell(versus.with_interval(np.subtract(gaussian, box)), "+.2f"))
        body.append(line)
    head = [f"{spp} spp, {name}" for spp in (2, 8) for name in ("box", "Gaussian", "difference, dB")]
    return f"{results.markdown(['PSNR / RelMSE', *head], body)}\n{quality.mean_note(films['box'])}\n"


def gpu_times() -> str:
    """Milliseconds a frame on a GPU."""
    found = results.index(rows := results.read("gpu"), "size", "method")
    sizes = dict.fromkeys(row["size"] for row in rows)
    body = []
    for method in dict.fromkeys(row["method"] for row in rows):
        taken = [found[size, method] for size in sizes]
        last = taken[-1]
        cells = [f"{row['ms']:.1f} ms" for row in taken]
        cells += [f"{last['ms'] / found[last['size'], peer]['ms']:.2f}" for peer in ("OIDN", "OIDN prefiltered")]
        cells += [f"{last[name]:.1f} ms" if name in last else "" for name in ("with_copies_ms", "floor_ms")]
        body.append([title(method), *cells])
    of_last = [f"time / {peer}'s" for peer in ("OIDN", "prefiltered OIDN")] + ["with copies", "convolutions, at least"]
    (card,) = {row["card"] for row in rows}
    return f"{results.markdown([card, *sizes, *of_last], body)}\n"


def by_filter(rows: Sequence[Row] | None = None) -> str:
    """Accuracy for each pixel filter, by :mod:`research.benchmarks.pixel_filters`."""
    rows = rows or results.read("pixel_filters")
    found = results.index(rows, "filter", "spp", "method")
    columns = list(dict.fromkeys((row["spp"], row["method"]) for row in rows))
    body = [
        [kind, *(quality.cell(found[kind, *column], "psnr", "relmse") for column in columns)]
        for kind in dict.fromkeys(row["filter"] for row in rows)
    ]
    return results.markdown(["PSNR / RelMSE", *(f"{spp} spp, {title(method)}" for spp, method in columns)], body)


def layer_worth() -> str:
    """What each layer is worth at 2 spp."""
    return layers.layout([row for row in results.read("layers") if row["spp"] == 2])


def scenes() -> str:
    """All measures of all methods on the development scenes."""
    return quality.layout(results.read("quality"))


def runtime() -> str:
    """Time and memory of a frame on arrays, on several processors, and of one from file to file."""
    frames = "\n".join(runtimes.layout(results.read(table)) for table, _ in MACHINES.values())
    return f"{frames}\n{runtime_files.layout(results.read('runtime_files'))}"


def filters() -> str:
    """Both pixel filters, with all layers, and two models against OIDN with the same samples by scene."""
    tables = {"box": results.read("quality_box"), "Blackman-Harris": results.read("quality_blackman_harris")}
    means = {name: means_of(rows) for name, rows in tables.items()}
    names = [*PEERS, *models(SCALES[:2], FAMILIES[1:])]
    names += [f"{name}, {a}:{b}" for name in models(SCALES[:2], ("joint", "joint-large")) for a, b in quality.UNEVEN]
    head = ["PSNR / RelMSE", *(f"{name}, {spp} spp" for name in tables for spp in quality.AVERAGES)]
    cases = [(name, spp) for name in tables for spp in quality.AVERAGES]
    body = _measured(
        [title(method), *(quality.cell(means[name].get((spp, method)), "psnr", "relmse") for name, spp in cases)]
        for method in names
    )
    clean = versus.clean_scenes(tables["box"])
    differences = []
    for (name, rows), model, spp in itertools.product(tables.items(), BETTER[:2], quality.AVERAGES):
        if found := versus.compare(rows, model, "OIDN prefiltered, same samples", spp):
            by_scene = (f"{found.by_scene[scene]:+.2f}" for scene in clean)
            without = f"{found.without_too_easy:+.2f}"
            psnr = versus.cell(found.psnr, "+.2f")
            differences.append([f"{name}, `{model}`, {spp}", psnr, without, found.wins, *by_scene])
    between = "\nPSNR minus that of prefiltered OIDN on full resolution with the same samples:\n\n"
    columns = ["filter, model, spp", MEAN, f"without {versus.TOO_EASY}", "better on", *clean]
    return (
        f"{results.markdown(head, body)}\n{quality.mean_note(tables['box'])}\n{between}"
        f"{results.markdown(columns, differences)}"
    )


def cycles() -> str:
    """Views by Cycles."""
    rows = results.read("quality_cycles")
    means = means_of(rows)
    names = [*PEERS, *models(), *(f"joint-large-x2, {a}:{b}" for a, b in quality.UNEVEN)]
    body = _measured(
        [title(name), *(quality.cell(means.get((spp, name)), "psnr", "relmse", "flip") for spp in quality.AVERAGES)]
        for name in names
    )
    head = ["PSNR / RelMSE / FLIP", *(f"{spp} spp" for spp in quality.AVERAGES)]
    clean = versus.clean_scenes(rows)
    differences = []
    for (peer, which), model, spp in itertools.product(AT_ITS_BEST.items(), BETTER[:2], quality.AVERAGES):
        if found := versus.compare(rows, model, peer, spp):
            by_scene = (f"{found.by_scene[scene]:+.2f}" for scene in clean)
            differences.append([f"`{model}`, {which}, {spp}", versus.cell(found.psnr, "+.2f"), found.wins, *by_scene])
    return (
        f"{results.markdown(head, body)}\n{quality.mean_note(rows)}\n"
        "\nPSNR minus that of prefiltered OIDN, which gets the HRLS or as many samples at full resolution:\n\n"
        f"{results.markdown(['model, OIDN, spp', MEAN, 'better on', *clean], differences)}"
    )


def luxcore() -> str:
    """A room by LuxCore, with either filter."""
    rows = results.read("quality_luxcore")
    found = results.index(rows, *quality.KEYS)
    cases = [(scene, spp) for scene in versus.clean_scenes(rows) for spp in quality.AVERAGES]
    body = _measured(
        [title(method), *(quality.cell(found.get((*case, method)), "psnr", "relmse") for case in cases)]
        for method in (*LUXCORE_PEERS, *models(SCALES[:2]))
    )
    return results.markdown(["PSNR / RelMSE", *(f"{scene}, {spp} spp" for scene, spp in cases)], body)


def division() -> str:
    """PSNR when the HRLS has more than half of the samples: box filter, all layers."""
    rows = results.read("quality_box")
    means = means_of(rows)
    ways = ["", *(f", {more}:{less}" for more, less in quality.UNEVEN)]
    columns = [(spp, way) for spp in quality.AVERAGES[1:] for way in ways if (spp, DEFAULT + way) in means]
    body = _measured(
        [title(name), *(quality.cell(means.get((spp, name + way)), "psnr") for spp, way in columns)]
        for name in (
            "joint-large-x2",
            "joint-x2",
            "joint-x4",
            "joint-small-x4",
            "OIDN, same samples",
            "OIDN prefiltered, same samples",
        )
    )
    head = ["", *(f"{spp} spp{way or ', 1:1'}" for spp, way in columns)]
    return f"{results.markdown(head, body)}\n{quality.mean_note(rows)}\n"


def _measured(body: Iterable[list[str]]) -> list[list[str]]:
    """The lines that have more than a title."""
    return [line for line in body if any(line[1:])]


#: Seconds for one sample in each pixel of a frame, as candidates for the break-even cost.
_COSTS = np.geomspace(0.1, 100, 301)


def total() -> str:
    """PSNR gained over OIDN at the same total time, render included, and the render cost at which a method gains.

    The faster method gets more samples for the time that it saves. OIDN's PSNR at those samples is interpolated over
    the logarithm of its measured ones.
    """
    rows = results.read("quality")
    body = [line for machine in MACHINES.values() for line in _total(rows, *(results.read(table) for table in machine))]
    head = ["PSNR gained", "over", "spp", "gains if a sample costs", MEAN, f"without {versus.TOO_EASY}", "better on"]
    return results.markdown(["on", *head], body)


def _total(rows: Sequence[Row], runtime: Sequence[Row], render_time: Sequence[Row]) -> Iterator[list[str]]:
    """The lines of one machine."""
    times = results.index(runtime, "method")
    costs = {row["scene"]: row["hrls_s"] for row in render_time}
    psnr = {(row["method"], row["spp"], row["scene"]): row["psnr"] for row in rows}
    clean = [name for name in costs if name not in NOISY_REFERENCE]
    # Each of OIDN's two calls on the HRLS of 1 spp, then on full resolution
    peers = {
        call: [(f"{call} on the HRLS", 2), *((f"{call}, same samples", spp) for spp in quality.AVERAGES)]
        for call in (OIDN, OIDN_PREFILTERED)
        if call in times
    }
    octaves = np.log2([1, *quality.AVERAGES])

    def gain(name: str, call: str, spp: int, scene: str, more: NDArray[np.float64]) -> NDArray[np.float64]:
        """PSNR of a method minus that of OIDN with ``more`` samples. Beyond 8 spp OIDN's last slope goes on."""
        values = [psnr[method, n, scene] for method, n in peers[call]]
        at = np.log2(np.maximum(spp + more, 1.0))  # OIDN needs at least one sample
        beyond = np.maximum(at - octaves[-1], 0.0) * (values[-1] - values[-2]) / (octaves[-1] - octaves[-2])
        return np.asarray(psnr[name, spp, scene] - np.interp(at, octaves, values) - beyond)

    for model, call, spp in itertools.product(
        ("joint-x2", "joint-x4", "joint-large-x2", "joint-large-x4"), peers, quality.AVERAGES
    ):
        if model not in times:
            continue
        slower = times[model]["seconds"] - times[call]["seconds"]
        for name in [model, *(f"{model}, {a}:{b}" for a, b in quality.UNEVEN)]:
            if (name, spp, clean[0]) not in psnr:
                continue
            gains = {scene: float(gain(name, call, spp, scene, np.array(slower / costs[scene]))) for scene in clean}
            by_cost = np.mean([gain(name, call, spp, scene, slower / _COSTS) for scene in clean], axis=0)
            pays = _COSTS[by_cost >= 0].tolist()
            without = np.mean([value for scene, value in gains.items() if scene != versus.TOO_EASY])
            cells = (versus.cell(versus.with_interval(np.array(list(gains.values()))), "+.2f"), f"{without:+.2f}")
            wins = f"{sum(value > 0 for value in gains.values())} of {len(gains)}"
            yield [times[model]["machine"], title(name), call, str(spp), _range_of(pays), *cells, wins]


def _range_of(costs: Sequence[float]) -> str:
    """Some of `_COSTS` in words. A method slower than OIDN gains from some cost on, a faster one up to some cost."""
    if len(costs) in (0, len(_COSTS)):
        return "anything" if costs else "never"
    return f"up to {costs[-1]:.2g} s" if costs[0] == _COSTS[0] else f"at least {costs[0]:.2g} s"


def errors() -> str:
    """Predicted errors beside actual ones."""
    return confidence.layout(results.read("confidence"))


def over_time() -> str:
    """Sequences that are averaged with their neighbours."""
    return temporal_report.layout(results.read("temporal"))


def over_time_spread() -> str:
    """The same where the pixel filter has spread the noise, beside OIDN on every second pixel."""
    rows = results.read("temporal_spread")
    found = results.index(rows, "sequence", "scale", "method")
    body = []
    for (name, prefix), row in itertools.product(QUALITIES.items(), rows):
        if row["method"] != prefix + NEIGHBOURS:
            continue
        sequence, scale = row["sequence"], row["scale"]
        alone, averaged_peer = (found[sequence, scale, method] for method in (prefix + ALONE, OIDN_SPLIT_NEIGHBOURS))
        usual, peer = (found[sequence, 1, method] for method in (OIDN_BEST, OIDN_SPLIT))
        gains = [row["psnr"] - other["psnr"] for other in (alone, usual, peer, averaged_peer)]
        flicker = [row["flicker"] / other["flicker"] for other in (alone, peer, averaged_peer)]
        least = min((row[mask] - alone[mask], mask) for mask in MASKS if mask in row)
        cells = [f"`{name}`", sequence, f"x{scale}", f"{row['psnr']:.2f}", *(f"{gain:+.2f}" for gain in gains)]
        body.append([*cells, *(f"{ratio:.2f}" for ratio in flicker), f"{least[0]:+.2f} ({least[1]})"])
    head = ["quality", "sequence", "scale", "PSNR", "over single frames, dB", "over OIDN prefiltered, dB"]
    head += ["over OIDN on every second pixel, dB", "over that with neighbours, dB", "flicker, of single frames'"]
    head += ["of OIDN's on every second pixel", "of that with neighbours"]
    return results.markdown([*head, "least gain in a mask, dB"], body)


def without_vectors() -> str:
    """What averaging gains if the HRLS has no motion vectors, beside what it gains with them."""
    tables = [results.read(name) for name in ("temporal_without_vectors", "temporal")]
    found = [results.index(rows, "sequence", "scale", "method") for rows in tables]
    measures = ["psnr", *(mask for mask in MASKS if any(mask in row for row in tables[0]))]
    body = []
    for (name, prefix), row in itertools.product(QUALITIES.items(), tables[0]):
        if row["method"] != prefix + NEIGHBOURS:
            continue
        cells = [f"`{name}`", row["sequence"], f"x{row['scale']}"]
        for measure in measures:
            for rows in found:
                pair = (rows[row["sequence"], row["scale"], prefix + way] for way in (NEIGHBOURS, ALONE))
                averaged, alone = (each[measure] for each in pair)
                cells.append(f"{averaged - alone:+.2f}")
        body.append(cells)
    head = ["quality", "sequence", "scale"]
    for measure in ("all pixels", *measures[1:]):
        head += [f"{measure}, dB", "with vectors"]
    return results.markdown(head, body)


def stability() -> str:
    """How often each method holds, suffers and fails, and its holes and stamps."""
    by_scale: dict[int, list[Row]] = {}
    for row in results.read("stability"):
        by_scale.setdefault(row["scale"], []).append(row)
    return "\n".join(
        f"{len({(row['group'], row['case']) for row in rows})} cases at x{scale}:\n\n{stability_report.summary(rows)}"
        for scale, rows in sorted(by_scale.items())
    )


def pair_checks() -> str:
    """Wrong pairs that get a warning, and right ones that do."""
    return pair_checks_benchmark.layout(results.read("pair_checks"))


def passes() -> str:
    """Fused passes, beside other ways to clean them."""
    rows = results.read("passes")
    scenes = ", ".join(dict.fromkeys(row["scene"] for row in rows if row["scene"] != MEAN))
    return f"{passes_benchmark.layout(rows)}\nMeans over all layers of these scenes: {scenes}.\n"


def passes_half() -> str:
    """Light groups that a network fuses at half of the resolution."""
    rows = results.read("passes_half")
    scenes = ", ".join(dict.fromkeys(row["scene"] for row in rows if row["scene"] != results.MEAN))
    return f"{passes_benchmark.layout(rows)}\nMeans over all light groups of these scenes: {scenes}.\n"


def passes_spread() -> str:
    """The same where the pixel filter has spread the noise, without the methods that are worse than others there."""
    rows = results.read("passes_spread")
    scenes = ", ".join(dict.fromkeys(row["scene"] for row in rows if row["scene"] != MEAN))
    # Mitsuba stores no layer as light and colour
    shown = [
        {key: value for key, value in row.items() if not key.startswith("gain_stored")}
        for row in rows
        if row["method"] in passes_benchmark.WITH_SPREAD_NOISE
    ]
    return f"{passes_benchmark.layout(shown)}\nMeans over all layers of these scenes: {scenes}.\n"


def single_passes() -> str:
    """Each fused layer, beside other ways to clean it."""
    return passes_benchmark.layout_of_layers(results.read("passes"))


def passes_time() -> str:
    """Time of fused passes on a frame of real size: light everywhere, at x2 on three processors and at x4, and a
    rendered frame."""
    kinds = ("", "_vnni", "_avx2", "_x4", "_cycles")
    tables = [f"runtime_passes{kind}" for kind in kinds]
    return "\n".join(runtime_passes.layout(results.read(table)) for table in tables)


def temporal_time() -> str:
    """Time of shots whose frames are averaged with their neighbours."""
    tables = ("runtime_temporal", "runtime_temporal_avx2")
    return "\n".join(runtime_temporal.layout(results.read(table)) for table in tables)


def temporal_time_of_passes() -> str:
    """The same with passes."""
    return runtime_temporal.layout(results.read("runtime_temporal_passes"))


def temporal_passes() -> str:
    """What neighbouring frames gain for passes."""
    return temporal_passes_benchmark.layout(results.read("temporal_passes"))


def temporal_counts() -> str:
    """What averaging gains over single frames with two frames on each side, and with `auto`."""
    tables = {"2": results.read("temporal_2"), "auto": results.read("temporal")}
    sequences = dict.fromkeys(row["sequence"] for row in tables["2"])
    body = []
    for (name, prefix), (frames, rows) in itertools.product(QUALITIES.items(), tables.items()):
        found = results.index(rows, "sequence", "scale", "method")
        pairs = [
            [found[sequence, scale, prefix + way] for way in (NEIGHBOURS, ALONE)]
            for sequence, scale in itertools.product(sequences, TEMPORAL_SCALES)
        ]
        gain = np.mean([averaged["psnr"] - alone["psnr"] for averaged, alone in pairs])
        flicker = np.mean([averaged["flicker"] / alone["flicker"] for averaged, alone in pairs])
        body.append([f"`--quality {name} --temporal {frames}`", f"{gain:+.2f}", f"{flicker:.2f}"])
    head = [f"mean of {', '.join(sequences)} at x2 and x4", "PSNR gained, dB", "flicker, of single frames'"]
    return results.markdown(head, body)


TABLES: dict[Path, tuple[Callable[[], str], ...]] = {
    ROOT / "README.md": (when_it_pays, how_sure, spread_noise),
    ROOT / "docs/design/results.md": (
        goals_of_accuracy,
        goals_of_time,
        against_oidn,
        scenes,
        runtime,
        total,
        filters,
        same_views,
        by_filter,
        layer_worth,
        cycles,
        luxcore,
        division,
        errors,
        over_time,
        over_time_spread,
        without_vectors,
        stability,
        pair_checks,
    ),
    ROOT / "docs/guide/gpu.md": (gpu_times,),
    ROOT / "docs/design/temporal.md": (temporal_passes, temporal_time, temporal_time_of_passes, temporal_counts),
}


def measured_models() -> str:
    """The table of :func:`oiio_msspl.model.catalogue.measured`, which ``msspl models`` prints."""
    sets = {noise: means_of(results.read(table)) for noise, table in (("", "quality"), (SPREAD, "quality_gauss"))}
    runs = [results.index(results.read(table), "method") for table, _ in MACHINES.values()]
    lines = [",".join(["model,psnr_2spp,relmse_2spp,psnr_8spp,relmse_8spp", *(f"time_{x.lower()}" for x in MACHINES)])]
    for name in shipped_models():
        means = sets[SPREAD if f"{SPREAD}-x" in name else ""]
        cells = [
            f"{means[spp, name][m]:.4g}" if (spp, name) in means else "" for spp in (2, 8) for m in ("psnr", "relmse")
        ]
        cells += [f"{times[name]['seconds'] / times[OIDN]['seconds']:.3g}" if name in times else "" for times in runs]
        lines.append(",".join([name, *cells]))
    return "\n".join(lines) + "\n"


def laid_out(text: str, tables: Sequence[Callable[[], str]]) -> str:
    """A page with its tables replaced.

    Raises:
        SystemExit: the page has no place for one of them.
    """
    for make in tables:
        place = re.compile(rf"(<!-- begin: {make.__name__} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not place.search(text):
            raise SystemExit(f"no <!-- begin: {make.__name__} --> ... <!-- end -->")
        made = make().strip("\n")
        text = place.sub(lambda found, made=made: f"{found[1]}\n{made}\n\n{found[2]}", text)  # type: ignore[misc]
    return text


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for path, tables in TABLES.items():
        path.write_text(laid_out(path.read_text(), tables))
    MEASURED.write_text(measured_models())


if __name__ == "__main__":
    main()
