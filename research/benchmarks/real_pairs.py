# SPDX-License-Identifier: Apache-2.0
"""Runs the command line on real pairs and checks that every other layer of the HRLS comes out unchanged.

    python -m research.benchmarks.real_pairs FOLDER... [--layout spec] [--model FILE]

In each folder below FOLDER, `msspl-fuse` fuses hr.exr or hr_1spp.exr with every lr*.exr beside it. OpenEXR's reader and
OpenImageIO's then read the result: it must hold every layer of the HRLS bit for bit, except the fused beauty. If there
is a ref.exr, the scores are printed too. The exit code is 1 if a check fails.
"""

from __future__ import annotations

import argparse
import collections
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.compare import open_comparison, score_images
from oiio_msspl.exr.reader import open_exr
from research.benchmarks import results
from research.benchmarks.results import Row


def find_pairs(folders: list[Path]) -> list[tuple[Path, Path]]:
    """(LRHS, HRLS) of every pair below the folders."""
    return [
        (lr, hr)
        for folder in folders
        for hr in sorted([*folder.rglob("hr.exr"), *folder.rglob("hr_1spp.exr")])
        for lr in sorted(hr.parent.glob("lr*.exr"))
    ]


def _planes(path: Path, leave_out: set[tuple[int, str]]) -> dict[str, collections.Counter[tuple[str, bytes]]]:
    """Reader -> how often each plane (pixel type, bytes) occurs in a file. ``leave_out`` has (part, channel name)."""
    planes: dict[str, collections.Counter[tuple[str, bytes]]] = {"OpenEXR": collections.Counter()}
    planes["OpenImageIO"] = collections.Counter()
    by_oiio = oiio.ImageInput.open(str(path))
    with OpenEXR.File(str(path), separate_channels=True) as by_openexr:
        for part in open_exr(path).parts:
            by_oiio.seek_subimage(part.index, 0)
            for c in part.channels:
                if (part.index, c.name) in leave_out:
                    continue
                first = by_openexr.parts[part.index].channels[c.name].pixels
                second = by_oiio.read_image(part.index, 0, c.index, c.index + 1, c.type)[..., 0]
                planes["OpenEXR"][(str(first.dtype), first.tobytes())] += 1
                planes["OpenImageIO"][(str(second.dtype), second.tobytes())] += 1
    return planes


def compare_passed_on(hr: Path, out: Path) -> tuple[int, list[str]]:
    """How many channels of the HRLS the result must hold, and a message for each reader that misses some of them."""
    fused = {(c.part, c.name) for c in map_render(open_exr(hr)).beauty_channels}
    before, after = _planes(hr, fused), _planes(out, set())
    faults = [
        f"{missing.total()} channels are not in the result ({reader})"
        for reader in before
        if (missing := before[reader] - after[reader])
    ]
    return before["OpenEXR"].total(), faults


def run_pair(lr: Path, hr: Path, out: Path, arguments: list[str]) -> dict[str, Any]:
    """Fuse one pair and check the result."""
    command = ["msspl-fuse", str(lr), str(hr), "-o", str(out), "--json", "--overwrite", "--no-preview", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return {"pair": f"{hr.parent.name}/{lr.name}", "error": done.stderr.strip()}
    report = json.loads(done.stdout)
    count, faults = compare_passed_on(hr, out)
    beauty = map_render(open_exr(out)).load().layers["rgb"]
    if not (np.isfinite(beauty).all() and (beauty >= 0).all()):
        faults.append("the fused beauty has NaN, Inf or negative values")
    result = {
        "pair": f"{hr.parent.parent.name}/{hr.parent.name}/{lr.name}",
        "renderer": report["renderer"],
        "scale": report["scale"],
        "aovs": {row["feature"]: row["status"] for row in report["aovs"]},
        "passed_on": count,
        "faults": faults,
        "warnings": report["warnings"],
    }
    reference = hr.with_name("ref.exr")
    if reference.exists():
        fused, high, low = score_images(open_comparison([out, hr, lr], reference))
        result["scores"] = {"fused": fused, "hrls": high, "lrhs bicubic": low}
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--layout", default="spec")
    parser.add_argument("--model")
    results.add_option(parser)
    args = parser.parse_args()
    extra = ["--layout", args.layout, *(["--model", args.model] if args.model else [])]
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for lr, hr in find_pairs(args.folders):
            result = run_pair(lr, hr, Path(folder) / "out.exr", extra)
            found.append(result)
            if "error" in result:
                print(f"{result['pair']}: {result['error']}")
                continue
            defaulted = [k for k, v in result["aovs"].items() if v in ("default", "absent")] or ["nothing"]
            scores = "".join(
                f"; {name} {s['psnr']:.2f} dB {s['relmse']:.4f}" for name, s in result.get("scores", {}).items()
            )
            print(
                f"{result['pair']}: {result['renderer']} x{result['scale']}, without {', '.join(defaulted)}; "
                f"{result['passed_on']} channels passed on, {len(result['faults'])} faults{scores}"
            )
            for line in [*result["faults"], *result["warnings"]]:
                print(f"    {line}")
    if args.table:
        results.write(args.table, [summary(result) for result in found])
    return int(any(result.get("faults") or "error" in result for result in found))


def summary(result: dict[str, Any]) -> Row:
    """A result as a row of the table."""
    row: Row = {name: result[name] for name in ("pair", "renderer", "scale", "passed_on", "error") if name in result}
    if "error" not in result:
        row |= {"faults": len(result["faults"]), "warnings": len(result["warnings"])}
    return row | result.get("scores", {}).get("fused", {})


if __name__ == "__main__":
    sys.exit(main())
