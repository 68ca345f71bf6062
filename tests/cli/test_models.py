# SPDX-License-Identifier: Apache-2.0
"""msspl models, as a process."""

import json

from tests.programs import run


def test_models_lists_what_ships():
    data = json.loads(run("msspl", "models", "--json").stdout)
    assert {m["name"] for m in data["models"]} >= {"paper-x2", "paper-x4", "paper-x8"}
    assert "cpu" in data["devices"]
