# SPDX-License-Identifier: Apache-2.0
"""Digests that identify the weights of models."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from oiio_msspl.model.devices import file_for


def digest(path: Path) -> str:
    """Return 12 hexadecimal digits that identify a model: SHA-256 over its ONNX file and the weights files it names.

    The weights files, ``*.weights``, lie beside the ONNX file and are read in the order of their names.

    Raises:
        FileNotFoundError: the ONNX file or one of its weights files is missing.
    """
    content = path.read_bytes()
    made = hashlib.sha256(content)
    for name in sorted(set(re.findall(rb"[\w.-]+\.weights", content))):
        made.update((path.parent / name.decode()).read_bytes())
    return made.hexdigest()[:12]


def digests(models: Iterable[Path], device: str) -> dict[str, str]:
    """Return the digest of each model's file for a device, by the model's name; ``models`` are the files for CPUs."""
    return {path.stem: digest(file_for(path, device)) for path in models}


def as_text(weights: Mapping[str, str]) -> str:
    """Write :func:`digests` in one line: ``joint-x2 0123456789ab, ...``."""
    return ", ".join(f"{name} {digits}" for name, digits in weights.items())
