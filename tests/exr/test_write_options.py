# SPDX-License-Identifier: Apache-2.0
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.write_options import WriteOptions


@pytest.mark.parametrize(
    ("options", "message"),
    [({"layout": "x"}, "use one of spec, nuke, multilayer"), ({"compression": "x"}, "use one of none")],
)
def test_unknown_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        WriteOptions(**options)
