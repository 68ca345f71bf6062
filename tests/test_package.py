# SPDX-License-Identifier: Apache-2.0
"""What is published: the wheel under one licence, and a source archive, both of a size that an index takes."""

import tarfile
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 70e6


def build(kind, folder):
    """Build a package as pip does, and return its path."""
    builders = pytest.importorskip(f"hatchling.builders.{kind}")
    builder = getattr(builders, {"wheel": "WheelBuilder", "sdist": "SdistBuilder"}[kind])
    return Path(next(builder(str(ROOT)).build(directory=str(folder))))


def test_the_wheel_is_small_and_under_one_licence(tmp_path):
    wheel = build("wheel", tmp_path)
    assert wheel.stat().st_size <= LARGEST
    with ZipFile(wheel) as file:
        names = file.namelist()
        (metadata,) = (file.read(name).decode() for name in names if name.endswith(".dist-info/METADATA"))
        sources = {name: file.read(name) for name in names if name.endswith((".py", ".toml"))}
    assert "License-Expression: Apache-2.0\n" in metadata
    assert not [
        name for name, text in sources.items() if b"SPDX-License-Identifier: GPL" in text or b"import bpy" in text
    ]
    assert not [name for name in names if "blender_addon" in name]
    assert {"msspl_cli/nuke_gizmo/MSSPLFuse.gizmo", "oiio_msspl/model/weights/joint-x2.onnx"} <= set(names)


def test_the_source_archive_is_small_and_has_the_extension_for_blender(tmp_path):
    archive = build("sdist", tmp_path)
    assert archive.stat().st_size < LARGEST
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    assert {"blender_addon/headless.py", "blender_addon/LICENSE", "LICENSE", "NOTICE", "pyproject.toml"} <= names
    assert not [name for name in names if name.endswith(".pt")]
