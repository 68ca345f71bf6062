# SPDX-License-Identifier: Apache-2.0
"""Store what the models of a folder have in common once.

    python -m research.training.share oiio_msspl/model/weights

Two exports write the same tensor twice: the weights of all scales of a network, denoisers, the table of the PU curve.
This moves such tensors into files that all of these models name. The tensors keep their bytes, so
pixels stay as they are, and so do measurements: the tables of the benchmarks get the new digests. Run it after the last
export; a second run changes nothing.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from itertools import takewhile
from pathlib import Path

import onnx
from onnx.external_data_helper import ExternalDataInfo, set_external_data

from oiio_msspl.model.devices import GPU_FOLDER
from oiio_msspl.model.digests import digest
from research.benchmarks import results

#: Bytes of the smallest tensor that is moved. Models need smaller ones to infer shapes.
SMALLEST = 4096
#: Tensors begin at multiples of this.
ALIGNMENT = 64


#: Where a tensor lies: its file, and the offset in it; 0 in an ONNX file.
Place = tuple[str, int]


def share(folder: Path) -> None:
    """Rewrite the ONNX and weights files of a folder so that no large tensor is stored twice."""
    models = {path: onnx.load(path, load_external_data=False) for path in sorted(folder.glob("*.onnx"))}
    places: dict[bytes, set[Place]] = defaultdict(set)
    tensors: list[tuple[onnx.TensorProto, bytes]] = []
    for path, model in models.items():
        for tensor in model.graph.initializer:
            place, data = _stored(path, tensor)
            if place[0] != path.name or len(data) >= SMALLEST:
                places[data].add(place)
                tensors.append((tensor, data))
    files: dict[str, bytearray] = defaultdict(bytearray)
    offsets: dict[bytes, tuple[str, int]] = {}
    for tensor, data in tensors:
        owners = [file for file, _ in places[data]]
        if len(owners) == 1 and owners[0].endswith(".onnx"):
            continue  # only this model has it
        if data not in offsets:
            name = _name_of_shared(set(owners))
            content = files[name]
            content += bytes(-len(content) % ALIGNMENT)
            offsets[data] = name, len(content)
            content += data
        name, offset = offsets[data]
        tensor.raw_data = data  # set_external_data wants it
        set_external_data(tensor, name, offset, len(data))
        tensor.ClearField("raw_data")
    for path in folder.glob("*.weights"):
        path.unlink()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    for path, model in models.items():
        path.write_bytes(model.SerializeToString())


def _stored(path: Path, tensor: onnx.TensorProto) -> tuple[Place, bytes]:
    """Return where a tensor of a model lies, and its bytes."""
    if tensor.data_location != onnx.TensorProto.EXTERNAL:
        return (path.name, 0), tensor.raw_data
    info = ExternalDataInfo(tensor)
    with (path.parent / info.location).open("rb") as file:
        file.seek(info.offset or 0)
        return (info.location, info.offset or 0), file.read(info.length)


def _name_of_shared(owners: set[str]) -> str:
    """Name the file for tensors that these files have: after what their names have in common."""
    if len(owners) == 1:
        return owners.pop()
    letters = takewhile(lambda column: len(set(column)) == 1, zip(*owners, strict=False))
    common = "".join(column[0] for column in letters).rstrip("-_.x")
    return f"{common}_shared.weights" if common else "shared.weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    before = {path: digest(path) for path in args.folder.rglob("*.onnx")}
    for folder in (args.folder, args.folder / GPU_FOLDER):
        share(folder)
        size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
        print(f"{folder}: {size / 1e6:.1f} MB")
    for table in results.FOLDER.glob("*.csv"):
        text = table.read_text(encoding="utf-8")
        for path, old in before.items():
            text = text.replace(f",{old},", f",{digest(path)},")
        table.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
