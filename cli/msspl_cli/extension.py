# SPDX-License-Identifier: Apache-2.0
"""Unpacks and finds the extension for Blender, which is no part of this package: it is under another licence."""

from __future__ import annotations

import os
import shutil
import tomllib
import zipfile
from pathlib import Path

import typer

from oiio_msspl import __version__
from oiio_msspl.errors import InputError
from oiio_msspl.exr.atomic import temporary_folder

_MANIFEST = "blender_manifest.toml"


def unpack_extension(file: Path) -> Path:
    """Unpack the extension where :func:`find_extension` looks for it, in the place of an earlier one."""
    folder = _unpacked()
    try:
        with zipfile.ZipFile(file) as content:
            _check_version(content.read(_MANIFEST), file)
            folder.parent.mkdir(parents=True, exist_ok=True)
            with temporary_folder(folder.parent) as new:
                content.extractall(new)
                shutil.rmtree(folder, ignore_errors=True)
                shutil.copytree(new, folder)
    except (KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{file}: is no extension for Blender; name msspl-blender-{__version__}.zip") from error
    except OSError as error:
        raise InputError(f"{error.filename or file}: can't be read or written ({error.strerror or error})") from error
    return folder


def find_extension() -> Path:
    """Return the folder of the extension: that of MSSPL_BLENDER_ADDON, of the source tree, or the unpacked one."""
    source = Path(__file__).resolve().parents[2] / "blender_addon"
    named = os.environ.get("MSSPL_BLENDER_ADDON")
    folder = Path(named) if named else source if source.is_dir() else _unpacked()
    try:
        manifest = (folder / _MANIFEST).read_bytes()
    except OSError as error:
        raise InputError(
            f"{folder}: has no extension for Blender; install it with: msspl blender-install "
            f"msspl-blender-{__version__}.zip"
        ) from error
    _check_version(manifest, folder)
    return folder


def _unpacked() -> Path:
    return Path(typer.get_app_dir("oiio_msspl")) / "blender_addon"


def _check_version(manifest: bytes, where: Path) -> None:
    """Raise InputError unless a manifest is that of our extension, of this version."""
    try:
        entries = tomllib.loads(manifest.decode())
    except ValueError:
        entries = {}
    name, version = entries.get("id"), entries.get("version")
    if (name, version) != ("msspl", __version__):
        raise InputError(
            f"{where}: is version {version} of the extension {name}, and msspl-render needs version {__version__} of "
            "msspl"
        )
