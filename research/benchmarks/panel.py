# SPDX-License-Identifier: Apache-2.0
"""Puts pictures side by side, with an enlarged detail of each below, into a PNG.

    python -m research.benchmarks.panel docs/images/example.png examples/lr.exr examples/hr.exr fused.exr ref.exr \\
        --detail 0.2,0.35,0.25

Smaller pictures are enlarged without interpolation. `--detail` takes the left edge, the top edge and the width of the
detail, as shares of the picture. Before such a picture is committed, `pngquant` reduces it to below 300 KB.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from oiio_msspl.aovs.matching import map_render
from oiio_msspl.exr.preview import write_png
from oiio_msspl.exr.reader import open_exr
from oiio_msspl.image.arrays import repair
from oiio_msspl.image.colour import srgb


def display(path: Path) -> np.ndarray:
    """The beauty of an EXR file in sRGB, (h, w, 3)."""
    file = map_render(open_exr(path))
    return srgb(repair(file.read(file.data_window, ["rgb"])["rgb"])[0])


def enlarged(image: np.ndarray, height: int) -> np.ndarray:
    """Repeat pixels until the picture has about this height, or exactly this height if it is a whole factor larger."""
    factor = max(1, round(height / image.shape[0]))
    return image.repeat(factor, 0).repeat(factor, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("images", nargs="+", type=Path)
    parser.add_argument("--detail", default="0.2,0.3,0.25")
    args = parser.parse_args()
    left, top, width = (float(v) for v in args.detail.split(","))
    pictures = [display(path) for path in args.images]
    height = max(p.shape[0] for p in pictures)
    pictures = [enlarged(p, height) for p in pictures]
    columns = pictures[0].shape[1]
    x, y = round(left * columns), round(top * height)
    zoom = round(1 / width)
    details = [p[y : y + height // zoom, x : x + columns // zoom].repeat(zoom, 0).repeat(zoom, 1) for p in pictures]
    rows = [np.concatenate(row, axis=1) for row in (pictures, details)]
    shortest = min(row.shape[1] for row in rows)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    write_png(args.output, np.concatenate([row[:, :shortest] for row in rows], axis=0))


if __name__ == "__main__":
    main()
