# SPDX-License-Identifier: Apache-2.0
# mypy: ignore-errors
# ruff: noqa: I001 -- modules of that commit, which ruff does not find here
"""The pair checks of commit 0e4f219, with which `research.benchmarks.pair_checks` compares those of today.

It runs with that commit on the Python path: pairs are read from the standard input, warnings go to the standard output.
"""

from __future__ import annotations

import pickle
import sys

import numpy as np

from oiio_msspl import checks, fusion, schema
from oiio_msspl.errors import InputError
from oiio_msspl.pairing import pair
from oiio_msspl.render import Render


def warnings(lrhs: np.ndarray, hrls: dict[str, np.ndarray]) -> list[str]:
    low, high = Render.from_arrays("lr", rgb=lrhs), Render.from_arrays("hr", **hrls)
    try:
        pairing = pair(low, high)
        frame = fusion._read_low(low, pairing, pairing.grid, {}, [schema.RGB])[schema.RGB]
        return checks.check(frame, high, pairing, low.name)
    except InputError as error:
        return [str(error)]


if __name__ == "__main__":
    while True:
        try:
            arrays = pickle.load(sys.stdin.buffer)
        except EOFError:
            break
        pickle.dump(warnings(*arrays), sys.stdout.buffer)
        sys.stdout.buffer.flush()
