# SPDX-License-Identifier: Apache-2.0
"""Finds parts of this installation that other programs need: the folders for hosts, and msspl-fuse."""

from __future__ import annotations

import shutil
import sysconfig
from pathlib import Path


def shipped_folder(name: str) -> Path:
    """Return a folder shipped with the package: inside it, or in the source tree of an editable installation."""
    package = Path(__file__).resolve().parent
    installed = package / name
    return installed if installed.is_dir() else package.parents[1] / name


def find_msspl_fuse() -> str | None:
    """Find msspl-fuse beside this Python, or else on the path: hosts seldom run in an activated environment."""
    return shutil.which("msspl-fuse", path=sysconfig.get_path("scripts")) or shutil.which("msspl-fuse")
