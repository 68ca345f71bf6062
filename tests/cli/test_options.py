# SPDX-License-Identifier: Apache-2.0
"""Options as values of the library."""

from msspl_cli.options import make_inputs


def test_a_mapping_of_the_command_line_wins_over_that_of_a_file(tmp_path):
    file = tmp_path / "map.toml"
    file.write_text('albedo = "of the file"\nnormal = "of the file"\n')
    mapping = make_inputs(["albedo=of the line"], file, None, None, None).mapping
    assert mapping == {"albedo": "of the line", "normal": "of the file"}
