# SPDX-License-Identifier: Apache-2.0
"""Warnings have codes that are documented."""

import ast
import copy
import re
from pathlib import Path

import oiio_msspl
from oiio_msspl.findings import Finding, codes_of
from tests.test_pages import ROOT


def test_every_code_is_used_and_documented():
    used = {"older"}  # a constant
    for path in Path(oiio_msspl.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                used |= {node.args[0].value} if isinstance(node.args[0], ast.Constant) else set()
    page = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    assert sorted(used) == sorted(re.findall(r"^\| `(\w+)` \| \S.* \|$", page, re.MULTILINE))


def test_a_finding_is_its_sentence():
    finding = Finding("no_albedo", "no albedo was found")
    assert finding == "no albedo was found" and copy.deepcopy(finding).code == "no_albedo"
    assert codes_of([finding, "told by Blender"]) == ["no_albedo", "other"]
