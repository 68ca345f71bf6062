# SPDX-License-Identifier: Apache-2.0
"""The models inside the package, and the model that a name stands for."""

from __future__ import annotations

import csv
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.model.contract import CLEAN, ONE_SIZE, SCALES, SPREAD
from oiio_msspl.model.session import Session

#: Folder of the models: ``NAME.onnx`` for each.
WEIGHTS = Path(__file__).parent / "weights"
#: Table of :func:`measured`.
MEASURED = WEIGHTS / "measured.csv"
#: Quality -> family of models, from the fastest to the most accurate.
QUALITIES = {"fast": "joint-small", "balanced": "joint", "best": "joint-large"}
#: The model that fuses passes at half of the frame's resolution, and nothing else; also with ``-spread``.
MEAN_MODEL = "mean"
#: The name that stands for the default quality.
AUTO, DEFAULT_QUALITY = "auto", "balanced"


def shipped_models() -> dict[str, Path]:
    """Return the ONNX files of all models for renders inside the package, by name (``paper-x4``)."""
    return {path.stem: path for path in sorted(WEIGHTS.glob("*.onnx")) if not path.stem.startswith(MEAN_MODEL)}


def measured() -> dict[str, dict[str, float]]:
    """Read accuracy and time of the shipped models, by name, as ``research.benchmarks.tables`` wrote them.

    PSNR in dB and RelMSE are means of the development scenes. The time is a multiple of Open Image Denoise's. Figures
    that were not measured are absent.
    """
    with MEASURED.open(newline="") as file:
        return {
            row.pop("model"): {name: float(value) for name, value in row.items() if value}
            for row in csv.DictReader(file)
        }


def family_of(name: str | None) -> str | None:
    """Return the family that a quality, ``auto`` or None stands for; None for other names, which are models already."""
    return QUALITIES.get(DEFAULT_QUALITY if name in (None, AUTO) else name)


def for_spread_noise(name: str) -> str | None:
    """Return the counterpart of a family or shipped model that was trained for noise that a pixel filter has spread.

    None if there is none, or if ``name`` is one itself.
    """
    models = shipped_models()
    family = name.rpartition("-x")[0] if name in models else name
    return family + SPREAD if any(model.startswith(f"{family}{SPREAD}-x") for model in models) else None


def for_little_noise(family: str, scale: int) -> str | None:
    """Return the counterpart of a family for renders with little noise; None if there is none at a scale."""
    return family + CLEAN if f"{family}{CLEAN}-x{scale}" in shipped_models() else None


def find_model(scale: int, name: str | None = None) -> Path:
    """Return the ONNX file of a model.

    Args:
        scale: 1 for one render or two of one size; 2, 4 or 8.
        name: a quality, ``auto`` or None for the default quality, a family (``paper``), a model (``paper-x4``), or an
            ONNX file.

    Raises:
        InputError: there is no such model.
    """
    models = shipped_models()
    name = family_of(name) or name
    assert name is not None
    for model in (name, f"{name}-x{scale}"):
        if model in models:
            return models[model]
    if Path(name).is_file():
        return Path(name)
    if scale not in (ONE_SIZE, *SCALES):
        scales = ", ".join(f"x{s}" for s in (ONE_SIZE, *SCALES))
        raise InputError(f"there is no model for x{scale}; the scales are {scales}")
    families = dict.fromkeys(model.rpartition("-x")[0] for model in models)
    if name in families:  # the paper's method is about two sizes
        raise InputError(f"the model {name} needs a low-resolution render; --quality takes one for renders of one size")
    raise InputError(f"no model {name!r}: neither a file nor one of {', '.join([*families, *models])}")


def model_files(scale: int, name: str | None = None) -> list[Path]:
    """Return the ONNX files that fuse frames: the model of :func:`find_model`, and those that fuse passes beside it.

    Only models of quality ``best`` fuse passes by a network: by a fast one, because there are many passes. At x2
    another one fuses passes at half of the frame's resolution.
    """
    path = find_model(scale, name)
    if path.parent != WEIGHTS or not path.stem.startswith(QUALITIES["best"]):
        return [path]
    spread = SPREAD if SPREAD in path.stem else ""
    half = [WEIGHTS / f"{MEAN_MODEL}{spread}-x1.onnx"] if scale == 2 else []
    return [path, find_model(scale, QUALITIES["fast"] + spread), *half]


def load_model(scale: int, name: str | None = None, device: str = "cpu", threads: int = 0) -> Session:
    """Load a model of :func:`find_model` as a :class:`oiio_msspl.model.session.Session`.

    Raises:
        InputError: there is no such model, or it can't run on this device.
    """
    path, *layers = model_files(scale, name)
    return Session(path, device, threads, layers=layers)
