# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.reader import open_exr
from tests.aovs.renders import H, W, layer, mapped, plane
from tests.conftest import SHARED, needs_shared


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ({"layer": "v", "kind": "mean"}, 0.64),
        ({"layer": "v", "kind": "per_sample"}, 0.16),
        ({"layer": "v", "kind": "relative"}, 0.64 * 0.5 / 4),
        ({"layer": "v", "kind": "second_moment"}, (0.64 - 0.25) / 4),
        ({"layer": "v", "kind": "deviation"}, 0.64**2),
        ({"halves": ["a", "b"]}, (0.6 - 0.2) ** 2 / 4),
    ],
)
def test_every_kind_of_variance_becomes_that_of_the_mean(tmp_path, entry, expected):
    """A grey pixel of 0.5 with 4 spp: all six descriptions give the variance of the mean luminance."""
    channels = {c: plane(0.5) for c in "RGB"}
    channels |= {f"{n}.{c}": plane(v) for n, v in (("v", 0.64), ("a", 0.6), ("b", 0.2)) for c in "RGB"}
    render = mapped(tmp_path, channels, {"variance": entry}, spp=4)
    np.testing.assert_allclose(render.read(render.data_window)["variance"], expected, rtol=1e-5)


def test_a_luminance_variance_is_taken_as_it_is(tmp_path):
    render = mapped(tmp_path, layer("", 1) | {"variance.Y": plane(0.25)})
    assert render.read(render.data_window)["variance"].shape == (H, W, 1)
    assert render.read(render.data_window)["variance"][0, 0, 0] == 0.25


@needs_shared("exr")
def test_cycles_layers_add_up_to_the_beauty():
    """The paper's equations: diffuse + gloss + transmission + emission + environment is the beauty."""
    render = map_render(
        open_exr(SHARED / "exr/cycles-5.0/cycles_viewlayer_zip32.exr"),
        {
            "albedo": {"sum": ["Transmission Direct", "Transmission Indirect"], "times": "Transmission Color"},
            "normal": {"sum": ["Emission", "Environment"]},
        },
    )
    values = render.read(render.data_window)
    total = values["diffuse"] + values["specular"] + values["albedo"] + values["normal"]
    np.testing.assert_allclose(total, values["rgb"], atol=1e-4)
