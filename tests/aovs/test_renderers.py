# SPDX-License-Identifier: Apache-2.0
import pytest

from oiio_msspl.aovs.features import HRLS_FEATURES
from oiio_msspl.aovs.mapping import check_mapping
from oiio_msspl.aovs.renderers import renderers, view_layer_of


def test_the_shipped_table_has_no_mistakes():
    for renderer in renderers():
        candidates = [(f, c) for f in HRLS_FEATURES for c in renderer.get(f, [])]
        assert candidates
        for feature, candidate in candidates:
            check_mapping({feature: candidate}, renderer["name"])


@pytest.mark.parametrize(
    ("layer", "alias", "view_layer"),
    [
        ("Combined", "Combined", ""),
        ("denoising_albedo", "Denoising Albedo", ""),
        ("m2_foo", "m2_*", ""),
        ("", "", ""),
        ("ViewLayer.Combined", "Combined", "ViewLayer"),
        ("Main.Beauty v1.2.Denoising Albedo", "Denoising Albedo", "Main.Beauty v1.2"),
        ("Combined2", "Combined", None),
        ("ViewLayerCombined", "Combined", None),
        ("ViewLayer.Combined", "", None),
    ],
)
def test_names_match_whatever_their_spelling_and_tell_the_view_layer(layer, alias, view_layer):
    assert view_layer_of(layer, alias) == view_layer
