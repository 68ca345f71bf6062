# SPDX-License-Identifier: Apache-2.0
"""The low-resolution denoiser of the `joint` models."""

from __future__ import annotations

from oiio_msspl.aovs.features import LRHS_FEATURES
from oiio_msspl.arrays import Array
from oiio_msspl.model.oidn import append_channels
from oiio_msspl.model.oidn_weights import require_weights
from oiio_msspl.model.quantised import QuantisedDenoiser
from oiio_msspl.model.render_mean import NO_IMAGES, Images, denoiser_images, mean_of_renders

_LRHS_CHANNELS = sum(LRHS_FEATURES.values())


class MeanDenoiser:
    """Denoises the mean of both renders at the LRHS's resolution, by a network in 8 bits.

    The network was trained from OIDN's large one. It also reads how far the two renders differ, as an estimate of their
    noise, so the albedo needs no prefilter.

    Args:
        threads: CPU threads; 0 for one a core.

    Raises:
        InputError: pyoidn is not installed, or has other weights.
    """

    def __init__(self, threads: int = 0) -> None:
        self._network = QuantisedDenoiser("mean_denoiser", require_weights("rt_hdr_calb_cnrm_large"), threads)

    def __call__(self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES) -> tuple[Array, Array]:
        """Denoise an encoded pair.

        Args:
            lrhs: (h, w, 3), encoded.
            hrls: (s*h, s*w, 9 or more), encoded: colour, albedo, normal.
            lrhs_aovs: see :func:`oiio_msspl.model.render_mean.mean_of_renders`.

        Returns:
            A copy of the LRHS with the denoised mean as three more channels of log-encoded colour, (h, w, 6), and the
            HRLS as it is.
        """
        lrhs = append_channels(lrhs, 3)
        self.fill(lrhs, hrls, lrhs_aovs)
        return lrhs, hrls

    def fill(self, lrhs: Array, hrls: Array, lrhs_aovs: Images = NO_IMAGES) -> None:
        """The same in place: fill the last three channels of the LRHS, (h, w, 6)."""
        images = mean_of_renders(lrhs[..., :_LRHS_CHANNELS], denoiser_images(hrls, complete=True), lrhs_aovs)
        self._network(**images, out=lrhs[..., _LRHS_CHANNELS:])
