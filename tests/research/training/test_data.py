# SPDX-License-Identifier: Apache-2.0
"""Pairs are turned as a whole, and a run's log keeps its columns."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from research.benchmarks import results  # noqa: E402
from research.training.data import turned  # noqa: E402
from research.training.train import write_row  # noqa: E402


def test_normals_are_mirrored_with_their_picture() -> None:
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    flat = torch.ones_like(x)
    hrls = torch.stack([x, y, flat, flat, flat, flat, 0.5 * flat, 0.25 * flat, flat])[None]
    seen = set()
    for seed in range(20):
        pair = turned({"hrls": hrls, "target": hrls[:, :3]}, np.random.default_rng(seed))
        torch.testing.assert_close(pair["hrls"][:, :3], pair["target"])
        across, down = (pair["target"][0, :2].diff(dim=axis)[:, 0, 0] for axis in (2, 1))
        mirrored = bool(across[0] * down[1] - across[1] * down[0] < 0)
        seen.add(mirrored)
        assert pair["hrls"][0, 6, 0, 0] == (-0.5 if mirrored else 0.5)
        assert (pair["hrls"][:, 7:] == hrls[:, 7:]).all()
    assert seen == {True, False}


def test_a_log_gets_the_columns_that_come_later(tmp_path: Path) -> None:
    for row in ({"step": 1, "loss": 0.5}, {"step": 2, "loss": 0.25, "psnr": 30.0}, {"step": 3, "loss": 0.125}):
        write_row(tmp_path / "log.csv", row)
    rows = results.read(tmp_path / "log.csv")
    assert [row["step"] for row in rows] == [1, 2, 3]
    assert [row.get("psnr") for row in rows] == [None, 30, None]
