# SPDX-License-Identifier: Apache-2.0
"""Defines ``msspl models``."""

from __future__ import annotations

import json
from typing import Any

from msspl_cli import console, options

EXAMPLES = """[bold]Examples[/bold]

  msspl models

  msspl models --json
"""


def models(as_json: options.Json = False, debug: options.Debug = False, help_all: options.HelpAll = False) -> None:
    """List the models in the package, and the devices that ONNX Runtime was built for.

    PSNR and RelMSE are the means of five scenes, at 2 and at 8 samples per pixel in
    all. Models with -spread were measured with a filter that spreads each sample.
    Time is a multiple of that of Open Image Denoise, on processors with AMX, with
    VNNI and with neither. Each model reads the beauty and the layers of its row.
    Digests identify the weights; every fused EXR has them as msspl/weights.
    """
    from oiio_msspl.aovs.features import RGB
    from oiio_msspl.model.catalogue import QUALITIES, measured, shipped_models
    from oiio_msspl.model.contract import SPREAD, Contract
    from oiio_msspl.model.devices import PROVIDERS, gpu_file, usable_devices
    from oiio_msspl.model.digests import digest

    rows: list[dict[str, Any]] = []
    figures, quality_of = measured(), {family: quality for quality, family in QUALITIES.items()}
    for name, path in shipped_models().items():
        contract = Contract.of_file(path)
        for_gpus = gpu_file(path)
        rows.append(
            {
                "name": name,
                "quality": quality_of.get(name.rpartition("-x")[0].removesuffix(SPREAD)),
                "scale": contract.scale,
                "layers": [feature for feature in contract.hrls if feature != RGB],
                "measured": figures.get(name, {}),
                "size_mb": round(path.stat().st_size / 1e6, 1),
                "files": {"cpu": str(path), "gpu": str(for_gpus or path)},
                "digests": {"cpu": digest(path), "gpu": digest(for_gpus or path)},
                "training_spp": contract.training_spp,
                "provenance": contract.provenance,
            }
        )
    devices = usable_devices()
    if as_json:
        print(json.dumps({"models": rows, "devices": devices}, indent=2))
        return
    header = ("model", "quality", "PSNR", "RelMSE", "time", "layers", "digest", "on GPUs")
    console.table([header, *(_cells(row) for row in rows)], header=True, indent=0)
    print(f"devices: {', '.join(devices)} (of {', '.join(PROVIDERS)})")


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    figures: dict[str, float] = row["measured"]

    def values(form: str, *names: str) -> str:
        return " / ".join(form.format(figures[name]) if name in figures else "-" for name in names)

    return (
        row["name"],
        row["quality"] or "",
        values("{:.2f}", "psnr_2spp", "psnr_8spp"),
        values("{:.4f}", "relmse_2spp", "relmse_8spp"),
        values("{:.2g}", "time_amx", "time_vnni", "time_neither"),
        ", ".join(row["layers"]),
        row["digests"]["cpu"],
        row["digests"]["gpu"],
    )
