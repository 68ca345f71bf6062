# SPDX-License-Identifier: Apache-2.0
"""What a model needs and was made from, stored in the ONNX file's own metadata.

Training writes it, inference reads it, and refuses a file whose contract it can't honour: so the two cannot disagree
about scale, channel order, transforms or defaults.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import ALBEDO, DEFAULTS, HRLS_FEATURES, LRHS_FEATURES, NORMAL, RGB, channel_names
from oiio_msspl.errors import InputError
from oiio_msspl.model.encoding import KEY, MAX_ALBEDO, MAX_RADIANCE, MU

#: What some models read after both of the above: another denoiser's results (:mod:`oiio_msspl.model.oidn`).
DENOISED_FEATURES: dict[str, int] = {"denoised": 3}

SCALES = (2, 4, 8)


def network_inputs(denoiser: str) -> tuple[dict[str, int], dict[str, int]]:
    """What a model reads of the LRHS and of the HRLS, with a mode of :func:`oiio_msspl.model.oidn.denoiser_for`."""
    low = DENOISED_FEATURES if denoiser else {}
    if denoiser == "together":  # and it denoises the HRLS itself, from the layers that denoisers read
        return LRHS_FEATURES | low, {name: HRLS_FEATURES[name] for name in (RGB, ALBEDO, NORMAL)}
    return LRHS_FEATURES | low, HRLS_FEATURES | low


#: Key of the metadata entry in the ONNX file.
METADATA_KEY = "msspl"
#: Raised when the meaning of a field changes; a newer file is refused by older code.
FORMAT = 1


def current_transforms() -> dict[str, Any]:
    """The transforms that this version of the code applies, as the contract records them."""
    return {
        "curve": "log1p",
        "mu": MU,
        "key": KEY,
        "max_radiance": MAX_RADIANCE,
        "max_albedo": MAX_ALBEDO,
    }


@dataclass(frozen=True)
class Contract:
    """Everything that inference must know about a model.

    ONNX inputs: ``lrhs`` (1, C_l, h, w) and ``hrls`` (1, C_h, s*h, s*w), float32, transformed;
    output: ``fused`` (1, 3, s*h, s*w), transformed RGB; of some models also ``log_error`` (1, 1, s*h, s*w), the
    logarithm of its expected absolute error, mean of the channels, in the same values.
    """

    name: str
    """Short name, e.g. ``paper-x4``."""
    scale: int
    """Upsampling factor s: 2, 4 or 8."""
    alignment: int = 1
    """Height and width of the LRHS must be multiples of this, in LRHS pixels."""
    overlap: int = 24
    """LRHS pixels that neighbouring tiles share on each side: the network's receptive field, or what of it matters.
    A multiple of ``alignment``."""
    bytes_per_pixel: int = 1000
    """Peak memory of a tile for each of its HRLS pixels, rounded up: bounds the tile size."""
    lrhs: list[str] = field(default_factory=lambda: channel_names(LRHS_FEATURES))
    hrls: list[str] = field(default_factory=lambda: channel_names(HRLS_FEATURES))
    transforms: dict[str, Any] = field(default_factory=current_transforms)
    defaults: dict[str, float] = field(default_factory=lambda: dict(DEFAULTS))
    denoiser: str = ""
    """What is denoised for the model, a mode of :func:`oiio_msspl.model.oidn.denoiser_for`; empty: nothing."""
    weights: str = ""
    """A key of :data:`oiio_msspl.model.oidn_weights.NETWORKS` whose weights the file leaves open; empty: it has its own."""
    training_spp: dict[str, list[int]] = field(default_factory=dict)
    """Lowest and highest spp seen in training: ``{"hrls": [1, 8], "lrhs": [4, 64]}``."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where the weights come from: data, steps, loss, seed, date, code version."""
    format: int = FORMAT

    @property
    def features(self) -> dict[str, int]:
        """What it reads of the HRLS as it was rendered, with the number of channels."""
        return {
            name: count for name, count in HRLS_FEATURES.items() if any(c.startswith(f"{name}.") for c in self.hrls)
        }

    def to_json(self) -> str:
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def of_file(cls, path: str | Path) -> Contract:
        """The contract of an ONNX file, of which no more is read than its metadata: what its model needs to run need
        not be there.

        Raises:
            InputError: no such file, no ONNX file, or no contract that this version can honour.
        """
        try:
            metadata = _metadata(Path(path))
        except (OSError, ValueError, IndexError) as error:
            raise InputError(f"{path}: can't be read as an ONNX file ({error})") from error
        if METADATA_KEY not in metadata:
            raise InputError(f"{path}: has no '{METADATA_KEY}' metadata; make it with python -m training.export")
        return cls.from_json(metadata[METADATA_KEY], str(path))

    @classmethod
    def from_json(cls, text: str, source: str) -> Contract:
        """Read a contract; ``source`` names the model file in errors.

        Raises:
            InputError: it is no contract, or one that this version can't honour.
        """
        try:
            contract = cls(**json.loads(text))
        except (ValueError, TypeError) as error:
            raise InputError(
                f"{source}: the '{METADATA_KEY}' metadata can't be read ({error}); export it again"
            ) from error
        if contract.format != FORMAT:
            raise InputError(
                f"{source}: contract format {contract.format}, this version reads {FORMAT}; update one of them"
            )
        lrhs, hrls = network_inputs(contract.denoiser)
        expected = {
            "lrhs": channel_names(lrhs),
            "hrls": channel_names(hrls),
            "transforms": current_transforms(),
            "defaults": DEFAULTS,
        }
        for key, value in expected.items():
            if getattr(contract, key) != value:
                raise InputError(
                    f"{source}: made for {key} {getattr(contract, key)}, this version has {value}; export it again"
                )
        if contract.overlap % contract.alignment:
            raise InputError(
                f"{source}: an overlap of {contract.overlap} is no multiple of its alignment, {contract.alignment}; "
                "export it again"
            )
        if contract.scale not in SCALES:
            raise InputError(f"{source}: scale {contract.scale} is none of {SCALES}")
        return contract


#: Numbers that Protocol Buffers' fields have in ONNX: of a model, its metadata; of an entry, its key and its value.
_METADATA, _KEY, _VALUE = 14, 1, 2
#: How a field is written.
_INTEGER, _BYTES = 0, 2


def _metadata(path: Path) -> dict[str, str]:
    """Metadata of an ONNX file. ONNX Runtime would load the whole model to read it, and refuse one whose weights are
    left open."""
    content = memoryview(path.read_bytes())
    entries = [dict(_fields(entry)) for number, entry in _fields(content) if number == _METADATA]
    return {str(e[_KEY], "utf-8"): str(e[_VALUE], "utf-8") for e in entries if e.keys() >= {_KEY, _VALUE}}


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and content of a Protocol Buffers message's fields; of those that are no integers."""
    position = 0

    def integer() -> int:
        nonlocal position
        value = shift = 0
        while True:
            byte = message[position]
            position, value, shift = position + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    while position < len(message):
        number, kind = divmod(integer(), 8)
        if kind == _INTEGER:
            integer()
        elif kind == _BYTES:
            length = integer()
            yield number, message[position : position + length]
            position += length
        else:
            raise ValueError("no message of a model")
