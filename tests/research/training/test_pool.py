# SPDX-License-Identifier: Apache-2.0
"""Pairs that are drawn ahead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training is an extra")

from research.datagen.samples import SIZE, encode  # noqa: E402
from research.datagen.views import NO_REFERENCE, REF_CELLS, Folder  # noqa: E402
from research.training import CHECKPOINTS, checkpoints  # noqa: E402
from research.training.data import SampleTensors, Sampling  # noqa: E402
from research.training.encoding import log_encode  # noqa: E402
from research.training.joint import JointFusion  # noqa: E402
from research.training.pool import Denoisers, PooledBatches, Teacher, draw_pairs, fill  # noqa: E402
from research.training.quantise.joint import calibration_pairs  # noqa: E402
from tests.research.training.conftest import write_wall  # noqa: E402

CPU = torch.device("cpu")
Tensor = torch.Tensor


def test_views_are_drawn_whole(sample_folder: Path) -> None:
    """Of the grey wall, all images show the same. The mean of both renders and its noise follow the LRHS."""
    (view,) = Folder(sample_folder).sample_views("train")
    (pair,) = draw_pairs(view, (4,), 1, CPU)
    assert {name: image.shape for name, image in pair.items()} == {
        "lrhs": (7, SIZE // 4, SIZE // 4), "hrls": (9, SIZE, SIZE), "target": (3, SIZE, SIZE),
    }  # fmt: skip
    colours = pair["target"].mean(dim=(1, 2))
    for image in (pair["hrls"][:3], pair["lrhs"][:3], pair["lrhs"][3:6]):
        torch.testing.assert_close(image.mean(dim=(1, 2)), colours, atol=0.01, rtol=0)
    assert pair["lrhs"][6].max() < 0.01


def test_views_that_come_later_are_drawn_by_the_same_command(sample_folder: Path, tmp_path: Path) -> None:
    """Views that have pairs are not drawn again; those without a reference are only for a teacher."""
    pool = tmp_path / "pool"
    for _ in range(2):
        fill(sample_folder, pool, (8,), 1, Denoisers([], CPU))
        (file,) = pool.iterdir()
        assert file.name == "mitsuba-000003-0.samples.npz.pt"
    written = file.stat().st_mtime_ns
    write_wall(sample_folder, split=NO_REFERENCE)
    fill(sample_folder, pool, (8,), 1, Denoisers([], CPU))
    assert [path.stat().st_mtime_ns for path in pool.iterdir()] == [written]


def test_parts_of_both_renders_may_have_all_samples(sample_folder: Path) -> None:
    """One sample of noise of variance 1 a pixel, and in some cells of 8 x 8 HRLS pixels the mean of all."""
    (view,) = Folder(sample_folder).sample_views("train")
    tensors, rng = SampleTensors(view, CPU), np.random.default_rng(1)
    for name in ("color", "lr_color"):
        noise = rng.exponential(1.0, (*tensors.arrays[name].shape, 3)).astype(np.float32)
        tensors.arrays[name] = torch.from_numpy(encode(noise).view(np.int32))
    sampling = Sampling(hrls_spp=(1.0,), lrhs_passes=(1.0,), spread_noise=False, uneven=1.0)
    whole = (slice(0, SIZE), slice(0, SIZE))
    for seed in range(4):
        drawn = tensors.draw(4, whole, torch.eye(3), sampling, np.random.default_rng(seed))
        assert drawn.variance is None
        cells = []
        for image, side in ((drawn.features["rgb"], 8), (drawn.lrhs, 2)):
            blocks = image.unfold(0, side, side).unfold(1, side, side)
            cells.append(blocks.sub(1.0).square().mean(dim=(2, 3, 4)))
        fine = cells[0] < 0.5
        assert 0 < fine.sum() < fine.numel()
        for variance in cells:
            assert variance[fine].mean() < 0.5 * variance[~fine].mean()


def test_a_reference_with_noise_is_the_mean_of_itself_and_of_a_denoised_one(tmp_path: Path) -> None:
    """Half of the noise is left. Brightness stays."""
    pytest.importorskip("pyoidn")
    side = SIZE * REF_CELLS
    noise = np.random.default_rng(1).exponential(0.5, (side, side, 3)).astype(np.float32)
    layers = {"albedo": np.full((side, side, 3), 0.6, np.float32), "normal": np.full((side, side, 3), 0.5, np.float32)}
    (view,) = Folder(write_wall(tmp_path, noise, layers)).sample_views("train")
    noisy = SampleTensors(view, CPU).noisy_reference()
    assert noisy is not None
    found = Denoisers([], CPU).reference(*noisy)
    assert float(found.std() / noisy[0].std()) == pytest.approx(0.5, abs=0.02)
    assert float(found.mean() / noisy[0].mean()) == pytest.approx(1.0, abs=0.02)


def test_pairs_for_the_large_size_are_denoised_before(sample_folder: Path) -> None:
    """Every second one has noise that the filter has spread. Batches may have one kind only."""
    pytest.importorskip("pyoidn")
    joints = [checkpoints.load(CHECKPOINTS / name)[0] for name in ("joint.pt", "joint_spread.pt")]
    (view,) = Folder(sample_folder).sample_views("train")
    drawn = draw_pairs(view, (4,), 2, CPU, Denoisers(joints, CPU))
    assert [bool(pair["spread"]) for pair in drawn] == [False, True]
    assert all(
        pair["lrhs"].shape == (6, SIZE // 4, SIZE // 4) and pair["hrls"].shape == (9, SIZE, SIZE) for pair in drawn
    )
    torch.save(drawn, sample_folder / "wall.pt")
    for spread, count in ((None, 2), (True, 1), (False, 1)):
        batches = PooledBatches(sample_folder, (4,), 128, 1, 0, CPU, spread=spread)
        assert len(batches.pairs[4]) == count
    lrhs, hrls = next(batches.loader())["lrhs"], next(batches.loader())["hrls"]
    fused, _ = JointFusion(size="large")(lrhs, hrls)
    assert fused.shape == (1, 3, 128, 128)


def test_a_teacher_needs_no_reference(tmp_path: Path) -> None:
    """Its networks agree on the wall, whatever the view has as a reference."""
    pytest.importorskip("pyoidn")
    cells = SIZE * REF_CELLS
    (view,) = Folder(
        write_wall(tmp_path, np.full((cells, cells, 3), 9.0, np.float32), split=NO_REFERENCE)
    ).sample_views(NO_REFERENCE)
    joints = [checkpoints.load(CHECKPOINTS / name)[0] for name in ("joint.pt", "joint_spread.pt")]
    denoisers = Denoisers(joints, CPU)
    teacher = Teacher(denoisers, [JointFusion(size="large"), JointFusion(size="large", spread=True)])
    for pair in draw_pairs(view, (4,), 2, CPU, denoisers, teacher):
        wall, target = (pair[name].mean(dim=(1, 2)) for name in ("lrhs", "target"))
        torch.testing.assert_close(target, wall[:3], atol=0.01, rtol=0)


def test_a_teacher_averages_radiance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of `joint` once, of the large size twice and, without spread noise, of OIDN's large network once."""
    pytest.importorskip("pyoidn")
    joints = [checkpoints.load(CHECKPOINTS / name)[0] for name in ("joint.pt", "joint_spread.pt")]
    denoisers = Denoisers(joints, CPU)
    teacher = Teacher(denoisers, [JointFusion(size="large"), JointFusion(size="large", spread=True)])

    def grey(radiance: float) -> Tensor:
        return log_encode(torch.full((1, 3, 4, 4), radiance))

    monkeypatch.setattr(JointFusion, "fuse", lambda *_: (grey(1.0), None))
    monkeypatch.setattr(JointFusion, "fuse_prepared", lambda *_: (grey(4.0), None))
    monkeypatch.setattr(Denoisers, "large", lambda *_: grey(7.0))
    unread = torch.zeros(1, 9, 4, 4)
    for spread, mean in ((False, 4.0), (True, 3.0)):
        torch.testing.assert_close(teacher.target(unread, unread, unread, spread), grey(mean))


def test_calibration_needs_no_reference(tmp_path: Path) -> None:
    folder = write_wall(tmp_path, split=NO_REFERENCE)
    ((lrhs, hrls),) = calibration_pairs(folder, [2], None, 1)
    assert lrhs.shape[2:] == (128, 128) and hrls.shape[2:] == (256, 256)


@pytest.mark.parametrize("sizes", [("large",), ("large", "usual")])
def test_a_teacher_has_two_large_networks(sizes: tuple[str, ...]) -> None:
    pytest.importorskip("pyoidn")
    joints = [checkpoints.load(CHECKPOINTS / name)[0] for name in ("joint.pt", "joint_spread.pt")]
    with pytest.raises(SystemExit, match="two networks of the size large"):
        Teacher(Denoisers(joints, CPU), [JointFusion(size=size) for size in sizes])


def test_networks_in_the_wrong_order_are_refused() -> None:
    pytest.importorskip("pyoidn")
    joints = [checkpoints.load(CHECKPOINTS / name)[0] for name in ("joint_spread.pt", "joint.pt")]
    with pytest.raises(SystemExit, match="independent noise, then one for spread noise"):
        Denoisers(joints, CPU)


def test_pairs_that_do_not_tell_their_noise_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="draw pairs with --denoise"):
        PooledBatches(write_pool(tmp_path, 2), (2,), 64, 1, 0, CPU, spread=True)


def write_pool(folder: Path, scale: int) -> Path:
    """A pair whose images are one gradient, with another offset for each channel."""
    place = torch.arange(160 * 160).reshape(1, 160, 160) / 160**2 + torch.arange(3).reshape(3, 1, 1)
    low = torch.nn.functional.avg_pool2d(place, scale)
    pair = {"hrls": place.repeat(3, 1, 1), "lrhs": torch.cat([low, low, low[:1]]), "target": place}
    torch.save([{name: image.half() for name, image in pair.items()}], folder / f"x{scale}.pt")
    return folder


@pytest.mark.parametrize("scale", [2, 8])
def test_crops_of_all_images_show_the_same_place(tmp_path: Path, scale: int) -> None:
    """However they are mirrored and their channels permuted."""
    batches = PooledBatches(write_pool(tmp_path, scale), (scale,), 128, 3, 0, CPU).loader()
    for _, batch in zip(range(6), batches, strict=False):
        assert batch["hrls"].shape == (3, 9, 128, 128) and batch["lrhs"].shape == (3, 7, 128 // scale, 128 // scale)
        for part in batch["hrls"].split(3, dim=1)[:2]:
            torch.testing.assert_close(part, batch["target"], atol=2e-3, rtol=0)
        small = torch.nn.functional.avg_pool2d(batch["target"], scale)
        for part in batch["lrhs"].split(3, dim=1)[:2]:
            torch.testing.assert_close(part, small, atol=2e-3, rtol=0)
