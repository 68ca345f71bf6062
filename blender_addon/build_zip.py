# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the extension as a zip, without Blender: ``python blender_addon/build_zip.py [FOLDER]``.

The zip depends on the sources alone, so two builds of one commit are equal.
"""

import sys
import tomllib
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

SOURCE = Path(__file__).resolve().parent


def build_zip(folder: Path) -> Path:
    """Write ``msspl-blender-VERSION.zip`` into a folder, which is made, and return its path."""
    manifest = tomllib.loads((SOURCE / "blender_manifest.toml").read_text(encoding="utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"msspl-blender-{manifest['version']}.zip"
    with ZipFile(path, "w") as file:
        for source in sorted(SOURCE.iterdir()):
            if source.is_file() and source.name != Path(__file__).name:
                file.writestr(ZipInfo(source.name), source.read_bytes(), ZIP_DEFLATED)
    return path


if __name__ == "__main__":
    print(build_zip(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")))
