# SPDX-License-Identifier: Apache-2.0
import pytest

from oiio_msspl.errors import InputError
from oiio_msspl.exr.write_options import WriteOptions
from tests.conftest import picture, rgb
from tests.exr.sources import H, W, everything, written


def test_multilayer_layout_is_one_part(tmp_path):
    _, _, parts = written(tmp_path, everything(), WriteOptions(layout="multilayer"))
    assert len(parts) == 1
    assert parts[0][1].keys() == everything().keys()


def test_multilayer_refuses_parts_of_different_windows(tmp_path):
    source = [("rgba", rgb(picture(H, W)), (0, 0)), ("mist", {"mist.Z": picture(20, 10)[..., 1]}, (5, 3))]
    with pytest.raises(InputError, match=r"part 'mist' of .* one part can hold only one, use --layout spec"):
        written(tmp_path, source, WriteOptions(layout="multilayer"))
    assert not (tmp_path / "out.exr").exists()
