# SPDX-License-Identifier: Apache-2.0
"""``msspl models``."""

from __future__ import annotations

import json
from typing import Any

from msspl_cli import console, options

EXAMPLES = """[bold]Examples[/bold]

  msspl models

  msspl models --json
"""


def models(as_json: options.Json = False, debug: options.Debug = False, help_all: options.HelpAll = False) -> None:
    """List the models in the package, and the devices on which they can run."""
    from oiio_msspl.model.catalogue import shipped_models
    from oiio_msspl.model.contract import Contract
    from oiio_msspl.model.devices import PROVIDERS, gpu_file, usable_devices

    rows: list[dict[str, Any]] = []
    for name, path in shipped_models().items():
        contract = Contract.of_file(path)
        for_gpus = gpu_file(path)
        rows.append(
            {
                "name": name,
                "scale": contract.scale,
                "size_mb": round(path.stat().st_size / 1e6, 1),
                "files": {"cpu": str(path), "gpu": str(for_gpus or path)},
                "training_spp": contract.training_spp,
                "provenance": contract.provenance,
            }
        )
    devices = usable_devices()
    if as_json:
        print(json.dumps({"models": rows, "devices": devices}, indent=2))
        return
    header = ("model", "scale", "size", "file for GPUs", "trained LRHS spp", "trained HRLS spp")
    spans = [["{}-{}".format(*row["training_spp"].get(key, ("?", "?"))) for key in ("lrhs", "hrls")] for row in rows]
    console.table(
        [
            header,
            *(
                (r["name"], f"x{r['scale']}", f"{r['size_mb']} MB", _for_gpus(r["files"]), *s)
                for r, s in zip(rows, spans, strict=True)
            ),
        ],
        header=True,
        indent=0,
    )
    print(f"devices: {', '.join(devices)} (of {', '.join(PROVIDERS)})")


def _for_gpus(files: dict[str, str]) -> str:
    return "the same" if files["gpu"] == files["cpu"] else "of its own, half floats"
