# SPDX-License-Identifier: Apache-2.0
"""The command line: `python -m training.mitsuba_views --out DIR --seeds 0:400`."""

from __future__ import annotations

import sys

from .. import mitsuba_start, views


def main() -> int:
    parser = views.parser("training.mitsuba_views", ref_spp=96)
    parser.add_argument("--variant", default=mitsuba_start.VARIANT)
    parser.add_argument(
        "--filter",
        choices=views.FILTERS,
        default="box",
        help="either render's; blackman-harris: 1 to 3.2 of its own pixels wide",
    )
    args = parser.parse_args()
    mitsuba_start.start(args.threads, args.variant)
    # Imported only now: these modules name Mitsuba's types, which exist once a variant is set.
    from .assets import Assets
    from .render import render_scene

    assets = Assets(args.assets)
    return views.render_all(
        args, lambda seed: render_scene(args.out, seed, assets, args.views, args.ref_spp, args.filter)
    )


if __name__ == "__main__":
    sys.exit(main())
