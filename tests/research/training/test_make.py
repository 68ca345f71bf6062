# SPDX-License-Identifier: Apache-2.0
"""Recipes name only what their programs accept, and a plan goes on where it was stopped."""

from __future__ import annotations

import argparse
import json
import runpy
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from oiio_msspl.model.catalogue import WEIGHTS
from oiio_msspl.model.contract import Contract
from research.training import CHECKPOINTS, make

RECIPES = make.read_recipes()
NAMES = sorted(RECIPES.keys() - {"programs"})
SETTINGS = {
    "checkpoints": str(CHECKPOINTS), "assets": "assets", "rooms": "rooms", "device": "cpu",
    "variant": make.VARIANTS["cpu"], "threads": "2",
}  # fmt: skip
EXPORTED = [path.stem for path in WEIGHTS.glob("*.onnx")]


class Accepted(Exception):
    """The program's parser took the arguments."""


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("name", NAMES)
def test_programs_accept_the_arguments_of_a_recipe(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the parsers of the programs themselves."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse_only(*args: object, **kwargs: object) -> None:
        parse_args(*args, **kwargs)  # type: ignore[call-overload]
        raise Accepted

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    for step in make.plan(RECIPES, name, SETTINGS):
        monkeypatch.setattr(sys, "argv", [step.module, *step.arguments])
        with pytest.raises(Accepted):
            runpy.run_module(step.module, run_name="__main__", alter_sys=True)


@pytest.mark.parametrize("name", NAMES)
def test_steps_read_what_earlier_steps_write(name: str) -> None:
    written = {str(path) for recipe in NAMES for step in make.plan(RECIPES, recipe, SETTINGS) for path in step.writes}
    so_far: set[str] = set()
    for step in make.plan(RECIPES, name, SETTINGS):
        so_far |= {str(path) for path in step.writes}
        read = {text for text in step.arguments if text in written}
        assert read <= so_far, f"{step.name} reads {read - so_far}"
        assert not [text for text in step.arguments if text.startswith(str(CHECKPOINTS)) and not Path(text).exists()]


def test_recipes_make_all_models_that_ship() -> None:
    """With the scales, overlaps and names that the files have."""
    made = {}
    for name in NAMES:
        for step in make.plan(RECIPES, name, SETTINGS):
            if step.module.endswith(".export"):
                options = step.arguments
                end = options[options.index("--name") + 1]
                scales = [end] if end[-3:-1] == "-x" else [f"{end}-x{scale}" for scale in (2, 4, 8)]
                start = options.index("--overlap") + 1 if "--overlap" in options else None
                overlaps = [int(text) for text in options[start : start + len(scales)]] if start else [24]
                made |= dict(zip(scales, overlaps, strict=True))
            elif step.module.endswith(".same_size"):  # the LRHS of x2 has half of the size
                at_x2 = Path(step.arguments[0]).stem
                for stem in dict.fromkeys(path.stem for path in step.writes):
                    made[stem] = 2 * made[at_x2] if stem.endswith("-x1") else made[stem.replace("-clean", "")]
            elif step.module.endswith(".mean_model"):
                made |= {path.stem: made[Path(step.arguments[0]).stem] for path in step.writes}
    assert made == {stem: Contract.of_file(WEIGHTS / f"{stem}.onnx").overlap for stem in EXPORTED}


def test_renderers_share_the_seeds() -> None:
    """Each seed is rendered by one process; other programs run once."""
    step = make.Step("render", "module", ["--out", "views", "--seeds", "3:20:4"], [])
    shares = [arguments[-1] for arguments in step.processes(3)]
    seeds = [
        seed for first, last, by in (map(int, text.split(":")) for text in shares) for seed in range(first, last, by)
    ]
    assert sorted(seeds) == list(range(3, 20, 4)) and len(shares) == 3
    assert len(step.processes(100)) == 5
    assert make.Step("train", "module", ["--minutes", "3"], []).processes(3) == [["--minutes", "3"]]


def test_an_option_without_a_value_is_left_out() -> None:
    recipes = {"programs": {"p": {"module": "m", "assets": "{assets}", "half": True}}, "r": {"s": {"program": "p"}}}
    assert make.plan(recipes, "r", SETTINGS | {"assets": ""})[0].arguments == ["--half"]


WRITER = """
import argparse, pathlib
parser = argparse.ArgumentParser()
parser.add_argument("out", type=pathlib.Path)
parser.add_argument("--text")
args = parser.parse_args()
if args.text != "stopped":
    args.out.write_text(args.text)
with open("log", "a") as log:
    log.write(args.text + " ")
"""


def test_a_stopped_plan_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finished steps are skipped, until their recipe changes or they are named; a step that wrote nothing ends it."""
    (tmp_path / "writer.py").write_text(WRITER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    work, recipes = tmp_path / "work", tmp_path / "recipes.toml"

    def run(*second: str, only: tuple[str, ...] = ()) -> str:
        (text,) = second
        recipes.write_text(
            '[programs.write]\nmodule = "writer"\n[both]\n'
            'first = {program = "write", writes = ["a/one"], files = ["a/one"], text = "one"}\n'
            f'second = {{program = "write", writes = ["two"], files = ["two"], text = "{text}"}}\n'
        )
        make.main(["both", "--work", str(work), "--recipes", str(recipes), *(["--only", *only] if only else [])])
        return (work / "log").read_text()

    with pytest.raises(SystemExit, match=r"second: stopped before it wrote .*two"):
        run("stopped")
    assert run("two") == "one stopped two "
    assert run("two") == "one stopped two "
    assert run("other") == "one stopped two other "
    assert run("other", only=("first",)) == "one stopped two other one "
    (work / "a/one").unlink()
    assert run("other") == "one stopped two other one one "
    with pytest.raises(SystemExit):
        make.main(["both", "--work", str(work), "--recipes", str(recipes), "--only", "third"])


def test_a_dry_run_prints_the_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make.main(["joint-large", "--work", str(tmp_path), "--dry-run"])
    printed = capsys.readouterr().out
    assert "large-first: python -m research.training.train" in printed and not list(tmp_path.iterdir())


def test_a_tiny_recipe_makes_a_model(tmp_path: Path) -> None:
    """It trains the paper's network for a second on a view of a few pixels, averages it and exports it."""
    size, rng = 32, np.random.default_rng(0)
    (tmp_path / "views").mkdir()
    np.savez(
        tmp_path / "views/one.npz",
        hr=rng.random((8, size, size, 15)).astype(np.float16), lr=rng.random((5, size, size, 3)).astype(np.float16),
        lr_spp=np.array([1, 1, 2, 4, 8]), ref=rng.random((size, size, 3)).astype(np.float16),
        meta=json.dumps({"split": "train", "seed": 2}),
    )  # fmt: skip
    recipes = tmp_path / "recipes.toml"
    recipes.write_text(
        '[programs.train]\nmodule = "research.training.train"\ndata = "views"\n'
        '[programs.average]\nmodule = "research.training.average"\n'
        '[programs.export]\nmodule = "research.training.export"\n[tiny]\n'
        'run = {program = "train", writes = ["run/final.pt"], out = "run", scale = 2, patch = 8, batch = 1, '
        "minutes = 0.02}\n"
        'mean = {program = "average", writes = ["mean.pt"], files = ["mean.pt", "run/final.pt"]}\n'
        'model = {program = "export", writes = ["models/paper-x2.onnx"], files = ["mean.pt"], name = "paper-x2", '
        'output = "models/paper-x2.onnx", half = true}\n'
    )
    make.main(["tiny", "--work", str(tmp_path), "--recipes", str(recipes)])
    contract = Contract.of_file(tmp_path / "models/paper-x2.onnx")
    assert (contract.name, contract.scale, contract.provenance["views"]) == ("paper-x2", 2, 1)
    assert tomllib.loads(recipes.read_text())["tiny"].keys() == {path.name for path in (tmp_path / "done").iterdir()}
