# SPDX-License-Identifier: Apache-2.0
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.write_options import WriteOptions


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layout": "x"}, "use one of spec, nuke, multilayer"),
        ({"compression": "x"}, "use one of none"),
        ({"layout": "multilayer", "compression": "dwaa"}, "all layers would lose bits, .* or one of none, rle, zip"),
    ],
)
def test_unknown_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        WriteOptions(**options)


def test_a_beauty_alone_may_lose_bits():
    assert WriteOptions("multilayer", compression="dwaa", layers=("none",)).compression == "dwaa"
