# SPDX-License-Identifier: Apache-2.0
"""A loaded model on a device."""

from __future__ import annotations

import collections
import functools
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.model.contract import NO_DENOISER, Contract
from oiio_msspl.model.devices import COMPLETE, PROVIDERS, file_for, providers, require_device
from oiio_msspl.model.mean_denoiser import WEIGHTS, MeanDenoiser
from oiio_msspl.model.render_mean import NO_IMAGES, Images, MeanSettings, useful_lrhs_aovs
from oiio_msspl.model.runtime import CPU, convolutions, load_network, release_memory

log = logging.getLogger(__name__)

#: LRHS pixels on a side that every network takes.
SMALLEST = 16
#: Ending of the name of a model that fuses pairs whose noise the pixel filter has spread.
SPREAD = "-spread"


def make_denoiser(mode: str, threads: int = 0, device: str = "cpu") -> MeanDenoiser | None:
    """The denoiser that runs before a model, for its contract's ``denoiser``."""
    return None if mode == NO_DENOISER else MeanDenoiser(threads, device, WEIGHTS[mode])


class Session:
    """A loaded model on a device, with its contract.

    Args:
        path: an ONNX file with a contract. A GPU runs the file of the same name in the folder ``gpu`` beside it, if
            there is one.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`.
        threads: CPU threads of ONNX Runtime and NumPy alike; 0 for one a core.
        spread: the model fuses pairs whose noise the pixel filter has spread.
        layers: ONNX file of the model that fuses single layers of passes; None if no network does.

    Raises:
        InputError: no model; no contract; a device that this onnxruntime was not built for or that cannot start; or a
            model whose convolutions would stay on the CPU though the device has operators for them.
    """

    def __init__(
        self,
        path: str | Path,
        device: str = "cpu",
        threads: int = 0,
        *,
        spread: bool = False,
        layers: Path | None = None,
    ) -> None:
        require_device(device)
        file = file_for(Path(path), device)
        self._session = load_network(file, threads, providers(device))
        self.provider = self._session.get_providers()[0]
        if self.provider != PROVIDERS[device]:
            raise InputError(
                f"--device {device} could not start: {PROVIDERS[device]} found no such device, or not the libraries "
                "that it needs, which the lines above name; use --device cpu meanwhile"
            )
        self.contract = Contract.of_network(self._session, path)
        self.stride = 2 if spread else 1
        """Distance of the HRLS pixels that the model reads together, see :mod:`oiio_msspl.fusion.spread`."""
        self._denoiser = make_denoiser(self.contract.denoiser, threads, device)
        self._outputs = [output.name for output in self._session.get_outputs()]
        inputs = sorted(each.name for each in self._session.get_inputs())
        if inputs != ["hrls", "lrhs"] or "fused" not in self._outputs:
            raise InputError(
                f"{path}: its network has the inputs {', '.join(inputs)[:99]} and the outputs "
                f"{', '.join(self._outputs)[:99]}, not lrhs, hrls and fused; export it again"
            )
        self.path, self.layers = Path(path), layers
        self.device, self.threads = device, threads
        self.seconds = 0.0
        """Time spent in :meth:`run` so far, including the denoiser."""
        self._largest = 0
        """LRHS pixels of the largest picture since :meth:`release_memory`."""
        counts = collections.Counter(convolutions(self._session))
        if self._denoiser is not None:
            counts.update(self._denoiser.convolutions)
        self.convolutions = dict(counts)
        """Number of convolutions on each execution provider, see :func:`oiio_msspl.model.runtime.convolutions`."""
        if device != "cpu" and counts[CPU]:
            message = (
                f"{file}: {counts[CPU]} of {counts.total()} convolutions stay on the CPU; "
                "use --device cpu, or a --model with a file for GPUs"
            )
            if device in COMPLETE:
                raise InputError(f"--device {device}: {message}")
            log.warning(message)
        log.info("model %s (%s), convolutions: %s", self.name, file, self.convolutions or "unknown")

    @property
    def name(self) -> str:
        """The model's name, as ``--model`` takes it."""
        return f"{self.contract.name}{SPREAD}" if self.stride > 1 else self.contract.name

    def require_error(self) -> None:
        """Raise InputError if the model does not predict its error."""
        if "log_error" not in self._outputs:
            raise InputError(f"model {self.contract.name} does not predict its error; choose another --model")

    @property
    def clean_aovs(self) -> tuple[str, ...]:
        """AOVs of the HRLS that the model denoises, see :meth:`run`."""
        return tuple(name for name in (ALBEDO, NORMAL) if name in self._outputs)

    def require_clean_aovs(self) -> None:
        """Raise InputError if the model does not denoise albedo and normal."""
        if not self.clean_aovs:
            raise InputError(f"--data-passes: {self.name} does not denoise albedo and normal; use --quality best")

    @functools.cached_property
    def layer_session(self) -> Session | None:
        """The model that fuses single layers of passes, which is loaded when it is first needed; None if no network
        does."""
        if self.layers is None:
            return None
        return Session(self.layers, self.device, self.threads, spread=self.stride > 1)

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
        aovs: Sequence[str] = (),
    ) -> Images:
        """Run the denoiser, if the model has one, and the model.

        Args:
            lrhs: (h, w, 3), encoded.
            hrls: (s*h, s*w, 16), encoded, channels as in :data:`oiio_msspl.aovs.features.HRLS_FEATURES`. If both have
                room for the denoised channels that the contract lists, these are filled in place; else in copies.
            lrhs_aovs: those of :attr:`lrhs_aovs` that the LRHS has, encoded, (h, w, 3) each.
            mean: how the denoiser averages both renders of the frame; decided from these images if None.
            error: also return the expected error of a model that predicts it.
            aovs: those of :attr:`clean_aovs` that are also returned.

        Returns:
            ``fused``: the fused image, log-encoded (s*h, s*w, 3). ``error``: its expected absolute error in the same
            values, mean of the channels, (s*h, s*w, 1). The AOVs of the HRLS without noise, (s*h, s*w, 3): albedo in
            [0, 1], normal in [-1, 1].

        Raises:
            MssplError: the model failed.
        """
        start = time.perf_counter()
        pixels = lrhs.shape[0] * lrhs.shape[1]
        if pixels > self._largest:
            self.release_memory()  # it is divided for smaller pictures, and would be held beside that of this one
            self._largest = pixels
        try:
            if self._denoiser is not None:
                if (lrhs.shape[2], hrls.shape[2]) == (len(self.contract.lrhs), len(self.contract.hrls)):
                    self._denoiser.fill(lrhs, hrls, lrhs_aovs, mean)
                else:
                    lrhs, hrls = self._denoiser(lrhs, hrls[..., : len(self.contract.hrls)], lrhs_aovs, mean)
            feed: dict[str, Any] = {
                "lrhs": np.ascontiguousarray(lrhs.transpose(2, 0, 1)[None]),
                "hrls": np.ascontiguousarray(hrls.transpose(2, 0, 1)[None]),
            }
            wanted = ["fused", *(["log_error"] if error else []), *aovs]
            results = dict(zip(wanted, self._session.run(wanted, feed), strict=True))
        except Exception as cause:
            raise MssplError(
                f"{self.contract.name} failed on {self.provider} ({str(cause).splitlines()[0]}); "
                "try --device cpu, or another --model"
            ) from cause
        self.seconds += time.perf_counter() - start
        images = {name: values[0].transpose(1, 2, 0) for name, values in results.items()}
        if error:
            images["error"] = np.exp(images.pop("log_error"))
        if NORMAL in images:
            images[NORMAL] = 2 * images[NORMAL] - 1
        return images

    def release_memory(self) -> None:
        """Give the memory of intermediate results on the CPU back to the system. The next run asks for it again."""
        self._largest = 0
        if self.provider != CPU:
            return
        contract = self.contract
        size = -(-SMALLEST // contract.alignment) * contract.alignment
        lrhs = np.zeros((1, len(contract.lrhs), size, size), np.float32)
        hrls = np.zeros((1, len(contract.hrls), size * contract.scale, size * contract.scale), np.float32)
        release_memory(self._session, {"lrhs": lrhs, "hrls": hrls})
