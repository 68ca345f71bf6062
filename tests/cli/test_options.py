# SPDX-License-Identifier: Apache-2.0
"""Options as values of the library."""

import pytest
from msspl_cli.options import make_inputs

from oiio_msspl.jobs.settings import bytes_of


def test_a_mapping_of_the_command_line_wins_over_that_of_a_file(tmp_path):
    file = tmp_path / "map.toml"
    file.write_text('albedo = "of the file"\nnormal = "of the file"\n')
    mapping = make_inputs(["albedo=of the line"], file, None, None, None).mapping
    assert mapping == {"albedo": "of the line", "normal": "of the file"}


@pytest.mark.parametrize(
    ("text", "size"), [("3G", 3 << 30), ("800M", 800 << 20), ("1.5 kiB", 1536), ("77", 77), ("9" * 400, 1 << 62)]
)
def test_sizes_are_counted_in_powers_of_1024(text, size):
    assert bytes_of(text) == size
