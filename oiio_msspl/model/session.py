# SPDX-License-Identifier: Apache-2.0
"""A loaded model on a device."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.model.contract import NO_DENOISER, Contract
from oiio_msspl.model.mean_denoiser import MeanDenoiser
from oiio_msspl.model.render_mean import NO_IMAGES, Images, MeanSettings, useful_lrhs_aovs
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


def make_denoiser(mode: str, threads: int = 0) -> MeanDenoiser | None:
    """The denoiser that runs before a model, for its contract's ``denoiser``."""
    return None if mode == NO_DENOISER else MeanDenoiser(threads)


class Session:
    """A loaded model on a device, with its contract.

    Args:
        path: an ONNX file with a contract.
        device: a key of ``PROVIDERS``.
        threads: CPU threads of ONNX Runtime and NumPy alike; 0 for one a core.

    Raises:
        InputError: no model, no contract, or a device that this onnxruntime was not built for.
    """

    def __init__(self, path: str | Path, device: str = "cpu", threads: int = 0) -> None:
        if device not in PROVIDERS:
            raise InputError(f"--device {device!r}: use one of {', '.join(PROVIDERS)}")
        if device not in usable_devices():
            raise InputError(
                f"--device {device}: the installed onnxruntime {runtime_version()} has no {PROVIDERS[device]}; "
                f"usable here: {', '.join(usable_devices())}"
            )
        providers = list(dict.fromkeys([PROVIDERS[device], CPU]))
        self._session = load_network(path, threads, providers)
        self.contract = Contract.of_network(self._session, path)
        self._denoiser = make_denoiser(self.contract.denoiser, threads)
        self._outputs = [output.name for output in self._session.get_outputs()]
        inputs = sorted(each.name for each in self._session.get_inputs())
        if inputs != ["hrls", "lrhs"] or "fused" not in self._outputs:
            raise InputError(
                f"{path}: its network has the inputs {', '.join(inputs)[:99]} and the outputs "
                f"{', '.join(self._outputs)[:99]}, not lrhs, hrls and fused; export it again"
            )
        self.path = Path(path)
        self.threads = threads
        self.seconds = 0.0
        """Time spent in :meth:`run` so far, including the denoiser."""
        self.provider = self._session.get_providers()[0]
        if self.provider != PROVIDERS[device]:
            log.warning("%s could not start on this machine; using %s", PROVIDERS[device], self.provider)
        log.info("model %s on %s", self.contract.name, self.provider)

    def require_error(self) -> None:
        """Raise InputError if the model does not predict its error."""
        if "log_error" not in self._outputs:
            raise InputError(f"model {self.contract.name} does not predict its error; choose another --model")

    @property
    def lrhs_aovs(self) -> tuple[str, ...]:
        """AOVs of the LRHS that are read if it has them."""
        return useful_lrhs_aovs(self.contract.scale) if self._denoiser is not None else ()

    def run(
        self,
        lrhs: Array,
        hrls: Array,
        *,
        lrhs_aovs: Images = NO_IMAGES,
        mean: MeanSettings | None = None,
        error: bool = False,
    ) -> tuple[Array, Array | None]:
        """Run the denoiser, if the model has one, and the model.

        Args:
            lrhs: (h, w, 3), encoded.
            hrls: (s*h, s*w, 16), encoded, channels as in :data:`oiio_msspl.aovs.features.HRLS_FEATURES`. If both have
                room for the denoised channels that the contract lists, these are filled in place; else in copies.
            lrhs_aovs: those of :attr:`lrhs_aovs` that the LRHS has, encoded, (h, w, 3) each.
            mean: how the denoiser averages both renders of the frame; decided from these images if None.
            error: also return the expected error of a model that predicts it.

        Returns:
            The fused image, log-encoded (s*h, s*w, 3); and its expected absolute error in the same values, mean of the
            channels, (s*h, s*w, 1), or None.

        Raises:
            MssplError: the model failed.
        """
        start = time.perf_counter()
        if self._denoiser is not None:
            if (lrhs.shape[2], hrls.shape[2]) == (len(self.contract.lrhs), len(self.contract.hrls)):
                self._denoiser.fill(lrhs, hrls, lrhs_aovs, mean)
            else:
                lrhs, hrls = self._denoiser(lrhs, hrls[..., : len(self.contract.hrls)], lrhs_aovs, mean)
        feed: dict[str, Any] = {
            "lrhs": np.ascontiguousarray(lrhs.transpose(2, 0, 1)[None]),
            "hrls": np.ascontiguousarray(hrls.transpose(2, 0, 1)[None]),
        }
        try:
            results = dict(zip(self._outputs, self._session.run(self._outputs, feed), strict=True))
        except Exception as cause:
            raise MssplError(
                f"{self.contract.name} failed on {self.provider} ({str(cause).splitlines()[0]}); "
                "try --device cpu, or another --model"
            ) from cause
        self.seconds += time.perf_counter() - start
        images = {name: values[0].transpose(1, 2, 0) for name, values in results.items()}
        return images["fused"], np.exp(images["log_error"]) if error else None
