# SPDX-License-Identifier: Apache-2.0
"""A loaded model on a device."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB, VARIANCE
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.image.parallel import check_threads
from oiio_msspl.model.contract import CLEAN, Contract
from oiio_msspl.model.devices import COMPLETE, PROVIDERS, file_for, providers, require_device
from oiio_msspl.model.digests import digests
from oiio_msspl.model.encoding import default_value, luminance_variance
from oiio_msspl.model.render_mean import Images, Shares
from oiio_msspl.model.runtime import CPU, convolutions, load_network, release_memory

log = logging.getLogger(__name__)

#: LRHS pixels on a side that every network takes.
SMALLEST = 16


class Session:
    """A loaded model on a device, with its contract.

    Args:
        path: an ONNX file with a contract. A GPU runs the file of this name in the folder ``gpu`` beside it, if there
            is one.
        device: a key of :data:`oiio_msspl.model.devices.PROVIDERS`.
        threads: CPU threads of ONNX Runtime and NumPy alike; 0 for one a core.
        layers: ONNX files of the models that fuse passes: one for the scale, and perhaps one for half of it, at half of
            the frame's resolution; none if no network does.

    Raises:
        InputError: the file is no model or has no contract, this onnxruntime was not built for the device, the device
            cannot start, or convolutions would stay on the CPU though the device has operators for them.
    """

    def __init__(self, path: str | Path, device: str = "cpu", threads: int = 0, *, layers: Sequence[Path] = ()) -> None:
        require_device(device)
        file = file_for(Path(path), device)
        check_threads(threads)
        self._session = load_network(file, threads, providers(device))
        self.provider = self._session.get_providers()[0]
        if self.provider != PROVIDERS[device]:
            raise InputError(
                f"--device {device} could not start: {PROVIDERS[device]} found no such device, or not the libraries "
                "that it needs, which the lines above name; use --device cpu meanwhile"
            )
        self.contract = Contract.of_network(self._session, path)
        self._outputs = [output.name for output in self._session.get_outputs()]
        inputs = [node.name for node in self._session.get_inputs()]
        if inputs != list(self.contract.inputs) or "fused" not in self._outputs:
            raise InputError(
                f"{path}: has the inputs {', '.join(inputs)[:99]} and the outputs {', '.join(self._outputs)[:99]}, not "
                f"{', '.join(self.contract.inputs)} and fused; export it again"
            )
        self.path, self.layers, self.device, self.threads = Path(path), layers, device, threads
        self._layer_sessions: dict[Path, Session] = {}
        self.weights = digests([self.path, *layers], device)
        """The digests of this model and of those that fuse passes, by name, of the files that are loaded now."""
        self.seconds = 0.0
        """Time spent in :meth:`run` so far."""
        self._largest = 0
        """LRHS pixels of the largest picture since :meth:`release_memory` was called."""
        self.convolutions = convolutions(self._session)
        """Number of convolutions on each execution provider, see :func:`oiio_msspl.model.runtime.convolutions`."""
        if device != "cpu" and (on_cpu := self.convolutions.get(CPU)):
            message = (
                f"{file}: {on_cpu} of {sum(self.convolutions.values())} convolutions stay on the CPU; "
                "use --device cpu, or name a file for GPUs with --model"
            )
            if device in COMPLETE:
                raise InputError(f"--device {device}: {message}")
            log.warning(message)
        log.info("model %s (%s), convolutions: %s", self.name, file, self.convolutions or "unknown")

    @property
    def name(self) -> str:
        """The model's name, as ``--model`` takes it."""
        return self.contract.name

    def require_error(self) -> None:
        """Raise InputError if the model does not predict its error."""
        if "log_error" not in self._outputs:
            other = f"use --model {self.name.replace(CLEAN, '')}" if CLEAN in self.name else "choose another --model"
            raise InputError(f"model {self.name} does not predict its error; {other}")

    @property
    def clean_aovs(self) -> tuple[str, ...]:
        """AOVs of the HRLS that the model denoises, see :meth:`run`."""
        return tuple(name for name in (ALBEDO, NORMAL) if name in self._outputs)

    def require_clean_aovs(self) -> None:
        """Raise InputError if the model does not denoise albedo and normal."""
        if not self.clean_aovs:
            raise InputError(f"--data-passes: {self.name} does not denoise albedo and normal; use --quality best")

    def layer_session(self, *, half: bool = False) -> Session:
        """Return the model that fuses passes, or does at half of the resolution. It is loaded when first needed."""
        path = self.layers[1 if half else 0]
        if path not in self._layer_sessions:
            self._layer_sessions[path] = Session(path, self.device, self.threads)
        return self._layer_sessions[path]

    def release_layer_memory(self) -> None:
        """Call :meth:`release_memory` of the models that fuse passes, if they were loaded."""
        for session in self._layer_sessions.values():
            session.release_memory()

    def run(
        self,
        lrhs: Images,
        hrls: Images,
        exposure: float,
        shares: Shares,
        *,
        error: bool = False,
        aovs: Sequence[str] = (),
    ) -> Images:
        """Run the model.

        Args:
            lrhs: ``rgb`` (h, w, 3), scene linear, repaired; and further features. Features that the contract lacks are
                ignored. Features that are missing get their default.
            hrls: features (s*h, s*w, c), likewise.
            exposure: see :func:`oiio_msspl.model.encoding.find_exposure`.
            shares: see :func:`oiio_msspl.model.render_mean.find_shares`; only read if the model averages both renders.
            error: also return the expected error. The model must predict it.
            aovs: names of :attr:`clean_aovs` to return, too.

        Returns:
            ``fused``: the fused image, scene linear (s*h, s*w, 3). ``error``: the expected absolute error of the
            log-encoded image, mean of the channels, (s*h, s*w, 1). The AOVs of the HRLS without noise, (s*h, s*w, 3):
            albedo in [0, 1], normal in [-1, 1].

        Raises:
            MssplError: the model failed.
        """
        start = time.perf_counter()
        pixels = lrhs[RGB].shape[0] * lrhs[RGB].shape[1]
        if pixels > self._largest:
            self.release_memory(to_system=False)  # memory of smaller pictures would be held beside that of this one
            self._largest = pixels
        wanted = ["fused", *(["log_error"] if error else []), *aovs]
        try:
            results = self._session.run(wanted, self._feed(lrhs, hrls, exposure, shares))
        except Exception as cause:
            raise MssplError(
                f"{self.name} failed on {self.provider} ({str(cause).splitlines()[0]}); "
                "try --device cpu, or another --model"
            ) from cause
        self.seconds += time.perf_counter() - start
        images = {name: values[0].transpose(1, 2, 0) for name, values in zip(wanted, results, strict=True)}
        if error:
            images["error"] = np.exp(images.pop("log_error"))
        if NORMAL in images:
            images[NORMAL] = 2 * images[NORMAL] - 1
        return images

    def _feed(self, lrhs: Images, hrls: Images, exposure: float, shares: Shares) -> dict[str, Any]:
        """Return the inputs of the contract."""
        numbers = {"exposure": exposure} | {f"share.{name}": shares.get(name, 0.0) for name in self.contract.lrhs}
        feed: dict[str, Any] = {}
        for key, channels in self.contract.inputs.items():
            render, _, name = key.partition(".")
            if not channels:
                feed[key] = np.asarray(numbers[key], np.float32)
                continue
            images = lrhs if render == "lrhs" else hrls
            if name in images:
                image = luminance_variance(images[name]) if name == VARIANCE else images[name]
                feed[key] = np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)
            else:
                size = 1, channels, *images[RGB].shape[:2]
                feed[key] = np.full(size, default_value(name, exposure), np.float32)
        return feed

    def release_memory(self, *, to_system: bool = True) -> None:
        """Give the memory of intermediate results on the CPU back, to the system or to other arrays of this process.

        The next run allocates it again.
        """
        self._largest = 0
        if self.provider != CPU:
            return
        low = -(-SMALLEST // self.contract.alignment) * self.contract.alignment
        # The other features get their defaults.
        lrhs, hrls = ({RGB: np.zeros((n, n, 3), np.float32)} for n in (low, low * self.contract.scale))
        release_memory(self._session, self._feed(lrhs, hrls, 1.0, {}), to_system=to_system)
