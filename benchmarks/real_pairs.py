# SPDX-License-Identifier: Apache-2.0
"""The main job on real pairs: does it work, and does every other layer come out as it went in?

    python -m benchmarks.real_pairs FOLDER... [--layout spec] [--model FILE]

In each folder below FOLDER, hr.exr or hr_1spp.exr is fused with every lr*.exr beside it by the command line, and the
result opened with OpenEXR's own reader and with OpenImageIO's: every layer of the HRLS but the fused beauty must be in
it, bit for bit. With a ref.exr the scores are printed too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio

from oiio_msspl.aovs import layers_of, resolve
from oiio_msspl.assemble import fused_channels
from oiio_msspl.comparison import compare_files
from oiio_msspl.exr import Channel, ExrFile, open_exr


def find_pairs(folders: list[Path]) -> list[tuple[Path, Path]]:
    """(LRHS, HRLS) of every pair below the folders."""
    return [
        (lr, hr)
        for folder in folders
        for hr in sorted([*folder.rglob("hr.exr"), *folder.rglob("hr_1spp.exr")])
        for lr in sorted(hr.parent.glob("lr*.exr"))
    ]


def _keys(file: ExrFile) -> dict[tuple[str, str], Channel]:
    """(layer, component) -> channel; the nuke layout writes layers' dots as underscores."""
    return {(layer.name.replace(".", "_"), name): c for layer in layers_of(file) for name, c in layer.channels.items()}


def _planes(path: Path) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
    """(layer, component) -> the plane as OpenEXR reads it, and as OpenImageIO does in the stored type."""
    file = open_exr(path)
    names = {c: key for key, c in _keys(file).items()}
    planes = {}
    with OpenEXR.File(str(path), separate_channels=True) as by_openexr:
        by_oiio = oiio.ImageInput.open(str(path))
        for part in file.parts:
            by_oiio.seek_subimage(part.index, 0)
            for channel in part.channels:
                if channel in names:
                    pixels = by_openexr.parts[part.index].channels[channel.name].pixels.copy()
                    other = by_oiio.read_image(part.index, 0, channel.index, channel.index + 1, channel.type)[..., 0]
                    planes[names[channel]] = (pixels, other)
    return planes


def compare_passed_on(hr: Path, out: Path) -> tuple[int, list[str]]:
    """Number of channels of the HRLS that were passed on, and a line for each that was not, bit for bit."""
    resolution = resolve(open_exr(hr))
    fused = set(fused_channels(resolution))
    before, after = _planes(hr), _planes(out)
    faults, count = [], 0
    for key, channel in _keys(resolution.file).items():
        if channel in fused:
            continue
        count += 1
        if key not in after:
            faults.append(f"{channel.name} is missing")
            continue
        for reader, a, b in zip(("OpenEXR", "OpenImageIO"), before[key], after[key], strict=True):
            if a.dtype != b.dtype or a.tobytes() != b.tobytes():
                faults.append(f"{channel.name} differs ({reader})")
    return count, faults


def run_pair(lr: Path, hr: Path, out: Path, arguments: list[str]) -> dict:
    command = ["msspl-fuse", str(lr), str(hr), "-o", str(out), "--json", "--overwrite", "--no-preview", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return {"pair": f"{hr.parent.name}/{lr.name}", "error": done.stderr.strip()}
    report = json.loads(done.stdout)
    count, faults = compare_passed_on(hr, out)
    beauty = resolve(open_exr(out)).load().layers["rgb"]
    result = {
        "pair": f"{hr.parent.parent.name}/{hr.parent.name}/{lr.name}",
        "renderer": report["renderer"],
        "scale": report["scale"],
        "spp": report["spp"],
        "aovs": {row["feature"]: row["status"] for row in report["aovs"]},
        "passed_on": count,
        "faults": faults,
        "finite": bool(np.isfinite(beauty).all() and (beauty >= 0).all()),
        "warnings": report["warnings"],
    }
    reference = hr.with_name("ref.exr")
    if reference.exists():
        fused, high, low = compare_files([out, hr, lr], reference)
        result["scores"] = {"fused": fused, "hrls": high, "lrhs bicubic": low}
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--layout", default="spec")
    parser.add_argument("--model")
    parser.add_argument("--json", type=Path, help="also write the results here")
    args = parser.parse_args()
    extra = ["--layout", args.layout, *(["--model", args.model] if args.model else [])]
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for lr, hr in find_pairs(args.folders):
            result = run_pair(lr, hr, Path(folder) / "out.exr", extra)
            results.append(result)
            if "error" in result:
                print(f"{result['pair']}: {result['error']}")
                continue
            defaulted = [k for k, v in result["aovs"].items() if v in ("default", "absent")] or ["nothing"]
            scores = "".join(
                f"; {name} {s['psnr']:.2f} dB {s['relmse']:.4f}" for name, s in result.get("scores", {}).items()
            )
            print(
                f"{result['pair']}: {result['renderer']} x{result['scale']}, without {', '.join(defaulted)}; "
                f"{result['passed_on']} channels passed on, {len(result['faults'])} differ{scores}"
            )
            for line in [*result["faults"], *result["warnings"]]:
                print(f"    {line}")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1))
    return int(any(r.get("faults") or "error" in r for r in results))


if __name__ == "__main__":
    sys.exit(main())
