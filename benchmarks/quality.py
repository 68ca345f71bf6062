# SPDX-License-Identifier: Apache-2.0
"""Accuracy on scenes that nothing was trained on, at equal average samples.

    python -m benchmarks.quality ../shared/renders --json results/quality.json

A scene is a folder with ``ref.exr``, ``hr_<n>spp.exr`` and ``lr_x<s>_<n>spp.exr``. For 2, 4 and 8 average samples
(spp_LRHS / s^2 + spp_HRLS) each method gets its files. From an LRHS and an HRLS: our models; OIDN (if pyoidn is
installed) on the HRLS with albedo and normal, at quality high and fast; OIDN on the LRHS, upsampled; and "both": the
first brought to the second's local brightness. From one full-resolution render of the same average: OIDN. Printed: PSNR
in sRGB and RelMSE (0.5, 0.01), per scene and mean. Scenes whose own reference is noisy are listed but not averaged.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.aovs import Resolution, resolve
from oiio_msspl.comparison import scores, upsample_bicubic
from oiio_msspl.exr import open_exr
from oiio_msspl.pairing import Source
from oiio_msspl.session import Session, find_model, shipped_models
from oiio_msspl.transforms import repair
from training.data import box_downsample

#: Average spp -> [(scale, LRHS spp, HRLS spp)].
CASES = {
    2: [(2, 4, 1), (4, 16, 1), (8, 64, 1)],
    4: [(2, 8, 2), (4, 32, 2), (8, 128, 2)],
    8: [(2, 16, 4), (4, 64, 4), (8, 256, 4)],
}
#: The reference of this one is full of fireflies.
NOISY_REFERENCE = {"veach-bidir"}


def beauty(file: Resolution) -> np.ndarray:
    return repair(file.read(file.data_window, ["rgb"])["rgb"])[0]


def oidn(file: Source, quality: str = "high") -> np.ndarray | None:
    """OIDN with albedo and normal, if there; None without pyoidn."""
    try:
        import pyoidn
    except ImportError:
        return None
    layers = file.read(file.data_window)
    layers = {k: np.ascontiguousarray(repair(v, signed=k == "normal")[0]) for k, v in layers.items()}
    # OIDN takes no normal without an albedo.
    guides = {k: layers[k] for k in ("albedo", "normal") if k in layers and "albedo" in layers}
    return np.asarray(pyoidn.denoise(layers["rgb"], hdr=True, quality=quality, **guides))


def brought_to(detail: np.ndarray, low: np.ndarray) -> np.ndarray:
    """An image times the smooth ratio that gives it the local means of a smaller one."""
    height, width = detail.shape[:2]
    means = box_downsample(detail, height // low.shape[0])
    return detail * upsample_bicubic(((low + 1e-3) / (means + 1e-3)).astype(np.float32), width, height)


def run_scene(folder: Path, sessions: list[Session]) -> list[dict[str, Any]]:
    """One row a method and case: ``scene, spp, method, psnr, relmse, relmse_gharbi, ssim``."""

    def load(name: str) -> Resolution:
        return resolve(open_exr(folder / name))

    truth = beauty(load("ref.exr"))
    height, width = truth.shape[:2]
    rows = []

    def add(spp: int, method: str, image: np.ndarray | None) -> None:
        if image is not None:
            rows.append({"scene": folder.name, "spp": spp, "method": method, **scores(image, truth)})

    for spp, cases in CASES.items():
        hr = load(f"hr_{cases[0][2]}spp.exr")
        add(spp, "HRLS", beauty(hr))
        denoised = oidn(hr)
        add(spp, "OIDN on the HRLS", denoised)
        add(spp, "OIDN fast on the HRLS", oidn(hr, "fast"))
        for scale, lr_spp, _ in cases:
            lr = load(f"lr_x{scale}_{lr_spp}spp.exr")
            low = beauty(lr)
            add(spp, f"LRHS x{scale} nearest", low.repeat(scale, 0).repeat(scale, 1))
            add(spp, f"LRHS x{scale} bicubic", upsample_bicubic(low, width, height))
            denoised_low = oidn(lr)
            if denoised is not None and denoised_low is not None:
                add(spp, f"OIDN on the LRHS x{scale}, bicubic", upsample_bicubic(denoised_low, width, height))
                add(spp, f"OIDN on both x{scale}", brought_to(denoised, denoised_low))
            for session in sessions:
                if session.contract.scale == scale:
                    add(spp, session.contract.name, fuse(lr, hr, session).rgb)
        add(spp, "full resolution", beauty(load(f"hr_{spp}spp.exr")))
        add(spp, "OIDN, same samples", oidn(load(f"hr_{spp}spp.exr")))
    return rows


def print_tables(rows: list[dict[str, Any]]) -> None:
    """A table a measure and average spp: methods down, scenes across."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for spp in dict.fromkeys(row["spp"] for row in rows):
        for measure, form in (("psnr", "{:.2f}"), ("relmse", "{:.4f}")):
            unit = "PSNR (sRGB, dB)" if measure == "psnr" else "RelMSE (0.5, 0.01)"
            print(f"\n### {unit} at {spp} spp on average\n")
            print("| method | mean | " + " | ".join(f"{s}{'*' if s in NOISY_REFERENCE else ''}" for s in scenes) + " |")
            print("|---|" + "---|" * (len(scenes) + 1))
            for method in dict.fromkeys(row["method"] for row in rows if row["spp"] == spp):
                values = {r["scene"]: r[measure] for r in rows if r["spp"] == spp and r["method"] == method}
                mean = np.mean([v for s, v in values.items() if s not in NOISY_REFERENCE])
                cells = [form.format(v) for v in (mean, *(values[s] for s in scenes))]
                print(f"| {method} | " + " | ".join(cells) + " |")
    if NOISY_REFERENCE & set(scenes):
        print("\n\\* noisy reference, not in the mean")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", type=Path, help="folder with one folder a scene")
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; all if none")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    args = parser.parse_args()
    sessions = [Session(find_model(0, name)) for name in args.model or shipped_models()]
    folders = sorted(p.parent for p in args.renders.glob("*/ref.exr"))
    rows = [row for folder in folders for row in run_scene(folder, sessions)]
    print_tables(rows)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        contracts = {s.contract.name: s.contract.provenance for s in sessions}
        args.json.write_text(json.dumps({"machine": platform.machine(), "models": contracts, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
