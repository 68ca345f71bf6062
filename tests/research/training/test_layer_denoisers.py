# SPDX-License-Identifier: Apache-2.0
"""Open Image Denoise's networks for albedo and normal."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import noisy, picture

pyoidn = pytest.importorskip("pyoidn")
torch = pytest.importorskip("torch")

from research.training.denoisers import LayerDenoisers  # noqa: E402
from research.training.encoding import from_srgb, srgb  # noqa: E402


def test_srgb_and_its_inverse():
    values = torch.linspace(0, 1, 1001)
    torch.testing.assert_close(from_srgb(srgb(values)), values)


def test_they_are_open_image_denoise():
    """At quality balanced, which runs the base networks."""
    device = pyoidn.Device()
    device.commit()

    def denoised(name, image):
        denoiser = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
        denoiser.set_quality(pyoidn.OIDN_QUALITY_BALANCED)
        output = np.empty_like(image)
        for kind, values in ((name, image), (pyoidn.OIDN_IMAGE_OUTPUT, output)):
            denoiser.set_image(kind, values, pyoidn.OIDN_FORMAT_FLOAT3)
        denoiser.commit()
        denoiser.execute()
        return output

    albedo = noisy(picture(64, 96).clip(0, 1), 64).clip(0, 1)
    normal = noisy(np.broadcast_to(np.float32([0.6, 0.8, 0.4]), albedo.shape), 64, seed=2).clip(-1, 1)
    with torch.inference_mode():
        images = (torch.from_numpy(image.transpose(2, 0, 1)[None].copy()) for image in (albedo, normal))
        found = [image[0].permute(1, 2, 0).numpy() for image in LayerDenoisers()(*images)]
    np.testing.assert_allclose(found[0], denoised("albedo", albedo), atol=1e-3)
    np.testing.assert_allclose(2 * found[1] - 1, denoised("normal", normal), atol=2e-3)
