# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from oiio_msspl.aovs.features import HRLS_FEATURES
from oiio_msspl.exr.render import CHANNELS, Render, Window


def test_a_window_counts_rows_downwards_and_its_end_does_not_belong_to_it():
    window = Window(-2, 3, 5, 4)
    assert (window.width, window.height, window.size, str(window)) == (7, 1, "7x1", "7x1-2+3")
    assert window.shift(2, -3) == Window(0, 0, 7, 1)


def test_windows_that_do_not_meet_have_an_empty_intersection():
    assert Window(0, 0, 4, 4).intersect(Window(2, 1, 9, 3)) == Window(2, 1, 4, 3)
    apart = Window(0, 0, 4, 4).intersect(Window(6, 0, 9, 4))
    assert (apart.width, apart.height) == (0, 4)


def test_slices_select_a_window_in_an_array_of_another():
    values = np.arange(40).reshape(5, 8)
    assert (values[Window(1, -1, 3, 1).slices(Window(0, -2, 8, 3))] == [[9, 10], [17, 18]]).all()


def test_a_render_reads_the_layers_that_it_has():
    rgb = np.arange(24, dtype=np.float64).reshape(2, 4, 3)
    render = Render.from_arrays(rgb=rgb, alpha=np.ones((2, 4, 1)))
    layers = render.read(Window(1, 0, 3, 2), ["rgb", "albedo"])
    assert layers.keys() == {"rgb"}
    assert layers["rgb"].dtype == np.float32
    np.testing.assert_array_equal(layers["rgb"], rgb[:, 1:3])
    assert render.read(Window(0, 0, 4, 2)).keys() == {"rgb", "alpha"}


def test_a_render_needs_a_beauty_and_layers_of_one_size():
    with pytest.raises(ValueError, match="no 'rgb' among the layers"):
        Render.from_arrays(albedo=np.ones((2, 2, 3)))
    with pytest.raises(ValueError, match=r"layer 'alpha' has shape \(2, 2\), expected \(2, 2, 1\)"):
        Render.from_arrays(rgb=np.ones((2, 2, 3)), alpha=np.ones((2, 2)))
    for flat in ([1.0, 2.0], 1.0, None):
        with pytest.raises(ValueError, match=r"layer 'rgb' has shape .*, expected \(height, width, 3\)"):
            Render.from_arrays(rgb=flat)
    assert Render.from_arrays(rgb=[[[1.0, 2.0, 3.0]]]).layers["rgb"].dtype == np.float32


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ({"rgb": np.ones((2, 2, 4))}, r"layer 'rgb' has shape \(2, 2, 4\), expected \(2, 2, 3\)"),
        ({"albedo": np.ones((2, 2, 1))}, r"layer 'albedo' has shape \(2, 2, 1\), expected \(2, 2, 3\)"),
        ({"rgb": np.ones((0, 2, 3))}, r"layer 'rgb' has shape \(0, 2, 3\)"),
        ({"Albedo": np.ones((2, 2, 3))}, "layer 'Albedo' is none of rgb, albedo, "),
        ({"rgb": np.ones((2, 2, 3), np.uint8)}, "layer 'rgb' holds uint8, expected floats"),
    ],
)
def test_layers_that_are_no_features_are_refused(layers, message):
    with pytest.raises(ValueError, match=message):
        Render.from_arrays("render", **{"rgb": np.ones((2, 2, 3))} | layers)


def test_the_layers_of_a_render_are_the_features_of_the_models():
    assert {name: count for name, count in CHANNELS.items() if name != "alpha"} == HRLS_FEATURES
