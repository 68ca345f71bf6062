# SPDX-License-Identifier: Apache-2.0
"""The extension is built as a zip, and ``msspl blender-install`` puts it where msspl-render finds it."""

import os
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
from msspl_cli import extension

from oiio_msspl import __version__
from oiio_msspl.errors import InputError
from tests.blender_addon.conftest import posix

ADDON = Path(__file__).resolve().parents[2] / "blender_addon"


def build(folder):
    command = [sys.executable, ADDON / "build_zip.py", folder]
    return Path(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip())


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package that is not in a source tree, and the home of a user without Blender."""
    monkeypatch.setattr(extension, "__file__", str(tmp_path / "site-packages/msspl_cli/extension.py"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "config"))
    monkeypatch.delenv("MSSPL_BLENDER_ADDON", raising=False)


def test_two_builds_are_equal_and_hold_the_extension_alone(tmp_path):
    first, second = build(tmp_path / "a"), build(tmp_path / "b")
    assert first.name == f"msspl-blender-{__version__}.zip"
    assert first.read_bytes() == second.read_bytes()
    with ZipFile(first) as file:
        names = set(file.namelist())
        assert names == {path.name for path in ADDON.iterdir() if path.is_file()} - {"build_zip.py"}
        assert {"LICENSE", "blender_manifest.toml", "__init__.py", "headless.py"} <= names


def test_the_extension_is_found_once_it_is_unpacked(installed, tmp_path):
    with pytest.raises(InputError, match=f"install it with: msspl blender-install msspl-blender-{__version__}.zip"):
        extension.find_extension()
    folder = extension.unpack_extension(build(tmp_path))
    (folder / "stale.py").touch()
    assert extension.unpack_extension(build(tmp_path)) == folder == extension.find_extension()
    assert (folder / "headless.py").read_bytes() == (ADDON / "headless.py").read_bytes()
    assert not (folder / "stale.py").exists()
    assert [path.name for path in folder.parent.iterdir()] == ["blender_addon"]


def test_a_studio_names_the_folder(installed, tmp_path, monkeypatch):
    monkeypatch.setenv("MSSPL_BLENDER_ADDON", str(ADDON))
    assert extension.find_extension() == ADDON


def test_another_version_and_another_zip_are_refused(installed, tmp_path, monkeypatch):
    extension.unpack_extension(build(tmp_path))
    monkeypatch.setattr(extension, "__version__", "9.0.0")
    for find in (extension.find_extension, lambda: extension.unpack_extension(build(tmp_path))):
        with pytest.raises(
            InputError, match=f"is version {__version__} of the extension msspl, and .* needs version 9"
        ):
            find()
    with ZipFile(tmp_path / "other.zip", "w") as file:
        file.writestr("readme.txt", "")
    (tmp_path / "text.zip").write_text("no zip")
    for name in ("other.zip", "text.zip"):
        with pytest.raises(InputError, match=f"{name}: is no extension for Blender; name msspl-blender-9.0.0.zip"):
            extension.unpack_extension(tmp_path / name)
    with pytest.raises(InputError, match=r"gone.zip: can't be read"):
        extension.unpack_extension(tmp_path / "gone.zip")


@posix
@pytest.mark.parametrize(
    ("code", "message"), [(0, "the buttons are in Properties"), (1, "can't install the extension")]
)
def test_blender_gets_the_zip(tmp_path, code, message):
    """Blender's own command installs it for the buttons."""
    blender, file = tmp_path / "blender", build(tmp_path)
    blender.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/arguments\nexit {code}\n')
    blender.chmod(0o755)
    program = "import sys; from msspl_cli.app import msspl as main; sys.argv[0] = 'msspl'; main()"
    command = [sys.executable, "-c", program, "blender-install", file, "--blender", blender]
    home = {**os.environ, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    done = subprocess.run(command, capture_output=True, text=True, env=home)
    assert done.returncode == code and message in done.stdout + done.stderr
    arguments = (tmp_path / "arguments").read_text().split()
    assert arguments == ["--command", "extension", "install-file", "-r", "user_default", "-e", str(file)]
    assert (tmp_path / "config/oiio_msspl/blender_addon/headless.py").is_file()
