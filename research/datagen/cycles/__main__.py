# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: ``python -m research.datagen.cycles --out VIEWS --seeds 1:262:20 --views 1``."""

from __future__ import annotations

import logging
import os
import sys

from research.datagen import command_line, views


def main() -> int:
    parser = command_line.parser("research.datagen.cycles", "Render test views with Blender's Cycles.", ref_spp=32)
    args = parser.parse_args()
    if any(views.split_of(seed) != "test" for seed in args.seeds):
        parser.error("--seeds: Cycles renders test scenes, whose seeds are 1, 21, 41 and so on, such as 1:262:20")
    from .render import render_scene

    # Blender prints a line for every file that it saves or imports. Python keeps the terminal, Blender gets /dev/null.
    logging.disable(logging.INFO)
    sys.stdout = os.fdopen(os.dup(1), "w")
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)

    return command_line.render_all(
        args, lambda seed: render_scene(args.out, seed, args.views, args.ref_spp, args.threads)
    )


if __name__ == "__main__":
    sys.exit(main())
