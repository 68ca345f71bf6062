# SPDX-License-Identifier: Apache-2.0
"""The metadata of an ONNX file, without loading the network.

ONNX Runtime gives metadata of loaded networks only, and it refuses to load the `joint` models where pyoidn, which holds
part of their weights, is not installed. An ONNX file is a Protocol Buffers message; this file reads the two kinds of
fields that are needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

#: Field numbers: of a model, its metadata entries; of an entry, its key and its value.
_METADATA_PROPS, _KEY, _VALUE = 14, 1, 2
#: Wire types.
_VARINT, _LENGTH_DELIMITED = 0, 2


def read_metadata(path: Path) -> dict[str, str]:
    """Metadata entries of an ONNX file.

    Raises:
        OSError: the file cannot be read.
        ValueError, IndexError: it is no ONNX file.
    """
    content = memoryview(path.read_bytes())
    entries = [dict(_fields(entry)) for number, entry in _fields(content) if number == _METADATA_PROPS]
    return {str(e[_KEY], "utf-8"): str(e[_VALUE], "utf-8") for e in entries if e.keys() >= {_KEY, _VALUE}}


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and content of each length-delimited field of a message."""
    position = 0

    def varint() -> int:
        nonlocal position
        value = shift = 0
        while True:
            byte = message[position]
            position, value, shift = position + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while position < len(message):
        number, wire_type = divmod(varint(), 8)
        if wire_type == _VARINT:
            varint()
        elif wire_type == _LENGTH_DELIMITED:
            length = varint()
            yield number, message[position : position + length]
            position += length
        else:
            raise ValueError("not an ONNX model")
