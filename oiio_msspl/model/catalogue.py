# SPDX-License-Identifier: Apache-2.0
"""Models, and what evaluates them."""

from __future__ import annotations

from importlib import resources
from importlib.util import find_spec
from pathlib import Path

from oiio_msspl.errors import InputError
from oiio_msspl.model.oidn import eight_bits_work

#: What ``--model`` is where no other is asked for: ``BEST`` where pyoidn is installed and its weights are of use in 8
#: bits; ``BESIDE`` with any other pyoidn; otherwise ``ALWAYS``.
AUTO, BEST, BESIDE, ALWAYS = "auto", "joint", "mix", "pyramid"


def shipped_models() -> dict[str, Path]:
    """Name -> file of the models inside the package."""
    folder = Path(str(resources.files("oiio_msspl.model").joinpath("weights")))
    return {path.stem: path for path in sorted(folder.glob("*.onnx"))}


def find_model(scale: int, name: str | None = None) -> Path:
    """The model that a name means: ``auto`` (or None), a shipped model, a family of them such as ``paper``, or a file.

    Raises:
        InputError: there is no such model.
    """
    models = shipped_models()
    if name in (None, AUTO):
        name = (BEST if eight_bits_work() else BESIDE) if find_spec("pyoidn") else ALWAYS
    for known in (name, f"{name}-x{scale}"):
        if known in models:
            return models[known]
    if Path(name).is_file():
        return Path(name)
    families = dict.fromkeys(known.rpartition("-x")[0] for known in models)
    raise InputError(f"no model {name!r}: neither a file nor one of {', '.join([*families, *models])}")
