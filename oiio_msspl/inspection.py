# SPDX-License-Identifier: Apache-2.0
"""What a file holds and what the network would read of it, as facts for a person and for a machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.aovs.mapped_render import MappedRender, unread_layers
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.errors import InputError
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.exr.render import Window
from oiio_msspl.jobs.frame import InputOptions


@dataclass
class Inspection:
    """Result of :func:`inspect_file`. ``problems`` is empty for a file that can be used."""

    path: Path
    file: ExrFile | None = None
    resolution: MappedRender | None = None
    facts: list[str] = field(default_factory=list)
    passed_through: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        result: dict[str, Any] = {"file": str(self.path), "usable": not self.problems, "problems": self.problems}
        if self.file is not None:
            result |= {
                "display_window": str(self.file.display_window),
                "pixel_aspect": self.file.pixel_aspect,
                "parts": [
                    {
                        "name": part.name,
                        "view": part.view,
                        "data_window": str(part.data_window),
                        "compression": part.compression,
                        "tiled": part.tile != (0, 0),
                        "deep": part.deep,
                        "channels": {c.name: c.type for c in part.channels},
                    }
                    for part in self.file.parts
                ],
            }
        if self.resolution is not None:
            result |= {
                "renderer": self.resolution.renderer,
                "view": self.resolution.view or None,
                "other_views": self.resolution.other_views,
                "spp": self.resolution.spp,
                "aovs": self.resolution.table(),
                "notes": self.resolution.notes,
                "passed_through": self.passed_through,
            }
        return result


def inspect_file(path: Path, inputs: InputOptions) -> Inspection:
    """Open a file, map its layers and read its pixels once; what goes wrong is noted, never raised."""
    result = Inspection(path)
    try:
        file = result.file = open_exr(path)
        result.facts = _facts(file)
        resolution = result.resolution = map_render(file, inputs.mapping, view=inputs.view, spp=inputs.hr_spp)
        others = f"; also {', '.join(resolution.other_views)} (--view-layer)" if resolution.other_views else ""
        spp = "unknown spp" if resolution.spp is None else f"{resolution.spp:g} spp"
        view = f", {resolution.view}{others}" if resolution.view else others
        result.facts.append(f"renderer: {resolution.renderer}, {spp}{view}")
        result.passed_through = unread_layers(file, resolution)
        result.facts += _pixels(resolution)
    except InputError as error:
        result.problems.append(str(error).removeprefix(f"{path}: "))
    return result


def _facts(file: ExrFile) -> list[str]:
    aspect = "" if file.pixel_aspect == 1 else f", pixel aspect {file.pixel_aspect:g}"
    facts = [f"display window {file.display_window}{aspect}"]
    shapes: dict[str, list[str]] = {}
    for part in file.parts:
        kind = "deep" if part.deep else f"tiled {part.tile[0]}x{part.tile[1]}" if part.tile != (0, 0) else "scan lines"
        types = "/".join(sorted({c.type for c in part.channels}))
        window = "" if part.data_window == file.display_window else f", data window {part.data_window}"
        shape = f"{types}, {part.compression}, {kind}{window}"
        shapes.setdefault(shape, []).append(part.name or "unnamed")
    for shape, names in shapes.items():
        which = (
            names[0]
            if len(names) == 1
            else f"{len(names)} parts ({', '.join(names[:4])}{', ...' if len(names) > 4 else ''})"
        )
        facts.append(f"{'part ' if len(names) == 1 else ''}{which}: {shape}")
    return facts


def _pixels(resolution: MappedRender) -> list[str]:
    """Read every feature once, in bands: is it there, finite and not black?"""
    window = resolution.data_window
    brightest: dict[str, float] = {}
    unusable: dict[str, int] = {}
    for y in range(window.y0, window.y1, 256):
        for name, values in resolution.read(Window(window.x0, y, window.x1, min(y + 256, window.y1))).items():
            finite = np.isfinite(values)
            unusable[name] = unusable.get(name, 0) + int(values.size - np.count_nonzero(finite))
            brightest[name] = max(brightest.get(name, 0.0), float(np.abs(values[finite]).max(initial=0.0)))
    facts = [
        f"{name}: {count} values are NaN or infinite; fusing repairs them" for name, count in unusable.items() if count
    ]
    if brightest["rgb"] == 0:
        filled = [name for name, value in brightest.items() if value > 0 and name != "alpha"]
        raise InputError(
            "the beauty is black everywhere"
            + (f", though {', '.join(filled)} are not; check which layer it is (--map rgb=LAYER)" if filled else "")
        )
    return facts + [f"{name}: all zero" for name, value in brightest.items() if value == 0]
