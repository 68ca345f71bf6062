# SPDX-License-Identifier: Apache-2.0
"""Pack rendered views into ZIP files for transport, and unpack them.

    python -m research.datagen.shards pack VIEWS SHARDS      # views-000.zip, views-001.zip ... and manifest.json
    python -m research.datagen.shards unpack SHARDS VIEWS

A shard is a ZIP archive with whole views of one split, at most ``LIMIT`` bytes. ``manifest.json`` lists every view with
its shard, scene, split, renderer and version, spp, size, and the assets with their licences. Denoised references are
left out, because :mod:`research.datagen.references` can make them again.
"""

from __future__ import annotations

import argparse
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from oiio_msspl.exr.atomic import replacing
from research.datagen.views import SPLITS, Folder, View

LIMIT = 60_000_000
MANIFEST = "manifest.json"


def describe(view: View) -> dict[str, Any]:
    """The manifest's entry for a view, without the shard."""
    passes, height, width, _ = view.hr.shape
    return {
        "file": view.path.name,
        "split": view.split,
        "scene": view.scene,
        "renderer": view.meta.get("renderer", "unknown"),
        "generator": view.meta.get("generator"),
        "kind": view.meta.get("kind"),
        "size": f"{width}x{height}",
        "spp": {
            "hrls": passes,
            "lrhs_average": int(view.lr_spp.sum()),
            "reference": view.meta.get("ref_spp"),
        },
        "reference_psnr": view.meta.get("ref_psnr"),
        "filter": view.meta.get("filter"),
        "assets": view.meta.get("assets", []),
    }


def grouped(views: list[View], limit: int) -> Iterator[list[View]]:
    """Group consecutive views whose files together have at most ``limit`` bytes.

    Raises:
        SystemExit: a single view is larger than that.
    """
    group: list[View] = []
    size = 0
    for view in views:
        size_of_view = view.path.stat().st_size
        if size_of_view > limit:
            raise SystemExit(f"{view.path}: has {size_of_view} bytes, a shard holds {limit}")
        if group and size + size_of_view > limit:
            yield group
            group, size = [], 0
        group.append(view)
        size += size_of_view
    if group:
        yield group


def pack(views: Path, shards: Path, limit: int = LIMIT) -> None:
    """Write all views of a folder as shards, then the manifest. Shards of an earlier pack are replaced."""
    folder = Folder(views)
    shards.mkdir(parents=True, exist_ok=True)
    entries = []
    groups = [group for split in SPLITS for group in grouped(folder.split(split), limit)]
    for number, group in enumerate(groups):
        name = f"views-{number:03d}.zip"
        with (
            replacing(shards / name, overwrite=True) as temporary,
            zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for view in group:
                archive.write(view.path, view.path.name)
        entries += [{"shard": name} | describe(view) for view in group]
    with replacing(shards / MANIFEST, overwrite=True) as temporary:
        temporary.write_text(json.dumps({"views": entries}, indent=1) + "\n")
    for left_over in set(shards.glob("views-*.zip")) - {shards / entry["shard"] for entry in entries}:
        left_over.unlink()
    scenes = len({entry["scene"] for entry in entries})
    print(f"{len(entries)} views of {scenes} scenes in {len(groups)} shards")


def unpack(shards: Path, views: Path) -> None:
    """Unpack the views that are not in the folder yet.

    Raises:
        SystemExit: there is no manifest, or a shard that it names is missing.
    """
    try:
        entries = json.loads((shards / MANIFEST).read_text())["views"]
    except OSError as error:
        raise SystemExit(f"{shards}: has no {MANIFEST}; make one with `pack`") from error
    views.mkdir(parents=True, exist_ok=True)
    missing = [entry for entry in entries if not (views / entry["file"]).exists()]
    for entry in missing:
        if not (shards / entry["shard"]).exists():
            raise SystemExit(f"{shards / entry['shard']}: is missing; {entry['file']} is in it")
        with (
            zipfile.ZipFile(shards / entry["shard"]) as archive,
            replacing(views / entry["file"]) as temporary,
        ):
            temporary.write_bytes(archive.read(entry["file"]))
    print(f"{len(missing)} views unpacked, {len(entries) - len(missing)} were there")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("pack", "unpack"))
    parser.add_argument("source", type=Path, help="folder of views to pack, or of shards to unpack")
    parser.add_argument("target", type=Path, help="folder to write to")
    args = parser.parse_args()
    {"pack": pack, "unpack": unpack}[args.action](args.source, args.target)


if __name__ == "__main__":
    main()
