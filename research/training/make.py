# SPDX-License-Identifier: Apache-2.0
"""Retrain a model: run the steps of its recipe that are not done yet.

    python -m research.training.make joint-large --work WORK --assets ASSETS --rooms ROOMS --device cuda --processes 14
    python -m research.training.make joint-large --dry-run

``recipes.toml`` holds the recipes. A step is done when its files exist and WORK/done holds its command. So the same
command goes on after a run was killed, and a step whose recipe was changed is run again. The models lie in WORK/models.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from research.training import CHECKPOINTS

RECIPES = Path(__file__).with_name("recipes.toml")
ROOT = Path(__file__).parents[2]
#: Mitsuba's variant by device.
VARIANTS = {"cpu": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
#: Entries of a step that are no options of its program.
PROGRAM, WRITES, FILES = "program", "writes", "files"


@dataclass(frozen=True)
class Step:
    """A program of a recipe with its arguments."""

    name: str
    module: str
    arguments: list[str]
    writes: list[Path]
    """Files or folders that exist when the step is done, relative to the work's folder."""

    @property
    def command(self) -> str:
        """The command line, as a shell takes it."""
        return shlex.join(["python", "-m", self.module, *self.arguments])

    def processes(self, count: int) -> list[list[str]]:
        """Return the arguments of each process: renderers share their seeds among ``count`` processes."""
        if "--seeds" not in self.arguments:
            return [self.arguments]
        place = self.arguments.index("--seeds") + 1
        first, last, *rest = map(int, self.arguments[place].split(":"))
        step = rest[0] if rest else 1
        seeds = [f"{first + i * step}:{last}:{step * count}" for i in range(min(count, len(range(first, last, step))))]
        return [[*self.arguments[:place], text, *self.arguments[place + 1 :]] for text in seeds]


# The plan


def read_recipes(path: Path = RECIPES) -> dict[str, Any]:
    """Read the programs and recipes of a file."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def plan(recipes: Mapping[str, Any], name: str, settings: Mapping[str, str]) -> list[Step]:
    """Return the steps of a recipe in their order, those of the recipes that it includes first and each once.

    Args:
        recipes: see :func:`read_recipes`.
        settings: the value of each placeholder.
    """
    steps: dict[str, Step] = {}
    for included in recipes[name].get("include", ()):
        steps |= {step.name: step for step in plan(recipes, included, settings)}
    for key, entries in recipes[name].items():
        if key != "include":
            steps[key] = _step(key, recipes["programs"][entries[PROGRAM]] | entries, settings)
    return list(steps.values())


def _step(name: str, entries: Mapping[str, Any], settings: Mapping[str, str]) -> Step:
    options = {key: value for key, value in entries.items() if key not in ("module", PROGRAM, WRITES, FILES)}
    arguments = _texts(entries.get(FILES, []), settings)
    for key, value in options.items():
        texts = [] if value is True else _texts(value if isinstance(value, list) else [value], settings)
        if all(texts):  # a placeholder without a value leaves the option out
            arguments += [f"--{key}", *texts]
    return Step(name, entries["module"], arguments, [Path(path) for path in entries.get(WRITES, [])])


def _texts(values: Sequence[Any], settings: Mapping[str, str]) -> list[str]:
    return [str(value).format(**settings) for value in values]


# Running it


def is_done(step: Step, work: Path) -> bool:
    """Return whether a step was finished with its present command."""
    stamp = work / "done" / step.name
    finished = stamp.exists() and stamp.read_text(encoding="utf-8") == step.command
    return finished and all((work / path).exists() for path in step.writes)


def run(step: Step, work: Path, processes: int) -> None:
    """Run a step.

    Raises:
        SystemExit: its program failed, or was stopped before it wrote its files.
    """
    for path in step.writes:
        (work / path).parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    started = [
        subprocess.Popen([sys.executable, "-m", step.module, *arguments], cwd=work, env=environment)
        for arguments in step.processes(processes)
    ]
    codes = [_wait(process) for process in started]
    if any(codes):
        raise SystemExit(f"{step.name}: ended with exit code {next(filter(None, codes))}")
    for path in step.writes:
        if not (work / path).exists():
            raise SystemExit(f"{step.name}: stopped before it wrote {work / path}; run the same command to go on")
    stamp = work / "done" / step.name
    stamp.parent.mkdir(parents=True, exist_ok=True)
    stamp.write_text(step.command, encoding="utf-8")


def _wait(process: subprocess.Popen[bytes]) -> int:
    """Wait for a process. Ctrl-C reaches it, too, and training then writes its last checkpoint."""
    while True:
        try:
            return process.wait()
        except KeyboardInterrupt:
            continue


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", help="such as joint, joint-small, joint-large, their -spread models, paper, mean-x1")
    parser.add_argument("--work", type=Path, default=Path("retrained"), help="folder for all files (%(default)s)")
    parser.add_argument("--assets", type=Path, help="folder with hdri/ and models/ for the renderers")
    parser.add_argument("--rooms", type=Path, help="folder with bathroom2/ and living-room-3/, Mitsuba scenes")
    parser.add_argument("--device", choices=VARIANTS, default="cpu", help="(default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of each program (default: %(default)s)")
    parser.add_argument("--processes", type=int, default=1, help="renderers that run side by side (%(default)s)")
    parser.add_argument("--only", nargs="+", metavar="STEP", help="run these steps alone, also if they are done")
    parser.add_argument("--dry-run", action="store_true", help="print the plan")
    parser.add_argument("--recipes", type=Path, default=RECIPES, help="file of the recipes (default: the project's)")
    args = parser.parse_args(arguments)
    recipes = read_recipes(args.recipes)
    names = sorted(recipes.keys() - {"programs"})
    if args.recipe not in names:
        parser.error(f"{args.recipe}: not one of {', '.join(names)}")
    folders = {name: str(path.absolute()) if (path := getattr(args, name)) else "" for name in ("assets", "rooms")}
    settings = {"device": args.device, "variant": VARIANTS[args.device], "threads": str(args.threads)}
    steps = plan(recipes, args.recipe, folders | settings | {"checkpoints": str(CHECKPOINTS)})
    if unknown := set(args.only or ()) - {step.name for step in steps}:
        parser.error(f"--only {' '.join(sorted(unknown))}: {args.recipe} has {', '.join(step.name for step in steps)}")
    for step in steps:
        skipped = step.name not in args.only if args.only else is_done(step, args.work)
        print(f"{step.name}: {'skipped' if skipped else step.command}", flush=True)
        if not (skipped or args.dry_run):
            run(step, args.work, args.processes)


if __name__ == "__main__":
    main()
