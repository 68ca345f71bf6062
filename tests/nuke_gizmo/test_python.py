# SPDX-License-Identifier: Apache-2.0
"""The gizmo's Python: its syntax, its imports, and its calls of Nuke's API."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

from tests.nuke_gizmo import fake_nuke
from tests.nuke_gizmo.conftest import FOLDER

SOURCES = sorted(FOLDER.rglob("*.py"))


def test_all_is_python_3_9_and_only_three_modules_import_nuke(button_scripts):
    """Everything else is imported from the standard library and from the gizmo's own folder."""
    texts = {str(path.relative_to(FOLDER)): path.read_text(encoding="utf-8") for path in SOURCES}
    imports = {}
    for name, text in (texts | button_scripts).items():
        imports[name] = set()
        for statement in ast.walk(ast.parse(text, name, feature_version=(3, 9))):
            if isinstance(statement, ast.Import):
                imports[name] |= {alias.name for alias in statement.names}
            elif isinstance(statement, ast.ImportFrom):
                imports[name].add(str(statement.module).partition(".")[0])
    assert set().union(*imports.values()) <= sys.stdlib_module_names | {"nuke", "msspl_bridge", "msspl_nuke"}
    assert {name for name, modules in imports.items() if "nuke" in modules} == {"init.py", "menu.py", "msspl_nuke.py"}


def test_the_gizmo_agrees_with_the_stubs_of_nukes_api(button_scripts, tmp_path):
    """mypy checks the modules and the buttons' scripts. It also sees two mistakes that are planted for it."""
    api = pytest.importorskip("mypy.api")
    buttons = "import nuke\n"
    for name, text in button_scripts.items():
        buttons += f"\n\ndef {name}() -> None:\n" + "".join(f"    {line}\n" for line in text.splitlines())
    (tmp_path / "buttons.py").write_text(buttons)
    (tmp_path / "wrong.py").write_text("import nuke\n\n\nnuke.mesage('')\nnuke.thisNode().nam()\n")
    # 3.10 is the oldest Python that mypy supports. The project's own cache belongs to another version of Python.
    options = ["--python-version", "3.10", "--disallow-untyped-defs", f"--cache-dir={FOLDER.parent}/.mypy_cache/nuke"]
    out, err, _ = api.run([*options, *map(str, SOURCES), *(str(tmp_path / f"{n}.py") for n in ("buttons", "wrong"))])
    assert not err
    errors = [line for line in out.splitlines() if ": error:" in line]
    assert len(errors) == 2, out
    assert all("wrong.py" in line and "attr-defined" in line for line in errors), out


def test_the_fake_nuke_offers_only_what_nuke_offers():
    """Every public function, method and parameter of the fake is in types-nuke."""
    stubs = importlib.util.find_spec("nuke-stubs")
    if stubs is None or not stubs.submodule_search_locations:
        pytest.skip("types-nuke is not installed")
    folder = Path(stubs.submodule_search_locations[0])
    classes, functions = {}, {}
    for path in folder.glob("*.pyi"):
        for item in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(item, ast.ClassDef):
                classes[item.name] = {m.name: m for m in item.body if isinstance(m, ast.FunctionDef)}
                classes[item.name][""] = [b.id for b in item.bases if isinstance(b, ast.Name)]
            elif isinstance(item, ast.FunctionDef):
                functions[item.name] = item

    def real(name, method):
        found = classes.get(name, {}).get(method)
        return found or next(filter(None, (real(base, method) for base in classes.get(name, {}).get("", ()))), None)

    def accepts(stub, fake):
        names = {a.arg for a in [*stub.args.args, *stub.args.kwonlyargs]}
        return bool(stub.args.vararg) or {a.arg for a in fake.args.args} <= names

    for item in ast.parse(Path(fake_nuke.__file__).read_text(encoding="utf-8")).body:
        if not isinstance(item, ast.ClassDef):
            continue
        for method in (m for m in item.body if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")):
            if item.name == "FakeNuke":
                if method.name in ("nodes_of", "add", "press", "wait", "count_change"):
                    continue
                method.args.args = method.args.args[1:]
                stub = functions.get(method.name)
            else:
                stub = real(item.name, method.name)
            assert stub is not None, f"{item.name}.{method.name}"
            assert method.name == "metadata" or accepts(stub, method), f"{item.name}.{method.name}"
