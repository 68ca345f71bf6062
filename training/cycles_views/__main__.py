# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: `python -m training.cycles_views --out DIR --seeds 0:400`."""

from __future__ import annotations

import logging
import os
import sys

from .. import views


def main() -> int:
    args = views.parser("training.cycles_views", ref_spp=32).parse_args()
    from .assets import Assets
    from .render import render_scene

    # Blender reports every file it saves, its importers every step; only our own lines are worth reading.
    logging.disable(logging.INFO)
    sys.stdout = os.fdopen(os.dup(1), "w")
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)

    assets = Assets(args.assets)
    return views.render_all(
        args, lambda seed: render_scene(args.out, seed, assets, args.views, args.ref_spp, args.threads)
    )


if __name__ == "__main__":
    sys.exit(main())
