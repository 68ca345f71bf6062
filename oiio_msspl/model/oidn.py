# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise on both renders, for models that read its results: the only module that imports pyoidn, which is
optional.

The HRLS is denoised as anyone would, with its albedo and normal. The LRHS has neither; but its light and the HRLS's are
independent samples of the same scene, so at the LRHS's resolution their mean has less noise than either, and the
HRLS's albedo and normal, averaged over s x s pixels, have hardly any: Open Image Denoise may be told that they are
clean, which is worth 0.8 to 1.5 dB (at x2, where but four pixels are averaged, the LRHS's own are, too, and the albedo
is denoised first, or nothing is told). What it makes of these is
better at that resolution than its result on the HRLS, for a fraction of the time. A network of ours that was made of
Open Image Denoise's does the same without its help.
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
from oiio_msspl.model.contract import DENOISED_FEATURES
from oiio_msspl.model.encoding import decode_radiance, encode_radiance
from oiio_msspl.model.quantised import QuantisedDenoiser

if TYPE_CHECKING:
    import pyoidn
from oiio_msspl.model.oidn_weights import installed_weights, known_weights
from oiio_msspl.model.render_mean import NO_LAYERS, Layers, denoiser_layers, mean_of_renders

log = logging.getLogger(__name__)

_OF_LRHS, _OF_HRLS = sum(LRHS_FEATURES.values()), sum(HRLS_FEATURES.values())
#: Largest mean difference in network values between Open Image Denoise and itself in 8 bits, on a small picture.
TOLERANCE = 0.01


class Filter:
    """One of Open Image Denoise's networks.

    Args:
        device: of pyoidn, committed.
        quality: fast or high.
        hdr: denoises colour, not an albedo alone.
        clean: albedo and normal have no noise.
        network: its name in :mod:`oiio_msspl.model.quantised`, which is then used where it can be.
        threads: of that; 0 for all.
    """

    def __init__(
        self, device: pyoidn.Device, quality: str, *, hdr: bool, clean: bool, network: str, threads: int
    ) -> None:
        import pyoidn

        self._device, self._format, self._hdr = device, pyoidn.OIDN_FORMAT_FLOAT3, hdr
        self._filter = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
        self._filter.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
        self._filter.set_bool("cleanAux", clean)
        if hdr:
            self._filter.set_bool("hdr", True)
            # Network values are exposed by the LRHS. Left alone, it would expose every tile for itself.
            self._filter.set_float("inputScale", 1.0)
        self._lock = threading.Lock()  # a filter remembers the images of one call at a time
        self._network, self._threads = network, threads

    def __call__(self, layers: Layers, out: Array | None = None) -> Array:
        """Of the layers, the colour denoised, network values (h, w, 3), or the albedo; into ``out``, if given.

        Raises:
            MssplError: Open Image Denoise failed.
        """
        if self._eight_bit is not None and layers.keys() == self._eight_bit.reads:
            return self._eight_bit(**layers, out=out)
        return self._exactly(layers, out)

    @property
    def in_eight_bits(self) -> bool:
        """Whether it is that network that does the work, where all layers that it needs are there."""
        return self._eight_bit is not None

    def _exactly(self, layers: Layers, out: Array | None = None) -> Array:
        images: dict[str, Array] = {name: layers[name] for name in ("albedo", "normal") if name in layers}
        if not self._hdr:
            return np.clip(self._executed(images), 0, 1, out=out)
        radiance = decode_radiance(layers["colour"], 1.0)
        return encode_radiance(self._executed({"color": radiance} | images), 1.0, out)

    def _executed(self, images: dict[str, Array]) -> Array:
        """What the network makes of the first of the images (h, w, 3), with the help of the others."""
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
    def _eight_bit(self) -> QuantisedDenoiser | None:
        if not self._network:
            return None
        weights = known_weights(self._network)
        if weights is None:
            log.info("the weights of this Open Image Denoise are unknown here; it does its work itself")
            return None
        try:
            network = QuantisedDenoiser(self._network, weights, self._threads)
        except InputError as error:  # an onnxruntime without these operators
            log.info("%s; Open Image Denoise does its work itself", error)
            return None
        picture = {layer: image for layer, image in _picture_to_try().items() if layer in network.reads}
        # Processors without instructions for it sum products of 8 bits in 16, which overflows
        difference = float(np.abs(network(**picture) - self._exactly(picture)).mean())
        if difference > TOLERANCE:
            log.info("in 8 bits this processor computes Open Image Denoise's network wrongly, by %.3f", difference)
            return None
        return network


class OidnDenoiser:
    """Open Image Denoise on both renders, on the CPU.

    Args:
        threads: 0 for all.
        exact: never in 8 bits (:mod:`oiio_msspl.model.quantised`), which is otherwise done where it can be.

    Attributes:
        hrls: what denoises the HRLS.
        both: what denoises both together.
        albedo: what denoises the albedo for that, at x2.

    Raises:
        InputError: pyoidn is not installed.
    """

    def __init__(self, threads: int = 0, *, exact: bool = False) -> None:
        try:
            import pyoidn
        except (ImportError, OSError) as error:  # not installed, or without its library
            raise InputError(
                "this model reads Open Image Denoise's result: pip install pyoidn, or choose another --model"
            ) from error
        device = pyoidn.Device()
        device.set_int("numThreads", threads)
        device.set_bool("setAffinity", False)  # other threads of the process want the cores too
        device.commit()

        def filter_(quality: str, network: str, *, hdr: bool = True, clean: bool = False) -> Filter:
            name = "" if exact else network
            return Filter(device, quality, hdr=hdr, clean=clean, network=name, threads=threads)

        self.hrls = filter_("high", "rt_hdr_alb_nrm")
        # A larger network than the usual one
        self.both = filter_("high", "rt_hdr_calb_cnrm_large", clean=True)
        # Quality high would take four times as long and gain nothing
        self.albedo = filter_("fast", "rt_alb", hdr=False)

    def __call__(self, lrhs: Array, hrls: Array, low_aovs: Layers = NO_LAYERS) -> tuple[Array, Array]:
        """Denoise a pair as the network sees it.

        Args:
            lrhs: (h, w, 3), transformed.
            hrls: (s*h, s*w, 16), transformed, channels as in :data:`oiio_msspl.aovs.features.HRLS_FEATURES`.
            low_aovs: see :func:`mean_of_renders`.

        Returns:
            Both with what was denoised as further channels, transformed colour: (h, w, 6), the LRHS with both renders
            together at its resolution; and (s*h, s*w, 19), the HRLS with itself denoised.

        Raises:
            MssplError: Open Image Denoise failed.
        """
        low, high = _with_room(lrhs), _with_room(hrls)
        self.fill(low, high, low_aovs)
        return low, high

    def fill(self, lrhs: Array, hrls: Array, low_aovs: Layers = NO_LAYERS) -> None:
        """The same in place: what is denoised is written behind the renders' own channels, which must have room for it.

        Args:
            lrhs: (h, w, 6).
            hrls: (s*h, s*w, 19).
            low_aovs: see :func:`mean_of_renders`.

        Raises:
            MssplError: Open Image Denoise failed.
        """
        layers = denoiser_layers(hrls)
        self.both(self.merged(lrhs[..., :_OF_LRHS], layers, low_aovs), lrhs[..., _OF_LRHS:])
        self.hrls(layers, hrls[..., _OF_HRLS:])

    def together(self, lrhs: Array, hrls: Array, low_aovs: Layers = NO_LAYERS) -> Array:
        """Of the same arguments, both renders denoised together at the LRHS's resolution, network values (h, w, 3).

        Raises:
            MssplError: Open Image Denoise failed.
        """
        return self.both(self.merged(lrhs, denoiser_layers(hrls), low_aovs))

    def merged(self, lrhs: Array, layers: Layers, low_aovs: Layers = NO_LAYERS) -> Layers:
        """What is denoised together: as :func:`mean_of_renders`, but with layers that have no noise.

        Raises:
            MssplError: Open Image Denoise failed.
        """
        scale = layers["colour"].shape[0] // lrhs.shape[0]
        low = mean_of_renders(lrhs, layers, low_aovs)
        del low["noise"]
        if scale == 2 and "albedo" in low:
            low["albedo"] = self.albedo({"albedo": low["albedo"]})
        return low


class MeanDenoiser:
    """Both renders denoised together, by a network in 8 bits that was made of Open Image Denoise's larger one
    (:mod:`training.together`).

    Args:
        threads: 0 for all.

    Raises:
        InputError: pyoidn is not installed, or has other weights.
    """

    def __init__(self, threads: int = 0) -> None:
        self._network = QuantisedDenoiser("mean_denoiser", installed_weights("rt_hdr_calb_cnrm_large"), threads)

    def __call__(self, lrhs: Array, hrls: Array, low_aovs: Layers = NO_LAYERS) -> tuple[Array, Array]:
        """Denoise a pair as the network sees it.

        Args:
            lrhs: (h, w, 3), transformed.
            hrls: (s*h, s*w, 9) or more, transformed: colour, albedo, normal.
            low_aovs: see :func:`mean_of_renders`.

        Returns:
            The LRHS with what was denoised as further channels, transformed colour: (h, w, 6); and the HRLS.
        """
        low = _with_room(lrhs)
        self.fill(low, hrls, low_aovs)
        return low, hrls

    def fill(self, lrhs: Array, hrls: Array, low_aovs: Layers = NO_LAYERS) -> None:
        """The same in place, of an LRHS (h, w, 6): what is denoised is written behind its own channels."""
        low = mean_of_renders(lrhs[..., :_OF_LRHS], denoiser_layers(hrls, complete=True), low_aovs)
        self._network(**low, out=lrhs[..., _OF_LRHS:])


def denoiser_for(mode: str, threads: int, *, exact: bool = False) -> OidnDenoiser | MeanDenoiser | None:
    """What denoises for a model: nothing for an empty mode; ``high``: a :class:`Denoiser`; ``together``."""
    if mode == "together":
        return MeanDenoiser(threads)
    return OidnDenoiser(threads, exact=exact) if mode else None


@functools.cache
def eight_bits_work() -> bool:
    """Whether pyoidn is installed, with weights that :mod:`oiio_msspl.model.quantised` knows, and this machine computes with
    them in 8 bits what Open Image Denoise does in 32."""
    try:
        return OidnDenoiser().hrls.in_eight_bits
    except InputError:
        return False


def _with_room(image: Array) -> Array:
    """A copy with channels for what is denoised, too; they lie one behind the other in memory."""
    height, width, channels = image.shape
    more = sum(DENOISED_FEATURES.values())
    copy = np.empty((channels + more, height, width), dtype=np.float32).transpose(1, 2, 0)
    copy[..., :channels] = image
    return copy


def _picture_to_try() -> Layers:
    """Something of everything: noise, edges, slopes, highlights; all numbers from a formula."""
    y, x = np.mgrid[:64, :64].astype(np.float32) / 64
    noise = (np.modf(np.sin(np.arange(64 * 64 * 3, dtype=np.float64) * 12.9898) * 43758.5453)[0] ** 2).astype(
        np.float32
    )
    albedo = np.stack([np.where((x * 6 + y * 3) % 2 < 1, 0.2, 0.7), 0.3 + 0.4 * y, 0.5 + 0 * x], axis=-1)
    normal = np.stack([np.where(x > y, 0.8, -0.6), np.where(x > y, 0.6, 0), np.where(x > y, 0, 0.8)], axis=-1)
    light = albedo * (0.05 + 4 * (x * y)[..., None] ** 3) + 50 * ((x - 0.3) ** 2 + (y - 0.6) ** 2 < 0.002)[..., None]
    radiance = light * -np.log(1e-3 + noise.reshape(64, 64, 3))
    values = encode_radiance(radiance.astype(np.float32), 1.0)
    return {"colour": values, "albedo": albedo.astype(np.float32), "normal": normal.astype(np.float32)}
