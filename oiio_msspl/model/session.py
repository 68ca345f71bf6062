# SPDX-License-Identifier: Apache-2.0
"""Models, and what evaluates them."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.model.contract import Contract
from oiio_msspl.model.oidn import denoiser_for, eight_bits_work
from oiio_msspl.model.oidn_weights import LEGACY_NAMES, installed_weights
from oiio_msspl.model.render_mean import NO_LAYERS, Layers, lrhs_aovs_read
from oiio_msspl.model.runtime import CPU, available_providers, load_network, runtime_version

log = logging.getLogger(__name__)

#: ``--device`` name -> onnxruntime execution provider.
PROVIDERS = {
    "cpu": CPU,
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "directml": "DmlExecutionProvider",
}


def usable_devices() -> list[str]:
    """Keys of ``PROVIDERS`` that the installed onnxruntime was built for."""
    available = available_providers()
    return [device for device, provider in PROVIDERS.items() if provider in available]


class Session:
    """A loaded model on a device, with its contract.

    Args:
        path: an ONNX file that carries a contract.
        device: a key of ``PROVIDERS``.
        threads: CPU threads of onnxruntime, Open Image Denoise and NumPy alike; 0: one a core.
        exact: Open Image Denoise itself, never its networks in 8 bits (:mod:`oiio_msspl.model.quantised`). What the model
            computes in 8 bits stays so.

    Raises:
        InputError: no model, no contract, a device that this onnxruntime was not built for, or a model that reads
            another denoiser's result, or is made of its weights, and that is not installed, or is another version.
    """

    def __init__(self, path: str | Path, device: str = "cpu", threads: int = 0, *, exact: bool = False) -> None:
        if device not in PROVIDERS:
            raise InputError(f"--device {device!r}: use one of {', '.join(PROVIDERS)}")
        if device not in usable_devices():
            raise InputError(
                f"--device {device}: the installed onnxruntime {runtime_version()} has no {PROVIDERS[device]}; "
                f"usable here: {', '.join(usable_devices())}"
            )
        providers = list(dict.fromkeys([PROVIDERS[device], PROVIDERS["cpu"]]))
        self.contract = Contract.of_file(path)
        weights = None
        if self.contract.weights:
            weights = installed_weights(LEGACY_NAMES.get(self.contract.weights, self.contract.weights))
            if not eight_bits_work():
                raise InputError(
                    f"model {self.contract.name} is in 8 bits, which this machine computes wrongly; "
                    "choose another --model"
                )
        self._session = load_network(path, threads, providers, weights)
        self._denoiser = denoiser_for(self.contract.denoiser, threads, exact=exact)
        self._outputs = [output.name for output in self._session.get_outputs()]
        self.path = Path(path)
        self.threads = threads
        self.seconds = 0.0
        """Time spent in :meth:`run` so far, the denoiser's included."""
        self.provider = self._session.get_providers()[0]
        if self.provider != PROVIDERS[device]:
            log.warning("%s could not start on this machine; using %s", PROVIDERS[device], self.provider)
        log.info("model %s on %s", self.contract.name, self.provider)

    def require_error(self) -> None:
        """Raise InputError if the model does not predict its error."""
        if "log_error" not in self._outputs:
            raise InputError(f"model {self.contract.name} does not predict its error; choose another --model")

    @property
    def low_aovs(self) -> tuple[str, ...]:
        """Layers that are read of the LRHS, beside its colour."""
        return lrhs_aovs_read(self.contract.scale) if self._denoiser is not None else ()

    def run(
        self, lrhs: Array, hrls: Array, *, low_aovs: Layers = NO_LAYERS, error: bool = False
    ) -> tuple[Array, Array | None]:
        """Evaluate the network.

        Args:
            lrhs: (h, w, 3), transformed.
            hrls: (s*h, s*w, 16), transformed, channels as in :data:`oiio_msspl.aovs.features.HRLS_FEATURES`. What else the
                contract lists for either is made here; in place, if both have room for it.
            low_aovs: those of :attr:`low_aovs` that are there, transformed, (h, w, 3) each.
            error: also return the error, of a model that predicts it.

        Returns:
            The fused image (s*h, s*w, 3), transformed; and, if asked for, its expected absolute error, mean of the
            channels, (s*h, s*w, 1), in the same values.
        """
        start = time.perf_counter()
        if self._denoiser is not None:
            if (lrhs.shape[2], hrls.shape[2]) == (len(self.contract.lrhs), len(self.contract.hrls)):
                self._denoiser.fill(lrhs, hrls, low_aovs)
            else:
                lrhs, hrls = self._denoiser(lrhs, hrls, low_aovs)
                hrls = hrls[..., : len(self.contract.hrls)]
        feed: dict[str, Any] = {
            "lrhs": np.ascontiguousarray(lrhs.transpose(2, 0, 1)[None]),
            "hrls": np.ascontiguousarray(hrls.transpose(2, 0, 1)[None]),
        }
        try:
            results = dict(zip(self._outputs, self._session.run(self._outputs, feed), strict=True))
        except Exception as cause:
            raise MssplError(
                f"{self.contract.name} failed on {self.provider} ({str(cause).splitlines()[0]}); "
                "try --max-memory with a smaller value, or --device cpu"
            ) from cause
        self.seconds += time.perf_counter() - start
        images = {name: values[0].transpose(1, 2, 0) for name, values in results.items()}
        return images["fused"], np.exp(images["log_error"]) if error else None
