# SPDX-License-Identifier: Apache-2.0
"""The contract of a model: what it needs and how it was made, as JSON in the metadata of its ONNX file.

Training writes the contract and inference reads it. A file whose contract does not fit this version of the code is
refused, so that training and inference cannot disagree on scale, channel order, encoding or defaults.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from oiio_msspl.aovs.features import DEFAULTS, FEATURES, HRLS_FEATURES, RGB
from oiio_msspl.errors import InputError
from oiio_msspl.model.encoding import KEY, MAX_ALBEDO, MAX_RADIANCE, MU
from oiio_msspl.model.runtime import Network, load_network

#: Upsampling factors from the LRHS to the HRLS; and the scale of one render, or of two renders of one size.
SCALES = (2, 4, 8)
ONE_SIZE = 1

#: Ending of the names of models for renders whose pixel filter has spread the noise.
SPREAD = "-spread"
#: Ending of the names of models for renders with little noise.
CLEAN = "-clean"
#: Values of ``Contract.denoiser``: none; a denoiser of both renders' mean; a small one. ``SPREAD`` may follow.
NO_DENOISER, MEAN_DENOISER, SMALL_MEAN_DENOISER = "", "mean", "mean-small"
DENOISERS = tuple(kind + noise for kind in (MEAN_DENOISER, SMALL_MEAN_DENOISER) for noise in ("", SPREAD))

#: Key of the contract in the metadata of an ONNX file.
METADATA_KEY = "msspl"
#: Raised when the meaning of a field changes; older code refuses newer files.
FORMAT = 2


def current_transforms() -> dict[str, Any]:
    """Return the constants of :mod:`oiio_msspl.model.encoding`, as the contract records them."""
    return {"curve": "log1p", "mu": MU, "key": KEY, "max_radiance": MAX_RADIANCE, "max_albedo": MAX_ALBEDO}


@dataclass(frozen=True)
class Contract:
    """The properties of a model that inference must know.

    ONNX inputs, float32, see :attr:`inputs`:

    - ``lrhs.rgb`` (1, 3, h, w), and ``hrls.rgb`` (1, 3, s*h, s*w): scene linear, finite and >= 0. The model clips
      values that are too bright.
    - ``hrls.albedo`` and so on: further features, in the units of :mod:`oiio_msspl.aovs.features`.
    - ``exposure``: a number that multiplies radiance, see :func:`oiio_msspl.model.encoding.find_exposure`.
    - ``share.rgb``: weight of the LRHS in the mean of both renders, in [0, 1], if the model denoises that mean. It is
      0 for one render, which is given as both.
      ``share.albedo`` and ``share.normal``: its weight for these features, if the model reads those of the LRHS.

    Output: ``fused`` (1, 3, s*h, s*w), scene linear, finite and >= 0. Some models also have ``log_error``
    (1, 1, s*h, s*w): the natural logarithm of the expected absolute error of the log-encoded RGB, mean of the channels.
    Some have ``albedo`` and ``normal`` (1, 3, s*h, s*w): those of the HRLS without noise, in [0, 1]; a normal n as
    (n + 1) / 2.
    """

    name: str
    """Short name, e.g. ``paper-x4``."""
    scale: int
    """Upsampling factor s: 2, 4 or 8; ``ONE_SIZE`` for one render, or two of one size."""
    alignment: int = 1
    """Height and width of the LRHS input are multiples of this many pixels."""
    overlap: int = 24
    """LRHS pixels that a tile adds to its core on each side, rounded up to a multiple of ``alignment``. Measured by
    training: the part of the receptive field that changes results."""
    bytes_per_pixel: int = 1000
    """Peak memory of a tile for each of its HRLS pixels, rounded up. It decides the size of tiles, so other values
    change the result a little."""
    lrhs: list[str] = field(default_factory=lambda: [RGB])
    """Features of the LRHS that the model reads."""
    hrls: list[str] = field(default_factory=lambda: list(FEATURES))
    """Features of the HRLS that the model reads."""
    transforms: dict[str, Any] = field(default_factory=current_transforms)
    """See :func:`current_transforms`."""
    defaults: dict[str, float] = field(default_factory=lambda: dict(DEFAULTS))
    """Encoded values of missing features."""
    denoiser: str = NO_DENOISER
    """The network that denoises the mean of both renders: ``NO_DENOISER`` or one of ``DENOISERS``."""
    training_spp: dict[str, list[int]] = field(default_factory=dict)
    """Lowest and highest spp in training: ``{"hrls": [1, 8], "lrhs": [4, 64]}``."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """How the weights were made: data, steps, loss, seed, date, code version."""
    format: int = FORMAT

    @property
    def inputs(self) -> dict[str, int]:
        """Inputs of the model in order, with their numbers of channels; 0 for those that are numbers."""
        images = [f"lrhs.{name}" for name in self.lrhs] + [f"hrls.{name}" for name in self.hrls]
        shares = [f"share.{name}" for name in self.lrhs] if self.denoiser else []
        return {name: HRLS_FEATURES[name[5:]] for name in images} | dict.fromkeys(["exposure", *shares], 0)

    def _wrong_field(self) -> str | None:
        """Return the name of a field whose value has a wrong type or is out of range; None if all are valid."""
        spans = {"alignment": (1, 1024), "overlap": (0, 4096), "bytes_per_pixel": (1, 10**6)}
        valid = {key: type(n := getattr(self, key)) is int and low <= n <= high for key, (low, high) in spans.items()}
        valid["scale"] = type(self.scale) is int and self.scale in (ONE_SIZE, *SCALES)
        valid["name"] = isinstance(self.name, str) and 0 < len(self.name) <= 100
        for render in ("lrhs", "hrls"):
            names = getattr(self, render)
            valid[render] = isinstance(names, list) and names[:1] == [RGB] and all(name in FEATURES for name in names)
        valid["denoiser"] = self.denoiser in (NO_DENOISER, *DENOISERS)
        valid["provenance"] = isinstance(self.provenance, dict)
        valid["training_spp"] = isinstance(self.training_spp, dict) and all(
            isinstance(span, list) and len(span) == 2 and all(type(spp) in (int, float) for spp in span)
            for span in self.training_spp.values()
        )
        return next((name for name, is_valid in valid.items() if not is_valid), None)

    def to_json(self) -> str:
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def of_file(cls, path: str | Path) -> Contract:
        """Read the contract of an ONNX file.

        Raises:
            InputError: no such file, no ONNX file, or no contract that fits this version.
        """
        return cls.of_network(load_network(path, optimise=False), path)

    @classmethod
    def of_network(cls, network: Network, path: str | Path) -> Contract:
        """Read the contract of a loaded network, as :meth:`of_file` does; ``path`` is for messages."""
        metadata = network.get_modelmeta().custom_metadata_map
        if METADATA_KEY not in metadata:
            raise InputError(
                f"{path}: has no '{METADATA_KEY}' metadata; make it with python -m research.training.export"
            )
        return cls.from_json(metadata[METADATA_KEY], str(path))

    @classmethod
    def from_json(cls, text: str, source: str) -> Contract:
        """Read a contract, or raise InputError if it does not fit this version; ``source`` is for messages."""
        again = "export it again"
        try:
            contract = cls(**json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{source}: the '{METADATA_KEY}' metadata can't be read ({error}); {again}") from error
        if contract.format != FORMAT:
            version = str(contract.format)[:20]
            raise InputError(f"{source}: contract format {version}, this version reads {FORMAT}; update one of them")
        if wrong := contract._wrong_field():
            raise InputError(f"{source}: the field {wrong} of its contract has a value that can't be; {again}")
        for key, value in {"transforms": current_transforms(), "defaults": DEFAULTS}.items():
            if (stored := getattr(contract, key)) != value:
                raise InputError(f"{source}: made for {key} {str(stored)[:200]}, this version has {value}; {again}")
        return contract
