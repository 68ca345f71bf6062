# SPDX-License-Identifier: Apache-2.0
from oiio_msspl.aovs.features import HRLS_FEATURES
from oiio_msspl.aovs.mapping import check_mapping
from oiio_msspl.aovs.renderers import renderers


def test_the_shipped_table_has_no_mistakes():
    for renderer in renderers():
        candidates = [(f, c) for f in HRLS_FEATURES for c in renderer.get(f, [])]
        assert candidates
        for feature, candidate in candidates:
            check_mapping({feature: candidate}, renderer["name"])
