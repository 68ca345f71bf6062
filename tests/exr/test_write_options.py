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
        ({"pixel_type": "uint"}, "use half or float"),
        ({"layers": "depth"}, r"--layers 'depth': give a tuple of patterns, such as \('depth',\)"),
        ({"passes": "light*"}, "--passes 'light.*': give a tuple"),
        ({"passes": ("none", "light*")}, "--passes none excludes light"),
        ({"layers": ("depth", "none")}, "--layers none excludes depth"),
    ],
)
def test_unknown_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        WriteOptions(**options)


def test_a_beauty_alone_may_lose_bits():
    assert WriteOptions("multilayer", compression="dwaa", layers=("none",)).compression == "dwaa"
