# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise on both renders, for models that read its results: the only module that imports pyoidn, which is
optional.

The HRLS is denoised as anyone would, with its albedo and normal. The LRHS has neither; but its light and the HRLS's are
independent samples of the same scene, so at the LRHS's resolution their mean has less noise than either, and the
HRLS's albedo and normal, averaged over s x s pixels, have hardly any: Open Image Denoise may be told that they are
clean, which is worth 0.8 to 1.5 dB (at x2 the albedo is denoised first, or nothing is told). What it makes of these is
better at that resolution than its result on the HRLS, for a fraction of the time.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np

from oiio_msspl import schema, transforms
from oiio_msspl.errors import InputError, MssplError
from oiio_msspl.render import Array

if TYPE_CHECKING:
    import pyoidn

_OF_LRHS, _OF_HRLS = sum(schema.LRHS_FEATURES.values()), sum(schema.HRLS_FEATURES.values())
_FIRST = dict(zip(schema.HRLS_FEATURES, np.cumsum([0, *schema.HRLS_FEATURES.values()]), strict=False))


#: What is denoised: both renders together at the LRHS's resolution, and the HRLS too, in one of three qualities.
MODES = ("low", "fast", "balanced", "high")
#: Bounds of the LRHS's share in what is denoised at its resolution: an estimate that wants all or none may be wrong.
_SHARE = (0.05, 0.95)


class Denoiser:
    """Open Image Denoise on the CPU.

    Args:
        threads: 0 for all.
        mode: one of ``MODES``.

    Raises:
        InputError: pyoidn is not installed.
    """

    def __init__(self, threads: int = 0, mode: str = "high") -> None:
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
        self._lock = threading.Lock()  # a filter remembers the images of one call at a time
        self._format = pyoidn.OIDN_FORMAT_FLOAT3
        # One for each kind of images: a filter plans anew when it gets others
        self._high = None
        if mode != "low":
            self._high = self._filter(hdr=True, quality=getattr(pyoidn, f"OIDN_QUALITY_{mode.upper()}"))
        self._low = self._filter(hdr=True, quality=pyoidn.OIDN_QUALITY_HIGH, clean=True)
        # For that, Open Image Denoise has a larger network, which at x2 takes for a quarter of the pixels half as long
        # as the usual one for all. Some modes are for those in a hurry: a third of the time for 0 to 0.3 dB less.
        hurry = mode in ("low", "fast")
        self._low_x2 = self._filter(hdr=True, quality=pyoidn.OIDN_QUALITY_BALANCED) if hurry else None
        # Quality high would take four times as long and gain nothing
        self._low_albedo = self._filter(hdr=False, quality=pyoidn.OIDN_QUALITY_FAST)

    def _filter(self, *, hdr: bool, quality: int, clean: bool = False) -> pyoidn.Filter:
        import pyoidn

        new = pyoidn.Filter(self._device, pyoidn.OIDN_FILTER_TYPE_RT)
        new.set_quality(quality)
        new.set_bool("cleanAux", clean)
        if hdr:
            new.set_bool("hdr", True)
            # Network values are exposed by the LRHS. Left alone, it would expose every tile for itself.
            new.set_float("inputScale", 1.0)
        return new

    def __call__(self, lrhs: Array, hrls: Array) -> tuple[Array, Array]:
        """Denoise a pair as the network sees it.

        Args:
            lrhs: (h, w, 3), transformed.
            hrls: (s*h, s*w, 16), transformed, channels as in :data:`oiio_msspl.schema.HRLS_FEATURES`.

        Returns:
            Both with what was denoised as further channels, transformed colour: (h, w, 6), the LRHS with both renders
            together at its resolution; and (s*h, s*w, 19), the HRLS with itself denoised, or as it is (mode ``low``).

        Raises:
            MssplError: Open Image Denoise failed.
        """
        low = _with_room(lrhs)
        high = hrls if self._high is None else _with_room(hrls)
        self.fill(low, high)
        return low, high

    def fill(self, lrhs: Array, hrls: Array) -> None:
        """The same in place: what is denoised is written behind the renders' own channels, which must have room for it.

        Args:
            lrhs: (h, w, 6).
            hrls: (s*h, s*w, 19); 16 in mode ``low``.

        Raises:
            MssplError: Open Image Denoise failed.
        """
        layers = _layers(hrls)
        transforms.compress(self._together(lrhs[..., :_OF_LRHS], layers), 1.0, lrhs[..., _OF_LRHS:])
        if self._high is not None:
            transforms.compress(self._denoised(self._high, layers), 1.0, hrls[..., _OF_HRLS:])

    def together(self, lrhs: Array, hrls: Array) -> Array:
        """Of the same arguments, radiance of both renders denoised together at the LRHS's resolution, (h, w, 3).

        Raises:
            MssplError: Open Image Denoise failed.
        """
        return self._together(lrhs, _layers(hrls))

    def _together(self, lrhs: Array, layers: dict[str, Array]) -> Array:
        scale = layers["color"].shape[0] // lrhs.shape[0]
        low = {name: transforms.box_downsample(image, scale) for name, image in layers.items()}
        share = lrhs_share(lrhs, transforms.compress(low["color"], 1.0))
        low["color"] = share * transforms.expand(lrhs, 1.0) + (1 - share) * low["color"]
        filter_ = self._low
        if scale == 2 and self._low_x2 is not None:
            filter_ = self._low_x2
        elif scale == 2 and "albedo" in low:
            low["albedo"] = np.clip(self._denoised(self._low_albedo, {"albedo": low["albedo"]}), 0, 1)
        return self._denoised(filter_, low)

    def _denoised(self, filter_: pyoidn.Filter, layers: dict[str, Array]) -> Array:
        """The first of the images (h, w, 3), with the help of the others."""
        images = {name: np.ascontiguousarray(image, dtype=np.float32) for name, image in layers.items()}
        images["output"] = np.empty_like(next(iter(images.values())))
        with self._lock:
            for name in ("color", "albedo", "normal", "output"):
                if name in images:
                    filter_.set_image(name, images[name], self._format)
                else:
                    filter_.unset_image(name)
            filter_.commit()
            filter_.execute()
            if message := self._device.get_error():
                raise MssplError(f"Open Image Denoise failed: {message}")
        return images["output"]


def _with_room(image: Array) -> Array:
    """A copy with channels for what is denoised, too; they lie one behind the other in memory."""
    height, width, channels = image.shape
    more = sum(schema.DENOISED_FEATURES.values())
    copy = np.empty((channels + more, height, width), dtype=np.float32).transpose(1, 2, 0)
    copy[..., :channels] = image
    return copy


def _layers(hrls: Array) -> dict[str, Array]:
    """The HRLS as Open Image Denoise takes it: radiance, and albedo and normal as far as they are there."""
    colour = {"color": transforms.expand(_feature(hrls, schema.RGB), 1.0)}
    albedo = transforms.limited(_feature(hrls, schema.ALBEDO), 0.0, 1.0)
    normal = transforms.limited(_feature(hrls, schema.NORMAL), -1.0, 1.0)
    # A layer that is absent has its default everywhere; Open Image Denoise takes no normals without an albedo.
    if normal.any():
        return colour | {"albedo": albedo, "normal": normal}
    return colour | ({"albedo": albedo} if (albedo != schema.DEFAULTS[schema.ALBEDO]).any() else {})


def lrhs_share(lrhs: Array, hrls: Array) -> float:
    """Share of the LRHS in the mean of both renders that has the least noise.

    What one pixel differs by from its neighbours is picture and noise. The picture is the same in both renders, the
    noise is not: their covariance is the picture's part, and what each has beyond that is its noise.

    Args:
        lrhs, hrls: (h, w, 3) at the same resolution, transformed.

    Returns:
        The share, within 0.05 and 0.95; 0.5 for equal noise, and for none.
    """
    one, other = (x[1:, 1:] - x[1:, :-1] - x[:-1, 1:] + x[:-1, :-1] for x in (lrhs, hrls))
    common = np.mean(one * other)
    noise, other_noise = (max(float(np.mean(x * x) - common), 1e-9) for x in (one, other))
    return float(np.clip(other_noise / (noise + other_noise), *_SHARE))


def _feature(hrls: Array, name: str) -> Array:
    return hrls[..., _FIRST[name] : _FIRST[name] + schema.HRLS_FEATURES[name]]
