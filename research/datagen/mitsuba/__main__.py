# SPDX-License-Identifier: Apache-2.0
"""The command line: ``python -m research.datagen.mitsuba --out VIEWS --seeds 0:400``."""

from __future__ import annotations

import sys
from pathlib import Path

from research.datagen import command_line

from . import VARIANT, start


def main() -> int:
    parser = command_line.parser("research.datagen.mitsuba", "Render training views with Mitsuba 3.", ref_spp=96)
    parser.add_argument("--assets", type=Path, help=command_line.ASSETS)
    parser.add_argument("--variant", default=VARIANT, help="of Mitsuba (default: %(default)s)")
    args = parser.parse_args()
    start(args.threads, args.variant)
    # These modules name Mitsuba's types, which exist only after a variant is set.
    from .assets import Assets
    from .render import render_scene

    assets = Assets(args.assets)
    return command_line.render_all(args, lambda seed: render_scene(args.out, seed, assets, args.views, args.ref_spp))


if __name__ == "__main__":
    sys.exit(main())
