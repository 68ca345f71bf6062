# SPDX-License-Identifier: Apache-2.0
"""What each layer is worth: accuracy with all layers, and without some of them.

    python -m research.benchmarks.layers Mitsuba=RENDERS Cycles=PASSES --table research/benchmarks/results/layers.csv

:mod:`research.benchmarks.scenes` says what a folder of renders holds. Both renders lack a layer that is left out,
unless the row
says otherwise. Half of the samples are in the HRLS. Layers that a model does not read, or that no render has, are not
measured.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from oiio_msspl import fuse
from oiio_msspl.aovs.features import ALBEDO, DIFFUSE, NORMAL, SPECULAR
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.compare import scores
from oiio_msspl.exr.render import ReadableRender, Render
from oiio_msspl.fusion.neighbours.renders import feature_names
from oiio_msspl.model.catalogue import load_model
from research.benchmarks import results, scenes
from research.benchmarks.results import Row
from research.benchmarks.versus import cell, with_interval

MODELS = ("joint-small-x2", "joint-x2", "joint-large-x2", "joint-x4", "joint-large-x4", "paper-x4")
#: Average spp.
AVERAGES = (2, 4)
#: What is left out -> of the HRLS, and of the LRHS.
WITHOUT = {
    "nothing": ((), ()),
    "albedo": ((ALBEDO,), (ALBEDO,)),
    "normal": ((NORMAL,), (NORMAL,)),
    "albedo and normal": ((ALBEDO, NORMAL), (ALBEDO, NORMAL)),
    "albedo and normal of the LRHS": ((), (ALBEDO, NORMAL)),
    "diffuse and specular": ((DIFFUSE, SPECULAR), ()),
}
KEYS = ("model", "spp", "without")


def less(render: ReadableRender, features: Sequence[str]) -> ReadableRender:
    """A render without some of its features."""
    if isinstance(render, MappedRender):
        return replace(render, features={name: each for name, each in render.features.items() if name not in features})
    assert isinstance(render, Render)
    return replace(render, layers={name: each for name, each in render.layers.items() if name not in features})


def measure(renders: str, scene: scenes.Scene) -> list[Row]:
    """A row for each model, average spp, and what is left out of those layers that the model reads and a render has."""
    rows = []
    for name in MODELS:
        session = load_model(0, name)
        for spp in AVERAGES:
            lr, hr = scene.lrhs(session.contract.scale, spp // 2), scene.hrls(spp // 2)
            high = feature_names(hr) & set(session.contract.hrls)
            low = feature_names(lr) & set(session.contract.lrhs[1:])
            for title, (of_hrls, of_lrhs) in WITHOUT.items():
                if (of_hrls and not high.issuperset(of_hrls)) or (not of_hrls and of_lrhs and not low):
                    continue
                image = fuse(less(lr, of_lrhs), less(hr, of_hrls), session).rgb
                found = scores(image, scene.reference)
                key = {"renders": renders, "scene": scene.name, "model": name, "spp": spp, "without": title}
                rows.append(key | {measure: found[measure] for measure in ("psnr", "relmse")})
    return rows


def by_scene(rows: list[Row], renders: str, key: tuple[object, ...]) -> dict[str, Row]:
    """The rows of scenes with a clean reference, by scene."""
    same = [row for row in rows if row["renders"] == renders and tuple(row[k] for k in KEYS) == key]
    return {row["scene"]: row for row in same if row["scene"] not in scenes.NOISY_REFERENCE}


def layout(rows: list[Row]) -> str:
    """What is lost without each layer: PSNR with its 95 % interval over the scenes, and the ratio of RelMSE."""
    kinds = list(dict.fromkeys(row["renders"] for row in rows))
    body = []
    for key in dict.fromkeys(tuple(row[k] for k in KEYS) for row in rows):
        if key[2] == "nothing":
            continue
        cells = []
        for kind in kinds:
            lacking, whole = (by_scene(rows, kind, (*key[:2], without)) for without in (key[2], "nothing"))
            if not lacking:
                cells += ["", ""]
                continue
            lost = np.array([row["psnr"] - whole[name]["psnr"] for name, row in lacking.items()])
            errors = [np.mean([some[name]["relmse"] for name in lacking]) for some in (lacking, whole)]
            cells += [cell(with_interval(lost), "+.2f"), f"{errors[0] / errors[1]:.2f}"]
        body.append([f"`{key[0]}`", str(key[1]), key[2], *cells])
    head = ["model", "spp", "without"]
    for kind in kinds:
        head += [f"{kind}: PSNR, dB", "RelMSE, ratio"]
    return results.markdown(head, body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", nargs="+", metavar="NAME=FOLDER")
    results.add_option(parser)
    args = parser.parse_args()
    rows: list[Row] = []
    for name, folder in (each.split("=", 1) for each in args.renders):
        for scene in scenes.load(Path(folder)):
            rows += measure(name, scene)
            print(f"{name}, {scene.name}", flush=True)
            if args.table:
                results.write(args.table, rows)
    print(layout(rows))


if __name__ == "__main__":
    main()
