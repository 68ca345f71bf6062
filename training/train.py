# SPDX-License-Identifier: Apache-2.0
"""Train the network for a given number of minutes.

    python -m training.train --scale 4 --data VIEWS --out RUN --minutes 60
    python -m training.train --scale 2 --data VIEWS --out RUN2 --minutes 20 --init RUN/checkpoint.pt

The learning rate follows the share of the minutes that has passed, not the number of steps: a run ends when it was
meant to, on any machine. The same command continues an interrupted run from its last checkpoint. RUN holds
``checkpoint.pt``, written every few minutes and on SIGTERM, ``best.pt``, the one that was best on the validation views
(as the paper selects its model), and ``log.csv``, a line for each.
"""

from __future__ import annotations

import argparse
import collections
import copy
import csv
import logging
import math
import os
import signal
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from datagen.views import Array, Folder
from oiio_msspl import metrics, transforms
from training import batches, data, losses
from training.joint import JointFusion
from training.mix import MIX_CHANNELS, MixFusion, blend, disagreement
from training.networks import DENOISERS, NETWORKS, Network, preparation, run
from training.paper import HRLS_CHANNELS, MultiResolutionFusion
from training.pyramid import LEVELS, PYRAMID_CHANNELS, PyramidFusion, level_of

log = logging.getLogger(__name__)

#: A step whose gradient is so many times longer than usual is left out: at these learning rates one bad batch can undo
#: a run, though its length is clipped, because Adam divides it by the small gradients before it.
SPIKE = 4.0
#: A run that falls so many dB behind its own best goes back to it, at half the learning rate.
COLLAPSE = 2.0

#: Weight of the disagreement with a teacher: about as much as the loss itself where training begins.
TAUGHT = 0.1

#: Share of the run in which the learning rate rises, and the share of its peak at which it ends.
WARM_UP, FINAL = 0.03, 0.01


@dataclass(frozen=True)
class Recipe:
    """How to optimise."""

    optimizer: type[torch.optim.Optimizer]
    options: dict[str, Any]
    lr: float
    loss: str
    batch: int
    patch: dict[int, int]
    """HR pixels of the training patches, by scale."""
    schedule: bool
    """Warm-up and cosine decay; otherwise the learning rate is constant."""
    clip_gradient: float
    """Largest norm of the gradient."""
    sampling: data.Sampling


RECIPES = {
    # For a CPU and an hour: there, more and smaller steps beat fewer and larger ones.
    "ours": Recipe(
        optimizer=torch.optim.AdamW,
        # Larger than the default: where a softmax is decided and hardly any gradient is left, Adam would still take
        # steps of full length, all in one direction, until the features explode.
        options={"eps": 1e-6},
        lr=4e-4,
        loss="l1",
        batch=4,
        patch={2: 64, 4: 96, 8: 128},
        schedule=True,
        clip_gradient=1.0,
        sampling=data.Sampling(),
    ),
    # As in the paper, whose 500 epochs took a week on a GPU; the input transform alone is ours.
    "paper": Recipe(
        optimizer=torch.optim.SGD,
        options={},
        lr=1e-4,
        loss="robust",
        batch=16,
        patch=data.PAPER_PATCH,
        schedule=False,
        clip_gradient=math.inf,
        sampling=data.PAPER_SAMPLING,
    ),
}


# Evaluation


def bicubic(lrhs: Tensor, scale: int) -> Tensor:
    """Baseline: bicubic upsampling of the linear LRHS (N, 3, h, w)."""
    return F.interpolate(lrhs, scale_factor=scale, mode="bicubic", align_corners=False).clamp(min=0)


@torch.inference_mode()
def evaluate(network: Network, pairs: Iterable[data.Evaluation], device: torch.device) -> dict[str, float]:
    """Mean PSNR and RelMSE of the network and of bicubic upsampling over some pairs.

    Views come at any brightness; they are scored at the exposure at which the network sees them, about that of a photo.
    """
    scores: dict[str, list[float]] = collections.defaultdict(list)
    for pair in pairs:
        fused, _ = run(network, to_tensor(pair.lrhs[None], device), to_tensor(pair.hrls[None], device))
        output = transforms.expand(fused[0].permute(1, 2, 0).cpu().numpy(), pair.exposure)
        scale = pair.hrls.shape[0] // pair.lrhs.shape[0]
        lrhs = transforms.expand(pair.lrhs[None, ..., :3], pair.exposure)
        upsampled = bicubic(to_tensor(lrhs, torch.device("cpu")), scale)[0].permute(1, 2, 0).numpy()
        reference = pair.reference * pair.exposure
        for prefix, image in (("", output), ("bicubic_", upsampled)):
            psnr = metrics.psnr(image * pair.exposure, reference)
            scores[prefix + "psnr"].append(psnr)
            if not prefix:
                scores[f"psnr_x{scale}"].append(psnr)
            scores[prefix + "relmse"].append(metrics.relmse(image * pair.exposure, reference))
    return {name: float(np.mean(values)) for name, values in scores.items()}


# State


def to_tensor(image: Array, device: torch.device) -> Tensor:
    """(N, H, W, C) to (N, C, H, W) in channels-last memory, without copying on the CPU."""
    return torch.from_numpy(np.ascontiguousarray(image)).permute(0, 3, 1, 2).to(device, non_blocking=True)


def save(state: dict[str, Any], path: Path) -> None:
    """Write whole or not at all: a run may be killed at any time."""
    partial = path.with_suffix(".partial")
    torch.save(state, partial)
    os.replace(partial, path)


def warm_start(network: Network, path: Path) -> None:
    """Copy what fits from another run's averaged weights: all scales share the trunk, and their stages by position.

    Stages that the other network lacks begin as plain resampling of their features, so a network of a larger scale
    begins as the other one followed by bilinear upsampling.
    """
    if isinstance(network, MultiResolutionFusion):
        for deshuffle, shuffle in zip(network.deshuffle, network.upscale, strict=True):
            deshuffle.reset_to_average()
            shuffle.reset_to_bilinear(network.config["channels"])
    state = torch.load(path, map_location="cpu", weights_only=True)
    theirs, ours = state["ema"], network.state_dict()
    if isinstance(network, PyramidFusion):
        if "own_size" not in state["config"]:
            raise SystemExit(f"--init {path}: that is no pyramid network, and nothing of it fits one")
        cut_kernels(theirs, state["config"]["own_size"], network.own_size)
    fitting = {name: value for name, value in theirs.items() if name in ours and ours[name].shape == value.shape}
    network.load_state_dict(ours | fitting)
    log.info("took %d of %d tensors from %s", len(fitting), len(ours), path)


def cut_kernels(weights: dict[str, Tensor], sizes: Sequence[int], wanted: Sequence[int]) -> None:
    """Change a pyramid's weights, whose kernels are so many taps across by level, to those of one with fewer."""
    for level, (size, fewer) in enumerate(zip(sizes, wanted, strict=True)):
        for name in (f"heads.{level}.weight", f"heads.{level}.bias"):
            weights[name] = middle_taps(weights[name], size, fewer, 1 if level else 4)


def middle_taps(parameter: Tensor, size: int, wanted: int, phases: int) -> Tensor:
    """A parameter of a pyramid's head, whose first outputs are size x size taps for each phase, with fewer of them."""
    if size < wanted:
        raise SystemExit(f"--kernels: the network to start from has {size}x{size} taps, and no more can be added")
    outputs = parameter.unflatten(0, (-1, phases))
    margin = (size - wanted) // 2
    middle = slice(margin, margin + wanted)
    taps = outputs[: size**2].unflatten(0, (size, size))[middle, middle].flatten(0, 1)
    return torch.cat([taps, outputs[size**2 :]]).flatten(0, 1)


def fused_and_taught(
    network: Network, teacher: MixFusion | None, lrhs: Tensor, hrls: Tensor
) -> tuple[Tensor, Tensor | float]:
    """The fused image, and what is to be lost by deciding otherwise than the teacher, if there is one."""
    if teacher is None:
        return run(network, lrhs, hrls)[0], 0.0
    assert isinstance(network, MixFusion)
    logits, _ = network.decide(lrhs, hrls)
    with torch.no_grad():
        wanted, _ = teacher.decide(lrhs, hrls)
    return blend(lrhs, hrls, hrls[:, HRLS_CHANNELS:], logits), TAUGHT * disagreement(
        logits, wanted, level_of(lrhs, hrls)
    )


class Average:
    """Exponential moving average of a network's weights, in which a short memory grows to a long one."""

    def __init__(self, network: Network, decay: float = 0.999) -> None:
        self.network = copy.deepcopy(network).requires_grad_(False)
        self.decay = decay

    @torch.no_grad()
    def update(self, network: Network, step: int) -> None:
        weight = 1 - min(self.decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(list(self.network.parameters()), list(network.parameters()), weight)


def lr_factor(progress: float) -> float:
    """Linear warm-up, then half a cosine, for a share of the run in [0, 1]."""
    if progress < WARM_UP:
        return max(progress / WARM_UP, 1e-3)
    done = min((progress - WARM_UP) / (1 - WARM_UP), 1.0)
    return FINAL + (1 - FINAL) * 0.5 * (1 + math.cos(math.pi * done))


# The run


def train(args: argparse.Namespace) -> None:
    """Train until the minutes are over or a signal comes; see :func:`parse` for the arguments."""
    recipe = RECIPES[args.preset]
    batch = args.batch or recipe.batch
    scales = tuple(args.scale)
    patch = args.patch or max(recipe.patch[scale] for scale in scales)
    peak_lr = args.lr or recipe.lr
    loss_name = args.loss or recipe.loss
    loss_function = losses.LOSSES[loss_name]
    device = torch.device(args.device if args.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu")
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    args.out.mkdir(parents=True, exist_ok=True)

    # Data
    folder = Folder(args.data)
    if not folder.split("train"):
        raise SystemExit(f"{args.data}: no training views (*.npz with split 'train'); render some first")
    validation: dict[tuple[Path, int], data.Evaluation] = {}

    # Network, from the last checkpoint, from another run, or new
    network: Network
    prepare = preparation(args.network, args.threads)
    if args.network == "pyramid":
        network = PyramidFusion(args.channels or PYRAMID_CHANNELS, args.kernels)
    elif args.network == "mix":
        network = MixFusion(args.channels or MIX_CHANNELS, args.stem)
    elif args.network == "joint":
        begun = args.out / "checkpoint.pt"
        earlier = begun if begun.exists() else args.init
        kept = torch.load(earlier, map_location="cpu", weights_only=True)["config"].get("kept") if earlier else None
        network = JointFusion(kept)
    elif len(scales) == 1:
        network = MultiResolutionFusion(scales[0])
    else:
        raise SystemExit("--network paper: a network is for one --scale")
    teacher = None
    if args.teacher:
        taught = torch.load(args.teacher, map_location="cpu", weights_only=True)
        if args.network != "mix" or taught["architecture"] != "mix":
            raise SystemExit("--teacher: for networks that mix, and one of them")
        teacher = MixFusion(**taught["config"])
        teacher.load_state_dict(taught["ema"])
        teacher.to(device, memory_format=torch.channels_last).requires_grad_(False)
    checkpoint_path, best_path = args.out / "checkpoint.pt", args.out / "best.pt"
    state = torch.load(checkpoint_path, map_location="cpu", weights_only=True) if checkpoint_path.exists() else None
    if state is None and args.init:
        warm_start(network, args.init)
    network.to(device, memory_format=torch.channels_last)
    average = Average(network)
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name.startswith(args.only))
    learning = [parameter for parameter in network.parameters() if parameter.requires_grad]
    if not learning:
        raise SystemExit(f"--only {args.only}: the network has no such part")
    # Given weights, which took weeks to learn, go in smaller steps than new ones
    retrained = {id(p) for p in network.retrained()} if isinstance(network, JointFusion) else set()
    groups = [
        {"params": params, "share": share}
        for params, share in (
            ([p for p in learning if id(p) not in retrained], 1.0),
            ([p for p in learning if id(p) in retrained], args.retrain),
        )
        if params
    ]
    optimizer = recipe.optimizer(groups, lr=peak_lr, **recipe.options)
    step, elapsed, best_gain = 0, 0.0, -math.inf

    def restore(state: dict[str, Any]) -> None:
        network.load_state_dict(state["network"])
        average.network.load_state_dict(state["ema"])
        optimizer.load_state_dict(state["optimizer"])

    if state is not None:
        restore(state)
        step, elapsed, best_gain = state["step"], state["seconds"], state.get("best_gain", -math.inf)
        log.info("continues at step %d, minute %.1f", step, elapsed / 60)
    source = batches.Batches(folder, scales, patch, batch, recipe.sampling, args.seed + step, device, prepare)

    stop = False

    def on_signal(*_: object) -> None:
        nonlocal stop
        stop = True

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)

    budget = args.minutes * 60
    started = time.monotonic() - elapsed
    since = {"time": time.monotonic(), "steps": 0, "skipped": 0, "loss": 0.0, "waited": 0.0}

    def checkpoint() -> None:
        """Evaluate, log a line and write the state; step back if training has collapsed."""
        nonlocal best_gain, peak_lr
        interval = max(time.monotonic() - since["time"], 1e-9)
        if not validation:  # a set that grew would make scores of different times incomparable
            for view in folder.split("validation")[: args.val_views]:
                for scale in scales:
                    validation[view.path, scale] = data.Evaluation.centre(view, scale, args.val_patch, prepare)
        scores = evaluate(average.network, validation.values(), device)
        row = {
            "step": step,
            "minutes": elapsed / 60,
            "loss": since["loss"] / max(since["steps"], 1),
            "lr": optimizer.param_groups[0]["lr"],
            "skipped_steps": since["skipped"],
            "samples_per_s": since["steps"] * batch / interval,
            "wait_share": (source.waited - since["waited"]) / interval,
            "train_views": len(folder.split("train")),
            "val_pairs": len(validation),
            **scores,
        }
        write_row(args.out / "log.csv", row)
        log.info("%s", "  ".join(f"{k} {v:.4g}" for k, v in row.items()))
        views = folder.split("train")
        gain = scores["psnr"] - scores["bicubic_psnr"] if scores else math.nan
        state = {
            "network": network.state_dict(),
            "ema": average.network.state_dict(),
            "optimizer": optimizer.state_dict(),
            "architecture": args.network,
            "config": network.config,
            "denoiser": DENOISERS.get(args.network, ""),
            "step": step,
            "seconds": elapsed,
            "best_gain": best_gain,
            "training_spp": {str(scale): data.spp_range(views[0], recipe.sampling, scale) for scale in scales},
            "provenance": {
                "steps": step,
                "minutes": round(elapsed / 60, 1),
                "batch": batch,
                "patch": patch,
                "loss": loss_name,
                "preset": args.preset,
                "seed": args.seed,
                "views": len(views),
                "scenes": len({view.scene for view in views}),
                "sources": sorted({view.source for view in views}),
                "torch": str(torch.__version__),
                "validation": {"pairs": len(validation), "hrls_spp": 1} | scores,
            },
        }
        if gain < best_gain - COLLAPSE:
            peak_lr /= 2
            restore(torch.load(best_path, map_location="cpu", weights_only=True))
            log.warning("collapsed to %+.1f dB, back to %+.1f dB, peak learning rate %.2g", gain, best_gain, peak_lr)
        else:
            if not gain <= best_gain:  # without validation views the newest is the best
                best_gain = state["best_gain"] = gain
                save(state, best_path)
            save(state, checkpoint_path)
        since.update(time=time.monotonic(), steps=0, skipped=0, loss=0.0, waited=source.waited)

    checkpoint()
    next_checkpoint = elapsed + args.checkpoint_seconds
    usual = math.inf
    while not stop and elapsed < budget:
        # One step
        step += 1
        for group in optimizer.param_groups:
            group["lr"] = peak_lr * group["share"] * (lr_factor(elapsed / budget) if recipe.schedule else 1.0)
        pair = source.next()
        with torch.autocast(device.type, torch.bfloat16, enabled=args.precision == "bf16"):
            output, loss = fused_and_taught(network, teacher, pair["lrhs"], pair["hrls"])
        loss = loss + loss_function(output.float(), pair["target"])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        length = float(torch.nn.utils.clip_grad_norm_(learning, recipe.clip_gradient))
        if math.isfinite(length) and length < SPIKE * usual:
            optimizer.step()
            average.update(network, step)
        else:
            since["skipped"] += 1
        if math.isfinite(length):
            usual = length if math.isinf(usual) else 0.98 * usual + 0.02 * min(length, SPIKE * usual)

        # The clock decides what is next
        since["steps"] += 1
        since["loss"] += float(loss.detach())
        elapsed = time.monotonic() - started
        if stop or elapsed >= min(budget, next_checkpoint):
            checkpoint()
            next_checkpoint = elapsed + args.checkpoint_seconds
    source.close()


def write_row(path: Path, row: dict[str, float]) -> None:
    """Append a line to a CSV file, with a header when it is new."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(row)
        writer.writerow(f"{value:.5g}" if isinstance(value, float) else value for value in row.values())


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scale", type=int, choices=(2, 4, 8), required=True, nargs="+", help="several for a pyramid network"
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of views (.npz)")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; continued if it has a checkpoint")
    parser.add_argument("--minutes", type=float, required=True, help="length of the whole run, continuations included")
    parser.add_argument("--network", choices=NETWORKS, default="paper", help="the paper's, or another of docs/")
    parser.add_argument(
        "--channels",
        type=int,
        nargs="+",
        help="of the levels H/2, H/4, ...; default: what the shipped networks have",
    )
    parser.add_argument(
        "--stem", type=int, default=2, help="HRLS pixels across that a mixing network's features are first made of"
    )
    parser.add_argument(
        "--kernels",
        type=int,
        nargs=LEVELS,
        default=(5,) * LEVELS,
        metavar="TAPS",
        help="taps across of a pyramid network's kernels at H, H/2, ...",
    )
    parser.add_argument("--preset", choices=RECIPES, default="ours")
    parser.add_argument("--init", type=Path, help="checkpoint of another run, of any scale, to start from")
    parser.add_argument(
        "--teacher", type=Path, help="checkpoint of a larger mixing network, whose choices are learnt too"
    )
    parser.add_argument("--only", default="", help="train the part of the network with this name, such as heads")
    parser.add_argument("--batch", type=int, help="default: the preset's")
    parser.add_argument("--patch", type=int, help="HR pixels; default: the preset's")
    parser.add_argument("--lr", type=float, help="peak learning rate; default: the preset's")
    parser.add_argument(
        "--retrain", type=float, default=0.06, help="share of the learning rate for a joint network's given weights"
    )
    parser.add_argument("--loss", choices=losses.LOSSES, help="default: the preset's")
    parser.add_argument(
        "--precision", choices=("bf16", "fp32"), default="bf16", help="of convolutions; weights stay fp32"
    )
    parser.add_argument("--threads", type=int, default=1, help="CPU threads; more than idle cores is slower")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--val-views", type=int, default=24, help="validation views, at most")
    parser.add_argument("--val-patch", type=int, default=128, help="HR pixels of the validation crops")
    parser.add_argument("--checkpoint-seconds", type=float, default=120)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    train(parse())
