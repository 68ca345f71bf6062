# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise (OIDN) on both renders, for the `mix` models, which read its results. It needs pyoidn, which is
optional.

OIDN denoises the HRLS with its albedo and normal, as anyone would. It also denoises the mean of both renders at the
LRHS's resolution (:mod:`oiio_msspl.model.render_mean`). There, albedo and normal are averages of many pixels and nearly
free of noise, so ``cleanAux`` is set. At x2 only four pixels are averaged, so the albedo is prefiltered first.

Where ONNX Runtime computes OIDN's networks correctly in 8 bits on this processor, it replaces OIDN, which takes
twice as long (:mod:`oiio_msspl.model.quantised`).
"""

from __future__ import annotations

import functools
import logging
import threading
from typing import TYPE_CHECKING

import numpy as np

from oiio_msspl.aovs.features import HRLS_FEATURES, LRHS_FEATURES
from oiio_msspl.arrays import Array
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.oidn_weights import find_weights
from oiio_msspl.model.quantised import QuantisedDenoiser
from oiio_msspl.model.render_mean import NO_IMAGES, Images, denoiser_images, mean_of_renders

if TYPE_CHECKING:
    import pyoidn

log = logging.getLogger(__name__)

#: Largest mean difference, log-encoded, between OIDN and its network in 8 bits on the test image.
TOLERANCE = 0.01

_LRHS_CHANNELS, _HRLS_CHANNELS = sum(LRHS_FEATURES.values()), sum(HRLS_FEATURES.values())


class OidnFilter:
    """One network of OIDN, in 8 bits where that works.

    Args:
        device: committed pyoidn device.
        quality: ``fast`` or ``high``.
        hdr: denoise HDR colour; otherwise an albedo.
        clean_aux: albedo and normal have no noise.
        network: name of the network in 8 bits, a key of :data:`oiio_msspl.model.quantised.NETWORK_IMAGES`; empty: never
            use 8 bits.
        threads: CPU threads of the network in 8 bits; 0 for one a core.
    """

    def __init__(
        self, device: pyoidn.Device, quality: str, *, hdr: bool, clean_aux: bool, network: str, threads: int
    ) -> None:
        import pyoidn

        self._device, self._format, self._hdr = device, pyoidn.OIDN_FORMAT_FLOAT3, hdr
        self._filter = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
        self._filter.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
        self._filter.set_bool("cleanAux", clean_aux)
        if hdr:
            self._filter.set_bool("hdr", True)
            # The renders are exposed already. Without this, OIDN would find another exposure for each tile.
            self._filter.set_float("inputScale", 1.0)
        self._lock = threading.Lock()  # a filter holds the images of one call at a time
        self._network, self._threads = network, threads

    def __call__(self, images: Images, out: Array | None = None) -> Array:
        """Denoise the colour, or the albedo of a filter for albedos.

        Args:
            images: see :data:`oiio_msspl.model.render_mean.Images`, without ``noise``.
            out: where to put the result; a new array if None.

        Returns:
            (h, w, 3): log-encoded colour, or albedo.

        Raises:
            MssplError: OIDN failed.
        """
        if self._quantised is not None and images.keys() == self._quantised.images:
            return self._quantised(**images, out=out)
        return self.exact(images, out)

    def exact(self, images: Images, out: Array | None = None) -> Array:
        """The same by OIDN itself, in 32 bits."""
        aovs: Images = {name: images[name] for name in ("albedo", "normal") if name in images}
        if not self._hdr:
            return np.clip(self._execute(aovs), 0, 1, out=out)
        radiance = decode_radiance(images["colour"], 1.0)
        return encode_radiance(self._execute({"color": radiance} | aovs), 1.0, out)

    @property
    def is_quantised(self) -> bool:
        """Whether the network in 8 bits is used (if all images that it needs are there)."""
        return self._quantised is not None

    def _execute(self, images: Images) -> Array:
        """Run OIDN's filter; the first image is the one to denoise."""
        images = {name: np.ascontiguousarray(image, dtype=np.float32) for name, image in images.items()}
        images["output"] = np.empty_like(next(iter(images.values())))
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
        return images["output"]

    @functools.cached_property
    def _quantised(self) -> QuantisedDenoiser | None:
        if not self._network:
            return None
        weights = find_weights(self._network)
        if weights is None:
            log.info("this version of Open Image Denoise has other weights, so it runs in 32 bits")
            return None
        try:
            network = QuantisedDenoiser(self._network, weights, self._threads)
        except InputError as error:  # an onnxruntime without these operators
            log.info("%s; Open Image Denoise runs in 32 bits", error)
            return None
        # Processors without VNNI instructions add products of 8 bits in 16 bits, which overflows.
        images = {name: image for name, image in _test_images().items() if name in network.images}
        difference = float(np.abs(network(**images) - self.exact(images)).mean())
        if difference > TOLERANCE:
            log.info("this processor computes 8-bit networks wrongly (difference %.3f)", difference)
            return None
        return network


class OidnDenoiser:
    """OIDN on both renders, on the CPU.

    Args:
        threads: CPU threads; 0 for one a core.
        exact: use OIDN itself in 32 bits, never its networks in 8 bits.

    Attributes:
        hrls: denoises the HRLS.
        mean: denoises the mean of both renders, by OIDN's large network.
        albedo: prefilters the albedo of that mean at x2. Quality ``high`` would take four times as long and bring
            nothing.

    Raises:
        InputError: pyoidn is not installed.
    """

    def __init__(self, threads: int = 0, *, exact: bool = False) -> None:
        try:
            import pyoidn
        except (ImportError, OSError) as error:  # not installed, or without its library
            raise InputError(
                "this model reads results of Open Image Denoise: pip install pyoidn==2.5.1, or choose another --model"
            ) from error
        device = pyoidn.Device()
        device.set_int("numThreads", threads)
        device.set_bool("setAffinity", False)  # other threads of this process need the cores too
        device.commit()

        def make(quality: str, network: str, *, hdr: bool = True, clean_aux: bool = False) -> OidnFilter:
            name = "" if exact else network
            return OidnFilter(device, quality, hdr=hdr, clean_aux=clean_aux, network=name, threads=threads)

        self.hrls = make("high", "rt_hdr_alb_nrm")
        self.mean = make("high", "rt_hdr_calb_cnrm_large", clean_aux=True)
        self.albedo = make("fast", "rt_alb", hdr=False)

    def __call__(self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES) -> tuple[Array, Array]:
        """Denoise an encoded pair.

        Args:
            lrhs: (h, w, 3), encoded.
            hrls: (s*h, s*w, 16), encoded, channels as in :data:`oiio_msspl.aovs.features.HRLS_FEATURES`.
            lrhs_aovs: see :func:`oiio_msspl.model.render_mean.mean_of_renders`.

        Returns:
            Copies with three more channels of log-encoded colour: the LRHS with the denoised mean of both renders,
            (h, w, 6), and the HRLS with itself denoised, (s*h, s*w, 19).

        Raises:
            MssplError: OIDN failed.
        """
        lrhs, hrls = append_channels(lrhs, 3), append_channels(hrls, 3)
        self.fill(lrhs, hrls, lrhs_aovs)
        return lrhs, hrls

    def fill(self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES) -> None:
        """The same in place: fill the last three channels of (h, w, 6) and (s*h, s*w, 19)."""
        images = denoiser_images(hrls)
        self.mean(self.clean_mean(lrhs[..., :_LRHS_CHANNELS], images, lrhs_aovs), lrhs[..., _LRHS_CHANNELS:])
        self.hrls(images, hrls[..., _HRLS_CHANNELS:])

    def denoise_mean(self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES) -> Array:
        """Denoise the mean of both renders only: log-encoded colour (h, w, 3)."""
        return self.mean(self.clean_mean(lrhs, denoiser_images(hrls), lrhs_aovs))

    def clean_mean(self, lrhs: Array, hrls_images: Images, lrhs_aovs: Images = NO_IMAGES) -> Images:
        """The mean of both renders with albedo and normal that are (nearly) free of noise."""
        scale = hrls_images["colour"].shape[0] // lrhs.shape[0]
        images = mean_of_renders(lrhs, hrls_images, lrhs_aovs)
        del images["noise"]
        if scale == 2 and "albedo" in images:
            images["albedo"] = self.albedo({"albedo": images["albedo"]})
        return images


@functools.cache
def quantised_networks_work() -> bool:
    """Whether pyoidn is installed with known weights, and this machine computes its networks correctly in 8 bits."""
    try:
        return OidnDenoiser().hrls.is_quantised
    except InputError:
        return False


def append_channels(image: Array, count: int) -> Array:
    """A copy of an image (h, w, c) with ``count`` more channels, not initialised; each channel is contiguous."""
    height, width, channels = image.shape
    copy = np.empty((channels + count, height, width), dtype=np.float32).transpose(1, 2, 0)
    copy[..., :channels] = image
    return copy


def _test_images() -> Images:
    """A small picture with noise, edges, gradients and highlights, made by a formula."""
    y, x = np.mgrid[:64, :64].astype(np.float32) / 64
    noise = (np.modf(np.sin(np.arange(64 * 64 * 3, dtype=np.float64) * 12.9898) * 43758.5453)[0] ** 2).astype(
        np.float32
    )
    albedo = np.stack([np.where((x * 6 + y * 3) % 2 < 1, 0.2, 0.7), 0.3 + 0.4 * y, 0.5 + 0 * x], axis=-1)
    normal = np.stack([np.where(x > y, 0.8, -0.6), np.where(x > y, 0.6, 0), np.where(x > y, 0, 0.8)], axis=-1)
    light = albedo * (0.05 + 4 * (x * y)[..., None] ** 3) + 50 * ((x - 0.3) ** 2 + (y - 0.6) ** 2 < 0.002)[..., None]
    radiance = light * -np.log(1e-3 + noise.reshape(64, 64, 3))
    colour = encode_radiance(radiance.astype(np.float32), 1.0)
    return {"colour": colour, "albedo": albedo.astype(np.float32), "normal": normal.astype(np.float32)}
