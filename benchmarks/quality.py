# SPDX-License-Identifier: Apache-2.0
"""Accuracy on scenes that nothing was trained on, at equal average samples.

    python -m benchmarks.quality RENDERS --flip --json results/quality.json
    python -m benchmarks.quality VIEWS --flip --json results/quality_cycles.json

Folders are those of :mod:`benchmarks.scenes`. For 2, 4 and 8 average samples (spp_LRHS / s^2 + spp_HRLS) each method
gets its renders. From an LRHS and an HRLS: our models; OIDN (if pyoidn is installed) on the HRLS with albedo and
normal, at quality high and fast; OIDN on the LRHS, upsampled; "OIDN on both": the first brought to the second's local
brightness; and "together": to that of both renders denoised as :mod:`oiio_msspl.denoiser` does. From one
full-resolution render of the same average: OIDN. "Nearest" marks the paper's LRHS, of every s x s pixels one; others
are averages of s x s pixels, as renderers make them. "3:1" marks pairs whose HRLS has three quarters of the samples,
others are halved, as in the paper. Printed: PSNR in sRGB and RelMSE (0.5, 0.01), per scene and mean;
and the mean of these, RelMSE (1, 1e-4), SSIM and FLIP. Scenes whose own reference is noisy are listed, not averaged.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import scenes
from benchmarks.scenes import NOISY_REFERENCE, beauty
from oiio_msspl import fuse, schema, tensors, transforms
from oiio_msspl.comparison import scores, upsample_bicubic
from oiio_msspl.denoiser import Denoiser, aovs_of_lrhs
from oiio_msspl.errors import InputError
from oiio_msspl.pairing import Source
from oiio_msspl.session import Session, find_model, shipped_models
from oiio_msspl.transforms import box_downsample, repair, srgb

#: Average spp; half of it is in the HRLS, half in the LRHS, as in the paper's tables.
AVERAGES = (2, 4, 8)
#: Other ways to divide it, HRLS to LRHS, where it divides.
UNEVEN = ((3, 1), (7, 1))
#: Key of a row -> what it is called, and how it is printed.
MEASURES = {
    "psnr": ("PSNR (sRGB, dB)", "{:.2f}"),
    "relmse": ("RelMSE (0.5, 0.01)", "{:.4f}"),
    "relmse_gharbi": ("RelMSE (1, 1e-4)", "{:.3f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "flip": ("FLIP", "{:.4f}"),
}


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


def denoised_together(lrhs: Source, hrls: Source) -> np.ndarray | None:
    """Both renders, denoised together at the LRHS's resolution; None without pyoidn."""
    try:
        denoiser = Denoiser(exact=True)
    except InputError:
        return None
    low = beauty(lrhs)
    exposure = transforms.exposure_of(low)
    layers = tensors.read(hrls, hrls.data_window, hrls.data_window)
    packed = tensors.pack(layers, schema.HRLS_FEATURES, exposure)
    names = aovs_of_lrhs(packed.shape[0] // low.shape[0])
    low_aovs = tensors.read(lrhs, lrhs.data_window, lrhs.data_window, features=names) if names else {}
    return transforms.expand(denoiser.together(transforms.compress(low, exposure), packed, low_aovs), exposure)


def flip_of(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean FLIP of two pictures in sRGB, seen from where a degree has 67 pixels."""
    import flip_evaluator

    return float(flip_evaluator.evaluate(srgb(reference), srgb(image), "LDR", applyMagma=False)[1])


def run_scene(scene: scenes.Scene, sessions: list[Session], flip: bool = False) -> list[dict[str, Any]]:
    """One row a method and case: ``scene, spp, method, psnr, relmse, relmse_gharbi, ssim``, and ``flip`` if asked."""
    height, width = scene.reference.shape[:2]
    rows = []

    def add(spp: int, method: str, image: np.ndarray | None) -> None:
        if image is not None:
            measured = scores(image, scene.reference) | ({"flip": flip_of(image, scene.reference)} if flip else {})
            rows.append({"scene": scene.name, "spp": spp, "method": method, **measured})

    for spp in AVERAGES:
        hr = scene.hrls(spp // 2)
        add(spp, "HRLS", beauty(hr))
        denoised = oidn(hr)
        add(spp, "OIDN on the HRLS", denoised)
        add(spp, "OIDN fast on the HRLS", oidn(hr, "fast"))
        for scale in schema.SCALES:
            lr, nearest = scene.lrhs(scale, spp // 2), scene.nearest(scale, spp // 2)
            low = beauty(lr)
            add(spp, f"LRHS x{scale} nearest", low.repeat(scale, 0).repeat(scale, 1))
            add(spp, f"LRHS x{scale} bicubic", upsample_bicubic(low, width, height))
            denoised_low, together = oidn(lr), denoised_together(lr, hr)
            if denoised is not None and denoised_low is not None and together is not None:
                add(spp, f"OIDN on the LRHS x{scale}, bicubic", upsample_bicubic(denoised_low, width, height))
                add(spp, f"OIDN on both x{scale}", brought_to(denoised, denoised_low))
                add(spp, f"OIDN on both x{scale}, together", brought_to(denoised, together))
            for session in sessions:
                if session.contract.scale == scale:
                    add(spp, session.contract.name, fuse(lr, hr, session).rgb)
                    if nearest is not None:
                        add(spp, f"{session.contract.name}, nearest", fuse(nearest, hr, session).rgb)
        for more, less in UNEVEN:
            share, rest = divmod(spp, more + less)
            if rest or not scene.has(share * more):
                continue
            hr, divided = scene.hrls(share * more), f"{more}:{less}"
            add(spp, f"OIDN on the HRLS, {divided}", oidn(hr))
            for session in sessions:
                lr = scene.lrhs(session.contract.scale, share * less)
                add(spp, f"{session.contract.name}, {divided}", fuse(lr, hr, session).rgb)
        full = scene.hrls(spp)
        add(spp, "full resolution", beauty(full))
        add(spp, "OIDN, same samples", oidn(full))
    return rows


def mean_of(rows: list[dict[str, Any]], method: str, spp: int, measure: str) -> float:
    """Over all scenes whose reference is clean; those of several views count once."""
    values: dict[str, list[float]] = {}
    for row in rows:
        if row["method"] == method and row["spp"] == spp and row["scene"] not in NOISY_REFERENCE:
            values.setdefault(row["scene"], []).append(row[measure])
    return float(np.mean([np.mean(of_scene) for of_scene in values.values()]))


def print_tables(rows: list[dict[str, Any]]) -> None:
    """A table a measure and average spp: methods down, scenes across."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    cases = list(dict.fromkeys(row["spp"] for row in rows))
    for spp in cases:
        for measure in ("psnr", "relmse"):
            unit, form = MEASURES[measure]
            print(f"\n### {unit} at {spp} spp on average\n")
            print("| method | mean | " + " | ".join(f"{s}{'*' if s in NOISY_REFERENCE else ''}" for s in names) + " |")
            print("|---|" + "---|" * (len(names) + 1))
            for method in dict.fromkeys(row["method"] for row in rows if row["spp"] == spp):
                cells = [form.format(mean_of(rows, method, spp, measure))]
                for name in names:
                    case = (method, spp, name)
                    values = [row[measure] for row in rows if (row["method"], row["spp"], row["scene"]) == case]
                    cells.append(form.format(np.mean(values)) if values else "")
                print(f"| {method} | " + " | ".join(cells) + " |")
    if NOISY_REFERENCE & set(names):
        print("\n\\* noisy reference, not in the mean")
    measured = {measure: form for measure, form in MEASURES.items() if measure in rows[0]}
    for spp in cases:
        print(f"\n### All measures at {spp} spp on average, mean\n")
        print("| method | " + " | ".join(unit for unit, _ in measured.values()) + " |\n|---|" + "---|" * len(measured))
        for method in dict.fromkeys(row["method"] for row in rows if row["spp"] == spp):
            cells = [form.format(mean_of(rows, method, spp, measure)) for measure, (_, form) in measured.items()]
            print(f"| {method} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="renders or views")
    parser.add_argument("--model", action="append", default=[], help="a shipped model or an ONNX file; all if none")
    parser.add_argument("--flip", action="store_true", help="also FLIP, which takes longer than all the rest")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    args = parser.parse_args()
    sessions = [Session(find_model(0, name)) for name in args.model or shipped_models()]
    rows = [row for scene in scenes.load(args.folder) for row in run_scene(scene, sessions, args.flip)]
    print_tables(rows)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        contracts = {s.contract.name: s.contract.provenance for s in sessions}
        args.json.write_text(json.dumps({"machine": platform.machine(), "models": contracts, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
