# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: ``python -m research.datagen.cycles --out VIEWS --seeds 0:400``."""

from __future__ import annotations

import logging
import os
import sys

from research.datagen import command_line, views


def main() -> int:
    parser = command_line.parser("research.datagen.cycles", "Render training views with Blender's Cycles.", ref_spp=32)
    text = "pixel filter of both renders; without it, the LRHS has a box filter and every fourth HRLS a wider one"
    parser.add_argument("--filter", choices=views.FILTERS, help=text)
    args = parser.parse_args()
    from .render import render_scene

    # Blender prints a line for every file that it saves or imports. Python keeps the terminal, Blender gets /dev/null.
    logging.disable(logging.INFO)
    sys.stdout = os.fdopen(os.dup(1), "w")
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)

    return command_line.render_all(
        args, lambda seed: render_scene(args.out, seed, args.views, args.ref_spp, args.threads, args.filter)
    )


if __name__ == "__main__":
    sys.exit(main())
