# SPDX-License-Identifier: Apache-2.0
"""Pages keep their promises: their commands and snippets run, their links lead somewhere, their messages exist.

A block of commands runs in a folder of its own, which holds the files that the pages name. ``NOT_RUN`` lists commands
that need what a test machine lacks; the program's own parser must accept their options.
"""

from __future__ import annotations

import argparse
import ast
import functools
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import MagicMock

import pytest

import oiio_msspl
from oiio_msspl.aovs.renderers import renderers

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
README, GUIDE = ROOT / "README.md", ROOT / "docs/guide"
PAGES = [
    *sorted(ROOT.glob("*.md")),
    EXAMPLES / "README.md",
    *sorted((ROOT / "research").rglob("*.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
FRAMES = range(1001, 1004)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

#: Beginning of a command -> why it is not run here.
NOT_RUN = {
    "pip": "continuous integration installs the package",
    "python -m pytest": "a test does not run other tests",
    "ruff": "continuous integration runs it",
    "mypy": "continuous integration runs it",
    "lint-imports": "continuous integration runs it",
    "msspl-render": "needs Blender",
    "msspl blender-install": "needs Blender",
    "python blender_addon/build_zip.py": "tests/blender_addon/test_install.py builds it",
    "dask": "runs until it is stopped; tests/jobs/test_dask_cluster.py starts a scheduler and workers",
    "deadline": "needs a farm",
    "python -m research.training": "needs rendered views and hours",
    "python -m research.datagen": "renders for hours",
    "python -m research.benchmarks": "needs rendered scenes and an hour",
}
#: An option and its value -> the same.
NOT_RUN_WITH = {"--scheduler": "needs a running Dask scheduler", "--device cuda": "needs a GPU"}
#: Options that name what is written.
OUTPUTS = ("-o", "--bundle", "--report", "--html")
#: Packages that pages install beside those of pyproject.toml.
OTHER_PACKAGES = {
    "onnxruntime-gpu": "takes the place of onnxruntime",
    "bpy": "research.datagen.cycles, in an environment of its own",
    "pillow": "research.datagen.cycles, in an environment of its own",
}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """Command lines, without comments; ``a && b`` is two."""
        text = re.sub(r"(^|\s)#.*", "", self.text.replace("\\\n", " "), flags=re.MULTILINE)
        return [line.strip() for line in re.split(r"\n|&&", text) if line.strip()]


@functools.cache
def blocks(language: str) -> list[Block]:
    return [
        Block(page, text.count("\n", 0, match.start()) + 1, match[1])
        for page, text in ((page, page.read_text(encoding="utf-8")) for page in PAGES)
        for match in re.finditer(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    ]


def why_not_run(command: str) -> str | None:
    for start, why in NOT_RUN.items():
        if f"{command} ".startswith((f"{start} ", f"{start}.") if start[-1] != "/" else start):
            return why
    return next((why for option, why in NOT_RUN_WITH.items() if option in command), None)


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "HOME": str(folder), "COLUMNS": "120"}
    return subprocess.run(shlex.split(command), cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The files that pages name: a pair, its reference, a shot in folders and by patterns, and files shown on pages."""
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    (tmp_path / "docs").mkdir()
    (tmp_path / "demo").mkdir()  # what a page renders
    for name, kind in {"fused": "hr", "fused_hr": "hr", "fused_lr": "lr", "clean_hr": "hr"}.items():
        shutil.copy(EXAMPLES / f"{kind}.exr", tmp_path / f"demo/{name}.exr")
    for name in ("lr", "hr"):
        source = EXAMPLES / f"{name}.exr"
        shutil.copy(source, tmp_path)
        (tmp_path / name).mkdir()
        for frame in FRAMES:
            shutil.copy(source, tmp_path / name / f"{name}.{frame}.exr")
            shutil.copy(source, tmp_path / f"{name}.{frame}.exr")
    shutil.copy(EXAMPLES / "hr.exr", tmp_path / "ref.exr")  # any frame of that size
    for block in blocks("toml"):
        name = re.match(r"# (\S+\.toml)\n", block.text)
        assert name is not None, f"{block}: begins with its file's name"
        (tmp_path / name[1]).write_text(block.text, encoding="utf-8")
    return tmp_path


RUNNABLE = [block for block in blocks("sh") if any(why_not_run(command) is None for command in block.commands)]
OTHERS = [
    (block, command, why) for block in blocks("sh") for command in block.commands if (why := why_not_run(command))
]


@pytest.mark.parametrize("block", RUNNABLE, ids=str)
def test_commands_run_and_write_what_they_name(block: Block, folder: Path) -> None:
    """Every command of a block succeeds, in order; the files that its options name are new afterwards."""
    for command in block.commands:
        if why_not_run(command):
            continue
        words = shlex.split(command)
        before = {path for path in folder.rglob("*") if path.is_file()}
        done = run(command, folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        new = {path for path in folder.rglob("*") if path.is_file()} - before
        for option in OUTPUTS:
            if option not in words or (option == "-o" and "--bundle" in words):  # a job's tasks write its output
                continue
            output = words[words.index(option) + 1]
            pattern = re.sub(r"#+", "*", output) + ("*" if output.endswith("/") else "")
            assert new & set(folder.glob(pattern)), f"{command}: wrote no {output}"


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")  # a module that others import, too
@pytest.mark.parametrize(
    ("block", "command", "why"), OTHERS, ids=[f"{block} {command} ({why})" for block, command, why in OTHERS]
)
def test_commands_that_are_not_run_are_accepted(
    block: Block, command: str, why: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What can't be run here is at least a command that the program accepts."""
    words = shlex.split(command)
    if words[0] == "pip":
        check_pip(words)
    elif words[:3] == ["python", "-m", "pytest"]:
        assert all((ROOT / word).exists() for word in words[3:] if word.startswith("tests"))
    elif words[:2] == ["python", "-m"]:
        check_arguments(words[2], words[3:], monkeypatch)
    elif words[0] == "python" and words[1].endswith("build_zip.py"):
        assert (ROOT / words[1]).is_file()
    elif words[0] == "deadline":
        assert any(f"--bundle {words[-1]}" in line for line in block.commands), f"no command above writes {words[-1]}"
    else:  # the options are checked before the help is printed
        done = run(f"{command} --help", folder)
        assert done.returncode == 0, f"{command} --help\n{done.stdout}\n{done.stderr}"
        assert "usage" in done.stdout.lower()


def check_pip(words: list[str]) -> None:
    """``pip install`` names this folder, extras of pyproject.toml, or packages that are known here."""
    extras = PROJECT["optional-dependencies"]
    wanted = [*PROJECT["dependencies"], *(line for lines in extras.values() for line in lines)]
    known = {re.split(r"[<>=\[]", line)[0] for line in wanted} | OTHER_PACKAGES.keys() | {"."}
    for word in (word for word in words[2:] if not word.startswith("-")):
        name, _, chosen = word.rstrip("]").partition("[")
        assert re.split(r"[<>=]", name)[0] in known, f"{word}: neither this folder nor a known package"
        assert set(filter(None, chosen.split(","))) <= extras.keys(), f"{word}: no such extra"


class Accepted(Exception):
    """The program's parser took the arguments."""


def check_arguments(program: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The argparse parser of a module takes these arguments. Nothing runs after it."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse_only(*args: object, **kwargs: object) -> None:
        parse_args(*args, **kwargs)  # type: ignore[call-overload]
        raise Accepted

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    monkeypatch.setattr(sys, "argv", [program, *arguments])
    for renderer in ("bpy", "bmesh", "mathutils"):  # imported before the arguments are read
        monkeypatch.setitem(sys.modules, renderer, MagicMock(**{"app.version": (5, 0, 0)}))
    with pytest.raises(Accepted):
        runpy.run_module(program, run_name="__main__", alter_sys=True)


IN_TEXT = [
    (page, command.split(" > ")[0])
    for page in PAGES
    for command in re.findall(r"`(python -m (?!pytest)[^`]+)`", page.read_text(encoding="utf-8").replace("\n", " "))
]


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize(("page", "command"), IN_TEXT, ids=[f"{page.name} {command}" for page, command in IN_TEXT])
def test_commands_in_sentences_and_tables_are_accepted(
    page: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = shlex.split(command)
    if len(words) > 3:
        check_arguments(words[2], words[3:], monkeypatch)
    else:  # the sentence may leave out what the command needs
        assert find_spec(words[2]) is not None


@pytest.mark.parametrize("block", blocks("python"), ids=str)
def test_snippets_run(block: Block, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    exec(compile(block.text, str(block), "exec"), {"__name__": "__main__"})


def without_times(printed: str) -> list[str]:
    """Lines without what differs from machine to machine: seconds."""
    return re.sub(r"\d+\.\d s", "*", printed).splitlines()


def test_the_guide_shows_what_is_printed(folder: Path) -> None:
    """On the page about fusing, the first command is followed by what it prints."""
    page = GUIDE / "fuse.md"
    (shown,) = (block for block in blocks("text") if block.page == page)
    command = next(block for block in blocks("sh") if block.page == page).commands[0]
    assert without_times(run(command, folder).stdout) == without_times(shown.text)


def anchors(page: Path) -> set[str]:
    """What GitHub makes of the headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), f"{target}: no such heading"


@pytest.mark.parametrize("link", ["nothing.md", "shots.md#no-such-heading", "../images/nothing.png"])
def test_the_site_is_not_built_with_a_dead_link(link: str, tmp_path: Path) -> None:
    """The command of `.ci/run` fails."""
    pytest.importorskip("mkdocs")
    (command,) = re.findall(r"^mkdocs .*", (ROOT / ".ci/run").read_text(encoding="utf-8"), re.MULTILINE)
    for name in ("docs", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "mkdocs.yml"):
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, tmp_path / name)
    (tmp_path / "oiio_msspl").symlink_to(ROOT / "oiio_msspl")
    with (tmp_path / "docs/guide/fuse.md").open("a", encoding="utf-8") as page:
        page.write(f"\n[dead]({link})\n")
    done = run(f"python -m {command.replace('$folder', str(tmp_path))}", tmp_path)
    assert done.returncode == 1 and link in done.stderr, done.stderr


def test_the_site_has_every_page() -> None:
    """mkdocs refuses a page that its navigation lacks."""
    listed = re.findall(r"- (?:Home: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert set(listed) == pages | {"index.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"}


def test_every_public_name_is_on_the_page_about_python() -> None:
    page = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    names = [line.rpartition(".") for line in re.findall(r"^::: (\S+)$", page, re.MULTILINE)]
    assert {name for _, _, name in names} == set(oiio_msspl.__all__) - {"__version__"}
    for module, _, name in names:
        assert getattr(import_module(module), name) is getattr(oiio_msspl, name)


def test_every_renderer_of_the_table_is_on_the_page() -> None:
    names = {renderer["name"] for renderer in renderers()} - {"unknown"}
    page = (GUIDE / "render.md").read_text(encoding="utf-8")
    assert names <= set(re.findall(r"^\| ([^|]+?) \|", page, re.MULTILINE))


def texts() -> list[str]:
    """All texts in the code of the programs, with ``...`` for each value that is put into them."""
    sources = [
        path for name in ("oiio_msspl", "cli", "nuke_gizmo", "blender_addon") for path in (ROOT / name).rglob("*.py")
    ]
    nodes = [node for source in sources for node in ast.walk(ast.parse(source.read_text(encoding="utf-8")))]
    formatted = [node for node in nodes if isinstance(node, ast.JoinedStr)]
    plain = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return plain + [
        "".join(str(part.value) if isinstance(part, ast.Constant) else "..." for part in node.values)
        for node in formatted
    ]


def test_the_messages_of_the_troubleshooting_page_are_those_of_the_code() -> None:
    """What stands around ``...`` in a message stands in one text of the code, in this order."""
    page = (GUIDE / "troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert len(messages) > 40
    code = "\0".join(texts())
    parts = {message: [re.escape(part.strip()) for part in message.split("...")] for message in messages}
    missing = [message for message in messages if not re.search("[^\0]*?".join(parts[message]), code)]
    assert not missing, missing


def test_messages_tell_to_install_what_the_project_asks_for() -> None:
    """Whoever installed from this folder can't install extras by the project's name, so messages name the packages."""
    wanted = {line for extra in PROJECT["optional-dependencies"].values() for line in extra}
    wanted |= {line.partition(">=")[0] for line in wanted}
    named = {name for text in texts() for name in re.findall(r"pip install '?([^\s',]+)", text)}
    assert named
    assert named <= {name for name in wanted if not name.startswith(PROJECT["name"])}, named


def test_the_readme_has_two_set_up_commands() -> None:
    """One for the main job, one for the tests."""
    installs = [c for block in blocks("sh") if block.page == README for c in block.commands if c.startswith("pip ")]
    assert installs == ["pip install .", "pip install -e '.[test]'"]
