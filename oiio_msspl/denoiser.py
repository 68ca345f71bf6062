# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise on the HRLS, for models that read its result as one more layer: the only module that imports
pyoidn, which is optional."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np

from oiio_msspl import schema, transforms
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.render import Array

if TYPE_CHECKING:
    import pyoidn

_FIRST = dict(zip(schema.HRLS_FEATURES, np.cumsum([0, *schema.HRLS_FEATURES.values()]), strict=False))


class Denoiser:
    """Open Image Denoise on the CPU, quality fast: the network that reads the result has better use for the time.

    Args:
        threads: 0 for all.

    Raises:
        InputError: pyoidn is not installed.
    """

    def __init__(self, threads: int = 0) -> None:
        try:
            import pyoidn
        except (ImportError, OSError) as error:  # not installed, or without its library
            raise InputError(
                "this model reads Open Image Denoise's result: pip install pyoidn, or choose another --model"
            ) from error
        self._device = pyoidn.Device()
        self._device.set_int("numThreads", threads)
        self._device.set_bool("setAffinity", False)  # other threads of the process want the cores too
        self._device.commit()
        self._lock = threading.Lock()  # the filter remembers the images of one call at a time
        self._format = pyoidn.OIDN_FORMAT_FLOAT3
        self._filter: pyoidn.Filter = pyoidn.Filter(self._device, pyoidn.OIDN_FILTER_TYPE_RT)
        self._filter.set_bool("hdr", True)
        self._filter.set_quality(pyoidn.OIDN_QUALITY_FAST)
        # Network values are exposed by the LRHS. Left alone, it would expose every tile for itself.
        self._filter.set_float("inputScale", 1.0)

    def __call__(self, hrls: Array) -> Array:
        """Denoise an HRLS as the network sees it.

        Args:
            hrls: (h, w, 16 or more), transformed, channels as in :data:`oiio_msspl.schema.HRLS_FEATURES`.

        Returns:
            (h, w, 3), transformed colour.

        Raises:
            MssplError: Open Image Denoise failed.
        """
        images = {"color": transforms.expand(_feature(hrls, schema.RGB), 1.0)}
        albedo, normal = np.clip(_feature(hrls, schema.ALBEDO), 0, 1), _feature(hrls, schema.NORMAL)
        # A layer that is absent has its default everywhere; Open Image Denoise takes no normals without an albedo.
        if normal.any():
            images |= {"albedo": albedo, "normal": normal}
        elif (albedo != schema.DEFAULTS[schema.ALBEDO]).any():
            images["albedo"] = albedo
        images = {name: np.ascontiguousarray(image) for name, image in images.items()}
        images["output"] = np.empty_like(images["color"])
        with self._lock:
            for name in ("color", "albedo", "normal", "output"):
                if name in images:
                    self._filter.set_image(name, images[name], self._format)
                else:
                    self._filter.unset_image(name)
            self._filter.commit()
            self._filter.execute()
            if message := self._device.get_error():
                raise MssplError(f"Open Image Denoise failed: {message}")
        return transforms.compress(np.maximum(images["output"], 0.0), 1.0)


def _feature(hrls: Array, name: str) -> Array:
    return hrls[..., _FIRST[name] : _FIRST[name] + schema.HRLS_FEATURES[name]]
