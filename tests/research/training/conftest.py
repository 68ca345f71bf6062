# SPDX-License-Identifier: Apache-2.0
"""Training views that are made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from research.datagen import samples, views


@pytest.fixture
def sample_folder(tmp_path: Path) -> Path:
    """A view with samples that all show a grey wall of radiance 0.5, and its file."""
    return write_wall(tmp_path)


def write_wall(
    folder: Path, ref: np.ndarray | None = None, ref_layers: dict[str, np.ndarray] | None = None, split: str = "train"
) -> Path:
    """The view of :func:`sample_folder`, with another reference."""
    rng = np.random.default_rng(0)
    size = samples.SIZE

    def layer(k: int, channels: int, value: float) -> np.ndarray:
        return np.full((k, size, size, channels), value, np.float32)

    def layers(k: int, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        values = {"color": 0.5, "diffuse": 0.4, "specular": 0.1, "albedo": 0.6, "normal": 0.5, "depth": 2.0}
        flat = {name: layer(k, 1 if name == "depth" else 3, values[name]) for name in names}
        return {"place": rng.random((k, size, size, 2), np.float32), **flat}

    cells = views.REF_CELLS * size
    arrays = samples.pack(
        layers(samples.HR_SAMPLES, ("color", "albedo", "normal", "diffuse", "specular", "depth")),
        layers(samples.LR_SAMPLES, ("color", "albedo", "normal")),
        np.full((cells, cells, 3), 0.5, np.float32) if ref is None else ref,
        rng,
        {"seed": 3, "split": split, "renderer": "none", "generator": 0},
        ref_layers,
    )
    views.save(folder / f"mitsuba-000003-0{views.SAMPLES_SUFFIX}", arrays)
    return folder
