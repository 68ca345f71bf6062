# SPDX-License-Identifier: Apache-2.0
"""The add-on is GPL code beside Apache code, so the two meet only through the command line."""

import ast
import tomllib
from pathlib import Path

from oiio_msspl import __version__

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "blender_addon"
GPL = "# SPDX-License-Identifier: GPL-3.0-or-later\n"


def imported_modules(path):
    """Names of the top-level modules that a file imports."""
    names = set()
    for statement in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(statement, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in statement.names}
        elif isinstance(statement, ast.ImportFrom) and not statement.level:
            names.add(str(statement.module).partition(".")[0])
    return names


def test_files_of_the_add_on_are_gpl_and_import_nothing_of_the_core():
    for path in [*ADDON.rglob("*.py"), *(ROOT / "tests" / "blender_addon" / "in_blender").glob("*.py")]:
        assert path.read_text(encoding="utf-8").startswith(GPL), path
        assert not imported_modules(path) & {"oiio_msspl", "msspl_cli"}, path
    assert "GNU GENERAL PUBLIC LICENSE" in (ADDON / "LICENSE").read_text()


def test_every_file_that_imports_bpy_is_gpl():
    folders = ("oiio_msspl", "cli", "nuke_gizmo", "blender_addon", "research", "tests")
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        if imported_modules(path) & {"bpy", "bl_ext"}:
            assert path.read_text(encoding="utf-8").startswith(GPL), path


def test_the_manifest_has_the_version_and_the_licence_of_the_project():
    manifest = (ADDON / "blender_manifest.toml").read_text(encoding="utf-8")
    assert manifest.startswith(GPL)
    assert tomllib.loads(manifest)["version"] == __version__
    assert tomllib.loads(manifest)["license"] == ["SPDX:GPL-3.0-or-later"]
