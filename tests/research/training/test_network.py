# SPDX-License-Identifier: Apache-2.0
"""Network, losses, training data and export. Needs PyTorch, which the runtime library does not."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from oiio_msspl.aovs.features import (  # noqa: E402
    ALBEDO,
    DEFAULTS,
    HRLS_FEATURES,
    NORMAL,
    OPTIONAL_FEATURES,
    RADIANCE_FEATURES,
    RGB,
    VARIANCE,
)
from oiio_msspl.image.colour import srgb  # noqa: E402
from oiio_msspl.image.metrics import relmse  # noqa: E402
from oiio_msspl.model.contract import METADATA_KEY, SCALES, Contract  # noqa: E402
from oiio_msspl.model.encoding import MAX_ALBEDO, decode_radiance, encode_radiance, find_exposure  # noqa: E402
from research.datagen.views import Folder, mean_lrhs, read_hrls  # noqa: E402
from research.training import checkpoints, data, encoding, losses, train  # noqa: E402
from research.training.encoding import log_decode  # noqa: E402
from research.training.paper import RDB, MultiResolutionFusion  # noqa: E402

TINY = {"channels": 16, "growth": 8, "groups": 1, "blocks": 2}
SIZE = 64


def pair(scale: int, height: int = 10, width: int = 14) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return (
        torch.rand(2, 3, height, width, generator=generator),
        torch.rand(2, 16, scale * height, scale * width, generator=generator),
    )


def features_of(stack: np.ndarray) -> dict[str, np.ndarray]:
    """Named layers of an HRLS stack (H, W, 16)."""
    ends = np.cumsum(list(HRLS_FEATURES.values()))[:-1]
    return dict(zip(HRLS_FEATURES, np.split(stack, ends, axis=-1), strict=True))


@pytest.fixture
def views(tmp_path: Path) -> Path:
    """Two views: a gradient with known noise, one unit normal that turns over the image."""
    rng = np.random.default_rng(0)
    x = np.linspace(0.2, 1.0, SIZE)
    colour = np.broadcast_to(x[:, None, None], (SIZE, SIZE, 3))
    angle = np.pi * x
    normal = np.broadcast_to(np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)[None], (SIZE, SIZE, 3))
    clean = np.concatenate([colour, 0.5 * colour, normal, 0.7 * colour, 0.3 * colour], axis=-1)
    for name in ("train", "validation"):
        noise = np.zeros((8, SIZE, SIZE, 15))
        noise[..., :3] = 0.02 * rng.standard_normal((8, SIZE, SIZE, 1))
        np.savez(
            tmp_path / f"{name}.npz",
            hr=(clean + noise).astype(np.float16),
            lr=np.repeat(colour[None], 5, axis=0).astype(np.float16),
            lr_spp=np.array([1, 1, 2, 4, 8]),
            ref=colour.astype(np.float16),
            meta=json.dumps({"split": name, "seed": 1}),
        )
    return tmp_path


# Network


@pytest.mark.parametrize("scale", SCALES)
def test_output_has_the_size_of_the_hrls(scale: int) -> None:
    lrhs, hrls = pair(scale)
    assert MultiResolutionFusion(scale, **TINY)(lrhs, hrls).shape == (2, 3, 10 * scale, 14 * scale)


def test_default_network_is_the_papers() -> None:
    """G = 3 groups of B = 5 blocks of 4 convolutions; D = log2(s) deshuffle and shuffle layers; 64 channels."""
    network = MultiResolutionFusion(8)
    convolutions = [m for m in network.modules() if isinstance(m, torch.nn.Conv2d)]
    assert sum(isinstance(m, RDB) for m in network.modules()) == 15
    assert len(convolutions) == 15 * 4 + 2 + 3 + 1 + 3 + 1
    assert network.fuse.in_channels == 128 and network.fuse.kernel_size == (1, 1)
    assert all(c.kernel_size == (3, 3) for c in convolutions if c is not network.fuse)


def test_rdb_adds_to_its_input() -> None:
    """With its last convolution at zero, an RDB is the identity."""
    block = RDB(channels=16, growth=8, dense=3)
    torch.nn.init.zeros_(block.last.weight)
    torch.nn.init.zeros_(block.last.bias)
    x = torch.randn(1, 16, 5, 5)
    assert torch.equal(block(x), x)


@pytest.mark.parametrize("scale", SCALES)
def test_new_network_upsamples_the_lrhs(scale: int) -> None:
    """Without its random part, a new network is bilinear upsampling (away from the zero-padded border)."""
    network = MultiResolutionFusion(scale, **TINY)
    with torch.no_grad():
        network.h_rec.weight[:, 3:] = 0  # all but the channels that carry the LRHS
        network.fuse.weight[:] = 0
        for block in network.modules():
            if isinstance(block, RDB):
                block.last.weight[:] = 0
    lrhs, hrls = pair(scale)
    fused = network(lrhs, hrls)
    expected = lrhs
    while expected.shape[-1] < fused.shape[-1]:
        expected = torch.nn.functional.interpolate(expected, scale_factor=2, mode="bilinear", align_corners=False)
    inner = (..., slice(2 * scale, -2 * scale), slice(2 * scale, -2 * scale))
    torch.testing.assert_close(fused[inner], expected[inner])


def test_scale_that_is_no_power_of_two_is_refused() -> None:
    with pytest.raises(ValueError, match="got 3"):
        MultiResolutionFusion(3)


# Losses


def test_robust_loss_by_hand() -> None:
    """Errors of 0, 0.1 and 0.9 with beta 0.1 cost 0, 0.5 and 0.9."""
    loss = losses.robust(torch.tensor([1.0, 0.1, -0.9]), torch.tensor([1.0, 0.0, 0.0]))
    assert loss.item() == pytest.approx((0 + 0.5 + 0.9) / 3)


def test_robust_loss_is_bounded_and_so_is_its_gradient() -> None:
    error = torch.logspace(-6, 6, 100).requires_grad_()
    loss = losses.robust(error, torch.zeros(100))
    loss.backward()
    assert loss.item() < 1
    assert error.grad.max() * 100 <= 1 / losses.BETA  # * 100: the mean over elements


def test_display_loss_is_the_error_of_the_picture_and_some_of_highlights() -> None:
    grey = torch.full((1, 3, 8, 8), 0.5)
    white, brighter = torch.full_like(grey, 1.5), torch.full_like(grey, 1.6)
    picture = srgb(decode_radiance(np.array([0.5, 0.6], np.float32), 1.0))
    expected = 10 * float(np.diff(picture)[0]) ** 2 + 0.3 * 0.1
    assert losses.display(grey + 0.1, grey).item() == pytest.approx(expected, rel=1e-3)
    assert losses.display(brighter, white).item() == pytest.approx(0.3 * 0.1, rel=1e-3)


def test_relative_loss_counts_light_in_the_dark() -> None:
    """As RelMSE does, but no pixel for more than four."""
    dark = torch.full((1, 3, 8, 8), 0.02)
    for step, at_most in ((0.02, None), (3.0, 4.0)):
        extra = (losses.relative(dark + step, dark) - losses.display(dark + step, dark)).item()
        expected = relmse(*(log_decode(x)[0].permute(1, 2, 0).numpy() for x in (dark + step, dark)))
        assert extra == pytest.approx(at_most or expected, rel=0.05)


def test_hrls_is_the_mean_of_passes(views: Path) -> None:
    (view,) = Folder(views).split("train")
    everything = slice(0, SIZE)
    passes = read_hrls(view, [2, 5], everything, everything)
    expected = (view.hr[2, ..., :3].astype(np.float32) + view.hr[5, ..., :3]) / 2
    np.testing.assert_array_equal(passes.mean(0)[..., :3], expected)


def drawn(views: Path, scale: int, patch: int, count: int, sampling: data.Sampling, seed: int = 0) -> data.Batch:
    tensors = data.view_tensors(Folder(views), "train", torch.device("cpu"))
    return data.draw(tensors, scale, patch, count, np.random.default_rng(seed), sampling)


def test_variance_is_that_of_the_mean_and_unbiased(views: Path) -> None:
    """n passes with noise of deviation 0.02 have a mean of variance 0.02^2 / n, however small n is."""
    for n in (2, 3):
        only_n = tuple(float(i + 1 == n) for i in range(8))
        sampling = data.Sampling(
            hrls_spp=only_n, drop_each=0, drop_variance=0, drop_all=0, exposure_stops=0, gain_stops=0, grey=0
        )
        batch = drawn(views, 4, SIZE, 4, sampling)
        deviation = decode_radiance(batch["hrls"][:, -1].numpy(), 1.0)
        exposure = decode_radiance(batch["target"].numpy(), 1.0).max()  # the brightest pixel of the views is 1
        assert np.square(deviation / exposure).mean() == pytest.approx(0.02**2 / n, rel=0.03)


def test_sample_shapes_ranges_and_agreement(views: Path) -> None:
    """The parts of a pair show the same pixels: without noise, LRHS and target agree after downsampling."""
    for seed in range(20):
        batch = drawn(views, 4, 32, 3, data.Sampling(), seed)
        assert batch["lrhs"].shape == (3, 3, 8, 8)
        assert batch["hrls"].shape == (3, 16, 32, 32)
        assert batch["target"].shape == (3, 3, 32, 32)
        assert all(part.isfinite().all() for part in batch.values())
        down = torch.nn.functional.avg_pool2d(batch["target"], 4)
        torch.testing.assert_close(down, batch["lrhs"], atol=0.01, rtol=0)


@pytest.mark.parametrize("scale", SCALES)
def test_an_lrhs_with_a_filter_of_its_own_is_read_as_it_was_rendered(views: Path, tmp_path: Path, scale: int) -> None:
    """Passes at 1/s of the resolution are no means of pixels; one scale alone is no view."""
    rendered = {s: np.full((5, SIZE // s, SIZE // s, 3), s / 10, np.float16) for s in SCALES}
    with np.load(views / "train.npz") as stored:
        others = {name: stored[name] for name in stored if name != "lr"}
    wide = tmp_path / "wide"
    wide.mkdir()
    np.savez(wide / "one.npz", **others, lr_x2=rendered[2])
    np.savez(wide / "all.npz", **others, **{f"lr_x{s}": passes for s, passes in rendered.items()})
    (view,) = Folder(wide).split("train")
    np.testing.assert_array_equal(mean_lrhs(view, [0, 3], scale), rendered[scale][0])


def test_absent_layers_have_their_defaults(views: Path) -> None:
    batch = drawn(views, 4, 32, 1, data.Sampling(drop_all=1.0))
    layers = features_of(batch["hrls"][0].permute(1, 2, 0).numpy())
    assert all((layers[name] == DEFAULTS[name]).all() for name in OPTIONAL_FEATURES)
    assert layers[RGB].std() > 0


def test_training_transforms_as_inference_does() -> None:
    """What batches compute in PyTorch is what the library computes in NumPy."""
    rng = np.random.default_rng(0)
    layers = {name: rng.exponential(1.0, (5, 6, n)).astype(np.float32) for name, n in HRLS_FEATURES.items()}
    layers[NORMAL] -= 1
    low = rng.exponential(1.0, (7, 9, 3)).astype(np.float32)
    low[2:4] = 0
    exposure = find_exposure(low)
    packed = features_of(encoding.packed(layers, exposure))
    for name in RADIANCE_FEATURES:
        np.testing.assert_allclose(packed[name], encode_radiance(layers[name], exposure), atol=1e-5)
    deviation = encode_radiance(np.sqrt(layers[VARIANCE]), exposure)
    np.testing.assert_allclose(packed[VARIANCE], deviation, atol=1e-5)
    for name, lowest, highest in ((ALBEDO, 0, MAX_ALBEDO), (NORMAL, -1, 1)):
        np.testing.assert_array_equal(packed[name], layers[name].clip(lowest, highest))
    missing = features_of(encoding.packed({RGB: layers[RGB]}, exposure))
    assert all((missing[name] == value).all() for name, value in DEFAULTS.items())


@pytest.mark.parametrize("determinant", [1, -1])
def test_normals_are_turned_with_the_right_handedness(determinant: int) -> None:
    turned = data.random_orthogonal(np.random.default_rng(0), determinant)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(turned) == pytest.approx(determinant)


def test_normals_keep_their_lengths_and_angles(views: Path) -> None:
    """The normal turns from one column to the next, before and after all augmentation, by the same angle."""
    keep = data.Sampling(drop_each=0, drop_lobes=0, drop_all=0)
    step = np.cos(np.pi * 0.8 / (SIZE - 1))
    for seed in range(8):
        hrls = drawn(views, 2, 32, 1, keep, seed)["hrls"][0].permute(1, 2, 0).numpy()
        normal = features_of(hrls)[NORMAL]
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=2e-3)
        along, across = np.sum(normal[:, 1:] * normal[:, :-1], -1), np.sum(normal[1:] * normal[:-1], -1)
        np.testing.assert_allclose(sorted([along.mean(), across.mean()]), [step, 1], atol=2e-3)


def test_broken_views_are_left_out(views: Path) -> None:
    (views / "late.npz").write_bytes((views / "train.npz").read_bytes()[:1000])
    assert len(Folder(views).split("train")) == 1


# Training and export


@pytest.fixture
def tiny_network() -> MultiResolutionFusion:
    torch.manual_seed(0)
    return MultiResolutionFusion(4, **TINY).eval()


def test_run_ends_on_sigterm_and_continues(views: Path, tmp_path: Path) -> None:
    """SIGTERM leaves a checkpoint, and the same command goes on from it."""
    root = Path(__file__).parents[3]
    command = [
        sys.executable, "-m", "research.training.train", "--scale", "2", "--data", str(views),
        "--out", str(tmp_path / "run"),
        "--minutes", "5", "--batch", "1", "--patch", "16", "--val-patch", "16", "--checkpoint-seconds", "0.5",
    ]  # fmt: skip
    for _ in range(2):
        with subprocess.Popen(command, cwd=root, stderr=subprocess.PIPE, text=True) as process:
            lines = []
            for line in process.stderr:
                lines.append(line)
                if sum(" step " in text for text in lines) == 2:
                    process.send_signal(signal.SIGTERM)
            assert process.wait() == 0, "".join(lines)
    assert any("continues at step" in line for line in lines)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["step"] > 0 and state["training_spp"] == {"2": {"hrls": [1, 8], "lrhs": [4, 64]}}


def test_the_loader_draws_what_the_data_set_does(views: Path) -> None:
    """In its own process, from the same seed; and that process ends with the iterator."""
    pairs = data.Batches(views, (2,), 16, 1)
    loaded = iter(pairs.loader())
    for _, expected, batch in zip(range(6), pairs, loaded, strict=False):
        assert batch["lrhs"].shape == (1, 3, 8, 8)
        for name, values in expected.items():
            torch.testing.assert_close(batch[name], values, rtol=0, atol=0)
    (worker,) = loaded._workers
    del loaded
    worker.join(timeout=30)
    assert not worker.is_alive()


def test_the_schedule_follows_the_clock() -> None:
    """Warm-up from 0, the peak, the end of the cosine; a group's share scales it."""
    run = Mock(spec_set=["optimizer", "args", "elapsed"], elapsed=0.0)
    run.args.lr, run.args.minutes, run.args.final_lr = 1e-3, 1, 0.2
    run.optimizer = torch.optim.SGD([{"params": [torch.zeros(1)], "share": 0.5}], lr=1.0)
    schedule = train.Run.new_schedule(run)
    for elapsed, share in ((0.0, 1e-3), (0.9, 0.5), (1.8, 1.0), (60.0, 0.2)):
        run.elapsed = elapsed
        run.optimizer.step()
        schedule.step()
        assert run.optimizer.param_groups[0]["lr"] == pytest.approx(share * 0.5e-3)


def test_the_moving_average_starts_with_a_short_memory() -> None:
    """It follows the weights quickly at first; the decay then grows to EMA_DECAY."""
    network = MultiResolutionFusion(4, **TINY)
    average = train.averaged(network)
    expected = network.fuse.bias.detach().clone()
    for step in range(1, 4):
        network.fuse.bias.data += 1
        average.update_parameters(network)
        decay = (1 + step) / (10 + step)
        expected = decay * expected + (1 - decay) * network.fuse.bias.detach()
        torch.testing.assert_close(average.module.fuse.bias, expected)


def test_larger_scale_starts_as_the_smaller_one(tiny_network: MultiResolutionFusion, tmp_path: Path) -> None:
    """Warm-started with a x4 network, a x8 one answers alike to images without detail (away from the border)."""
    torch.save({"ema": tiny_network.state_dict()}, tmp_path / "x4.pt")
    larger = MultiResolutionFusion(8, **TINY)
    checkpoints.warm_start(larger, tmp_path / "x4.pt")
    colour, layers = torch.rand(1, 3, 1, 1), torch.rand(1, 16, 1, 1)
    middles = [
        network(colour.expand(1, 3, 40, 40), layers.expand(1, 16, 40 * network.scale, 40 * network.scale))[
            ..., 20 * network.scale, 20 * network.scale
        ]
        for network in (tiny_network, larger)
    ]
    torch.testing.assert_close(*middles)


@pytest.mark.parametrize("half", [False, True])
def test_onnx_file_agrees_with_the_network(tiny_network: MultiResolutionFusion, tmp_path: Path, half: bool) -> None:
    """One operator for each of the network's, the same numbers, and the contract comes back as it went in."""
    pytest.importorskip("onnxscript")
    onnx = pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    from research.training import export
    from research.training.whole_model import whole_model

    path = tmp_path / "tiny.onnx"
    contract = Contract(name="tiny-x4", scale=4, overlap=12, training_spp={"hrls": [1, 8], "lrhs": [16, 256]})
    network = export.to_onnx(tiny_network, contract, half=half)
    onnx.save(whole_model(network, contract, None), path)

    assert export.parity(tiny_network, path) < (5e-3 if half else 1e-5)
    kinds = {node.op_type for node in network.graph.node}
    assert kinds - {"Cast"} == {"Conv", "Relu", "Concat", "Add", "SpaceToDepth", "DepthToSpace"}
    assert str(Path(__file__).parents[3]).encode() not in path.read_bytes()
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    assert Contract.from_json(metadata[METADATA_KEY], str(path)) == contract


def test_a_predicted_error_is_that_of_the_output_in_the_mean() -> None:
    """The loss of the prediction is least at the mean error."""
    output, reference = torch.rand(1, 3, 8, 8), torch.rand(1, 3, 8, 8)
    mean = (output - reference).abs().mean().log().expand(1, 1, 8, 8)
    least = losses.error_likelihood(mean, output, reference)
    assert least < min(losses.error_likelihood(mean + change, output, reference) for change in (-0.1, 0.1))


def test_the_mean_of_checkpoints_is_one(tmp_path: Path) -> None:
    from research.training import average

    def state(value: float) -> dict:
        network = MultiResolutionFusion(4, **TINY)
        weights = {name: torch.full_like(tensor, value) for name, tensor in network.state_dict().items()}
        return {"ema": weights, "network": weights, "optimizer": {}, "step": 5, "provenance": {"steps": value}} | {
            "architecture": "paper", "config": network.config
        }  # fmt: skip

    both = average.mean([state(1.0), state(2.0)])
    assert both["provenance"] == {"steps": 2.0, "mean_of": [{"share": 0.5, "steps": 1.0}, {"share": 0.5, "steps": 2.0}]}
    assert "network" not in both and "optimizer" not in both
    torch.save(both, tmp_path / "mean.pt")
    network, _ = checkpoints.load(tmp_path / "mean.pt")
    assert all((parameter == 1.5).all() for parameter in network.parameters())
    unequal = average.mean([state(1.0), state(2.0)], shares=(0.75, 0.25))
    assert all((weights == 1.25).all() for weights in unequal["ema"].values())
    for shares in ((1.0,), (0.5, 0.4)):
        with pytest.raises(SystemExit, match="with a sum of 1"):
            average.mean([state(1.0), state(2.0)], shares=shares)
    with pytest.raises(SystemExit, match="different networks"):
        average.mean([state(1.0), state(1.0) | {"architecture": "joint"}])
