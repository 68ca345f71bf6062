# SPDX-License-Identifier: Apache-2.0
"""Where things of this installation are that other programs need: folders for hosts, and msspl-fuse itself."""

from __future__ import annotations

import shutil
import sysconfig
from pathlib import Path


def shipped_folder(name: str) -> Path:
    """A folder that travels with the package: inside it, or in the source tree of an editable installation."""
    package = Path(__file__).resolve().parent
    installed = package / name
    return installed if installed.is_dir() else package.parents[1] / name


def find_msspl_fuse() -> str | None:
    """The program beside this Python: a host is seldom started where a virtual environment is active."""
    return shutil.which("msspl-fuse", path=sysconfig.get_path("scripts")) or shutil.which("msspl-fuse")
