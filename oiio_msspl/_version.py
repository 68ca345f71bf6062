# SPDX-License-Identifier: Apache-2.0
"""The package's version, and in a checkout the commit."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

__version__ = "1.0.0"


@functools.cache
def full_version() -> str:
    """Return the version with the commit if the package runs in a checkout: ``1.0.0+0a1b2c3``."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return __version__
    command = ["git", "-C", str(root), "rev-parse", "--short", "HEAD"]
    try:
        commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return __version__
    return f"{__version__}+{commit}"
