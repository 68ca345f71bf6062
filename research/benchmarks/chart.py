# SPDX-License-Identifier: Apache-2.0
"""Draw accuracy against time, from the tables of `research.benchmarks.accuracy`, `research.benchmarks.runtime`.

    python -m research.benchmarks.chart -o docs/chart.html

There is a panel for each average spp. Left and up is better: axes of errors point downwards. Methods whose time was not
measured are left out.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

from oiio_msspl.model.contract import SPREAD
from research.benchmarks import accuracy, results
from research.benchmarks.results import MEAN
from research.benchmarks.runtime import SAME_WORK
from research.benchmarks.scenes import NOISY_REFERENCE

TEMPLATE = Path(__file__).parent / "chart_template.html"
#: How the name of the machine ends whose times are drawn.
MACHINE = "with VNNI"
MEASURES = ("psnr", "relmse", "flip")
PEERS = (
    "OIDN, same samples",
    "OIDN prefiltered, same samples",
    "OIDN on the HRLS",
    "OIDN prefiltered on the HRLS",
    "OIDN fast on the HRLS",
)
#: How a series of models ends if most samples are in the HRLS.
UNEVEN = ", most samples in the HRLS"


def data() -> dict[str, Any]:
    """Return what is drawn.

    Returns:
        ``measures``, column -> title. ``machine``, the processor. ``scenes``, name -> title. ``spp``, the averages.
        ``cost``, scene -> seconds for one sample in each of 1024 x 1024 pixels. ``series``: for each its ``name``,
        whether it is a ``peer``, and its ``points``, each with ``method``, ``spp``, ``seconds`` for 1024 x 1024
        pixels, and for each scene its ``values`` in the order of the measures.
    """
    rows = results.read("accuracy")
    by_key = results.index(rows, *accuracy.KEYS)
    times = results.index((row for row in results.read("time_frame") if row["machine"].endswith(MACHINE)), "method")
    cost = {row["scene"]: row["hrls_s"] for row in results.read("time_render") if row["machine"].endswith(MACHINE)}
    cost[MEAN] = round(statistics.fmean(value for name, value in cost.items() if name not in NOISY_REFERENCE), 4)
    names = [MEAN, *(name for name in dict.fromkeys(row["scene"] for row in rows) if name in cost and name != MEAN)]

    def point(timed: str, method: str, spp: int) -> dict[str, Any]:
        measured = {name: by_key[name, spp, method] for name in names if (name, spp, method) in by_key}
        values = {name: [row[measure] for measure in MEASURES] for name, row in measured.items()}
        return {"method": method, "spp": spp, "seconds": times[timed]["seconds"], "values": values}

    families: dict[str, list[str]] = {}
    for name in times:
        if "-x" in str(name) and SPREAD not in str(name):
            families.setdefault(str(name).rpartition("-x")[0], []).append(str(name))
    series: list[dict[str, Any]] = []
    for family, members in families.items():
        even = [point(name, name, spp) for spp in accuracy.AVERAGES for name in members]
        uneven = [
            point(name, f"{name}, {division}", spp)
            for spp in accuracy.AVERAGES
            if (division := _largest_share(by_key, members, spp))
            for name in members
        ]
        series += [{"name": family, "points": even}, {"name": family + UNEVEN, "points": uneven}]
    for peer in PEERS:
        if SAME_WORK[peer] in times:
            points = [point(SAME_WORK[peer], peer, spp) for spp in accuracy.AVERAGES]
            series.append({"name": peer, "peer": True, "points": points})
    return {
        "measures": {measure: accuracy.MEASURES[measure][0] for measure in MEASURES},
        "machine": next(iter(times.values()))["machine"],
        "scenes": {name: _scene_title(name, names) for name in names},
        "spp": accuracy.AVERAGES,
        "cost": cost,
        "series": [one for one in series if one["points"]],
    }


def _largest_share(found: dict[Any, Any], members: list[str], spp: int) -> str | None:
    """Return the division with the most samples in the HRLS that was measured for all of these models."""
    divisions = [f"{more}:{less}" for more, less in reversed(accuracy.UNEVEN)]
    return next((d for d in divisions if all((MEAN, spp, f"{name}, {d}") in found for name in members)), None)


def _scene_title(name: str, names: list[str]) -> str:
    if name == MEAN:
        return f"mean of {len({*names} - {MEAN} - NOISY_REFERENCE)} scenes"
    return f"{name} (noisy reference)" if name in NOISY_REFERENCE else name


def page(shown: dict[str, Any]) -> str:
    """Return an HTML page that holds the data and draws it."""
    return TEMPLATE.read_text().replace("DATA", json.dumps(shown, separators=(",", ":")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="an HTML page")
    args = parser.parse_args()
    args.output.write_text(page(data()))


if __name__ == "__main__":
    main()
