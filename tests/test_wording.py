# SPDX-License-Identifier: Apache-2.0
"""Messages name options in the programs, and arguments in Python."""

import ast
import pickle
import re
from pathlib import Path

import pytest

import oiio_msspl
from oiio_msspl import InputOptions, TemporalOptions, WriteOptions, fuse_files, wording
from oiio_msspl.errors import InputError, explain
from oiio_msspl.findings import Finding
from tests.shots import make_shot

#: Options of other programs, and those that a job's template holds.
OTHERS = {"--nthreads", "--short", "--html", "--progress", "--output", "--components", "--scale", "--no-preview"}


@pytest.fixture
def in_python(monkeypatch):
    monkeypatch.setattr(wording, "for_command_line", False)


@pytest.mark.parametrize(
    ("text", "python"),
    [
        ("name its layer with --map albedo=LAYER", 'name its layer with mapping={"albedo": "LAYER"}'),
        ("(--map rgb=LAYER)", '(mapping={"rgb": "LAYER"})'),
        ("use --device cpu meanwhile, or another --model", 'use device="cpu" meanwhile, or another model'),
        ("use --quality best.", 'use model="best".'),
        ("--float keeps them", 'pixel_type="float" keeps them'),
        ("--max-memory '3X': write it as 3G", "max_memory '3X': write it as 3G"),
        ("pass --skip-existing or --overwrite", "pass skip_existing or overwrite"),
        ("shot--final.exr: no such file", "shot--final.exr: no such file"),
    ],
)
def test_options_become_arguments(in_python, text, python):
    assert wording.worded(text) == python
    wording.for_command_line = True
    assert wording.worded(text) == text


def test_errors_and_warnings_of_python_name_no_options(in_python, tmp_path):
    make_shot(tmp_path, 1)
    pair = tmp_path / "lr/lr.1001.exr", tmp_path / "hr/beauty.1001.exr"
    for arguments in (
        {"max_memory": "much"},
        {"device": "toaster"},
        {"inputs": InputOptions(mapping={"albedo": "no"})},
    ):
        with pytest.raises(InputError) as error:
            fuse_files(*pair, tmp_path / "out.exr", **arguments)
        assert "--" not in str(error.value) and "--" not in explain(error.value)[0]
    for wrong in (lambda: TemporalOptions("99"), lambda: WriteOptions(layout="round"), lambda: InputOptions(sums="a")):
        with pytest.raises(InputError) as error:
            wrong()
        assert "--" not in str(error.value)


def test_every_message_can_be_worded(in_python):
    """No text of the library keeps an option when Python reads it, and each is an argument that exists."""
    source = Path(oiio_msspl.__file__).parent
    said = set()
    for path in source.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
                said |= {*re.findall(r"(?<![\w-])--[a-z][a-z-]*", node.value)} - OTHERS
    assert len(said) > 25
    code = "".join(path.read_text(encoding="utf-8") for path in source.rglob("*.py"))
    for option in said:
        argument = wording.worded(option)
        assert "--" not in argument
        name = argument.partition("=")[0]
        assert name == "its traceback" or re.search(rf"^    {name}: ", code, re.MULTILINE), (option, argument)


def test_a_finding_of_a_worker_is_worded_where_it_is_read(in_python):
    kept = pickle.dumps(Finding("clipped", "--float keeps them").about("left"))
    assert pickle.loads(kept) == 'left: pixel_type="float" keeps them'
    wording.for_command_line = True
    read = pickle.loads(kept)
    assert (read, read.code) == ("left: --float keeps them", "clipped")
