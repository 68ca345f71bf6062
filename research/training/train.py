# SPDX-License-Identifier: Apache-2.0
"""Train a network for a given number of minutes.

    python -m research.training.train --scale 4 --data VIEWS --out RUN --minutes 60
    python -m research.training.train --scale 2 --data VIEWS --out RUN2 --minutes 20 --init RUN/final.pt

The learning rate depends on the share of the minutes that has passed, not on the number of steps, so a run ends in time
on any machine. The same command continues an interrupted run from its last checkpoint. RUN holds ``checkpoint.pt``,
written every few minutes and on SIGTERM; ``best.pt``, the best one on the validation views, by which the paper selects
its model, too; ``final.pt``, once the minutes are over; and ``log.csv``, with a line for each checkpoint.
"""

from __future__ import annotations

import argparse
import csv
import logging
import math
import signal
import threading
import time
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from oiio_msspl.exr.atomic import replacing
from research.datagen.views import Folder, SampleView, View
from research.training import checkpoints, losses
from research.training.checkpoints import NETWORKS, Network, run
from research.training.data import Batches, spp_range
from research.training.joint import SIZES, JointFusion
from research.training.paper import MultiResolutionFusion
from research.training.pool import PooledBatches
from research.training.render_mean import with_mean
from research.training.validation import ValidationPair, evaluate

log = logging.getLogger(__name__)

#: Upper bound of the gradient's norm.
CLIP_GRADIENT = 1.0
#: AdamW's eps. Larger than the default: where a softmax saturates the gradient is tiny, yet Adam would take full steps,
#: all in one direction, until the features explode.
EPS = 1e-6
#: Width of the patches in HRLS pixels, by scale. For a CPU, many small steps beat few large ones.
PATCH = {2: 64, 4: 96, 8: 128}
#: A step is skipped if its gradient is this many times longer than usual. One bad batch could undo a run in spite of
#: clipping, because Adam divides it by the small gradients before it.
SPIKE = 4.0
#: Share of the run in which the learning rate rises.
WARM_UP = 0.03
#: Largest decay of the averaged weights.
EMA_DECAY = 0.999


# What a step needs


def lr_factor(progress: float, final: float = 0.01) -> float:
    """Return the learning rate as a share of its peak after a share of the run in [0, 1].

    A linear warm-up is followed by half a cosine, which ends at ``final``.
    """
    if progress < WARM_UP:
        return max(progress / WARM_UP, 1e-3)
    done = min((progress - WARM_UP) / (1 - WARM_UP), 1.0)
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done))


@torch.no_grad()
def warming_ema(averages: Any, weights: Any, count: Tensor | int) -> None:
    """Update an exponential moving average in place; its decay grows with the number of averaged weights."""
    torch._foreach_lerp_(averages, weights, 1 - min(EMA_DECAY, (1 + int(count)) / (10 + int(count))))


def averaged(network: Network) -> AveragedModel:
    """Return the moving average of a network's weights, which counts the initial weights as the first."""
    average = AveragedModel(network, multi_avg_fn=warming_ema).requires_grad_(False)
    average.n_averaged.fill_(1)
    return average


# The run


def new_network(args: argparse.Namespace) -> Network:
    """Return an untrained network, as the command line describes it."""
    if args.network == "joint":
        started = args.out / "checkpoint.pt"
        earlier = started if started.exists() else args.init
        config = checkpoints.read(earlier)["config"] if earlier else {"size": args.size or "usual"}
        if args.size not in (None, config.get("size", "usual")):
            raise SystemExit(f"--size {args.size}: {earlier} has the size {config['size']}")
        return JointFusion(**config | ({"spread": True} if args.spread else {}))
    if len(args.scale) > 1:
        raise SystemExit("--network paper: a network has one --scale")
    return MultiResolutionFusion(args.scale[0])


def parameter_groups(network: Network, fine_tune: float, peak_lr: float) -> list[dict[str, Any]]:
    """Return the parameters to train. Differences from pretrained weights have a smaller learning rate."""
    differences = {id(p) for p in network.differences()} if isinstance(network, JointFusion) else set()
    groups = (
        ([p for p in network.parameters() if id(p) not in differences], 1.0),
        ([p for p in network.parameters() if id(p) in differences], fine_tune),
    )
    return [{"params": params, "lr": peak_lr * share, "share": share} for params, share in groups if params]


class Run:
    """A training run: its networks, optimiser and checkpoints. :func:`parse` describes ``args``."""

    def __init__(self, args: argparse.Namespace) -> None:
        torch.set_num_threads(args.threads)
        torch.manual_seed(args.seed)
        args.out.mkdir(parents=True, exist_ok=True)
        self.args = args
        self.scales = tuple(args.scale)
        self.patch = args.patch or max(PATCH[scale] for scale in self.scales)
        self.device = torch.device(args.device)
        torch.backends.cudnn.benchmark = True  # batches of a scale have one size
        self.checkpoint_path = args.out / "checkpoint.pt"
        self.step, self.elapsed, self.best_psnr = 0, 0.0, -math.inf

        # Data
        self.folder = Folder(args.data)
        self.views: list[View | SampleView] = [*self.folder.split("train"), *self.folder.sample_views("train")]
        if not self.views:
            raise SystemExit(f"{args.data}: no training views (*.npz with split 'train'); render some first")
        self.prepare = with_mean if args.network == "joint" else None

        # Network: from the last checkpoint, from another run, or new
        self.network = new_network(args)
        #: It reads pairs that only a pool has.
        self.large = isinstance(self.network, JointFusion) and self.network.mean_denoiser is None
        if self.large and not args.pool:
            raise SystemExit(
                "--size large: needs a --pool of pairs that research.training.pool has drawn with --denoise"
            )
        #: A network of the size large is not scored.
        self.validation = [
            ValidationPair.centre(view, scale, args.val_patch, self.prepare)
            for view in ([] if self.large else self.folder.split("validation")[: args.val_views])
            for scale in dict.fromkeys(self.scales)
        ]
        state = checkpoints.read(self.checkpoint_path) if self.checkpoint_path.exists() else None
        if state is None and args.init:
            checkpoints.warm_start(self.network, args.init)
        self.network.to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = averaged(self.network)
        groups = parameter_groups(self.network, args.fine_tune, args.lr)
        self.optimizer = torch.optim.AdamW(groups, lr=args.lr, eps=EPS)
        if state is not None:
            self.network.load_state_dict(state["network"])
            self.average.module.load_state_dict(state["ema"])
            self.average.n_averaged.fill_(1 + state["step"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.step, self.elapsed = state["step"], state["seconds"]
            self.best_psnr = state["best_psnr"]
            log.info("continues at step %d, minute %.1f", self.step, self.elapsed / 60)
        self.schedule = self.new_schedule()
        self.pairs = self.new_pairs(args.seed + self.step)
        self.reset_statistics()

    def new_pairs(self, seed: int) -> Batches | PooledBatches:
        """Return the source of batches: the pool, or the views."""
        sizes = self.scales, self.patch, self.args.batch
        if self.args.pool:
            spread = None if self.args.noise is None else self.args.noise == "spread"
            return PooledBatches(self.args.pool, *sizes, seed, self.device, spread=spread)
        return Batches(self.args.data, *sizes, self.prepare, seed=seed, device=self.device)

    def new_schedule(self) -> LambdaLR:
        """Set the learning rate by the clock, at every ``step()`` of the schedule."""
        for group in self.optimizer.param_groups:
            group["initial_lr"] = self.args.lr * group["share"]
        budget = max(self.args.minutes * 60, 1e-9)
        return LambdaLR(self.optimizer, lambda _: lr_factor(self.elapsed / budget, self.args.final_lr))

    def reset_statistics(self) -> None:
        """Start to count anew, for the next line of the log."""
        self.since = {"time": time.monotonic(), "steps": 0, "skipped": 0, "loss": 0.0, "waited": 0.0}

    def train(self) -> None:
        """Train until the minutes are over or a signal comes."""
        stop = threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stop.set())
        budget, started = self.args.minutes * 60, time.monotonic() - self.elapsed
        self.checkpoint()
        next_checkpoint = self.elapsed + self.args.checkpoint_seconds
        batches, usual = iter(self.pairs.loader()) if self.elapsed < budget else iter(()), math.inf
        while not stop.is_set() and self.elapsed < budget:
            self.step += 1
            usual = self.take_step(batches, usual)
            self.elapsed = time.monotonic() - started
            if stop.is_set() or self.elapsed >= min(budget, next_checkpoint):
                self.checkpoint()
                next_checkpoint = self.elapsed + self.args.checkpoint_seconds
            self.schedule.step()
        if self.elapsed >= budget:
            state = checkpoints.finished(checkpoints.read(self.checkpoint_path))
            checkpoints.save(state, self.args.out / "final.pt")

    def take_step(self, batches: Any, usual: float) -> float:
        """Train on a batch, unless its gradient is a spike; return the usual length of a gradient."""
        before = time.monotonic()
        pair = next(batches)
        self.since["waited"] += time.monotonic() - before
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.args.precision == "bf16"):
            output, _ = run(self.network, pair["lrhs"], pair["hrls"])
        loss = losses.LOSSES[self.args.loss](output.float(), pair["target"])
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        length = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP_GRADIENT))
        if math.isfinite(length) and length < SPIKE * usual:
            self.optimizer.step()
            self.average.update_parameters(self.network)
        else:
            self.since["skipped"] += 1
        self.since["steps"] += 1
        self.since["loss"] += float(loss.detach())
        if not math.isfinite(length):
            return usual
        return length if math.isinf(usual) else 0.98 * usual + 0.02 * min(length, SPIKE * usual)

    def checkpoint(self) -> None:
        """Score the averaged weights on the validation views, log a line and write the state."""
        scores = evaluate(cast(Network, self.average.module), self.validation, self.device)
        self.log_row(scores)
        better = not scores or scores["psnr"] > self.best_psnr  # without validation views the newest is the best
        if better and scores:
            self.best_psnr = scores["psnr"]
        state = self.state(scores)
        if better:
            checkpoints.save(state, self.args.out / "best.pt")
        checkpoints.save(state, self.checkpoint_path)
        self.reset_statistics()

    def log_row(self, scores: dict[str, float]) -> None:
        """Append a line to ``log.csv``."""
        since, interval = self.since, max(time.monotonic() - self.since["time"], 1e-9)
        row = {
            "step": self.step, "minutes": self.elapsed / 60, "loss": since["loss"] / max(since["steps"], 1),
            "lr": self.optimizer.param_groups[0]["lr"], "skipped_steps": since["skipped"],
            "samples_per_s": since["steps"] * self.args.batch / interval, "wait_share": since["waited"] / interval,
            "train_views": len(self.views), "val_pairs": len(self.validation), **scores,
        }  # fmt: skip
        log.info("%s", "  ".join(f"{k} {v:.4g}" for k, v in row.items()))
        write_row(self.args.out / "log.csv", row)

    def state(self, scores: dict[str, float]) -> checkpoints.State:
        """Return the checkpoint, see :mod:`research.training.checkpoints`."""
        provenance = {
            "steps": self.step, "minutes": round(self.elapsed / 60, 1), "batch": self.args.batch, "patch": self.patch,
            "loss": self.args.loss, "seed": self.args.seed, **({"init": self.args.init.name} if self.args.init else {}),
            "views": len(self.views), "scenes": len({view.scene for view in self.views}),
            "sources": sorted({view.source for view in self.views}), "torch": str(torch.__version__),
            "validation": {"pairs": len(self.validation), "hrls_spp": 1} | scores,
        }  # fmt: skip
        return {
            "network": self.network.state_dict(), "ema": self.average.module.state_dict(),
            "optimizer": self.optimizer.state_dict(), "architecture": self.args.network, "config": self.network.config,
            "step": self.step, "seconds": self.elapsed, "best_psnr": self.best_psnr,
            "training_spp": {str(scale): spp_range(self.views, scale) for scale in self.scales},
            "provenance": provenance,
        }  # fmt: skip


def write_row(path: Path, row: dict[str, float]) -> None:
    """Add a line to a CSV file, and the columns that it lacks."""
    rows: list[dict[str, object]] = []
    if path.exists():
        with path.open(newline="") as file:
            rows += csv.DictReader(file)
    rows.append({name: f"{value:.5g}" if isinstance(value, float) else value for name, value in row.items()})
    with replacing(path, overwrite=True) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for cells in rows for name in cells)))
        writer.writeheader()
        writer.writerows(rows)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    scales = "upsampling factors; the paper's network has one"
    add("--scale", type=int, choices=(2, 4, 8), required=True, nargs="+", help=scales)
    add("--data", type=Path, required=True, help="folder of views (.npz)")
    add("--pool", type=Path, help="joint on a GPU: folder of pairs drawn ahead by research.training.pool")
    add("--out", type=Path, required=True, help="folder of the run; continued if it has a checkpoint")
    add("--minutes", type=float, required=True, help="length of the whole run, continuations included")
    add("--network", choices=NETWORKS, default="paper", help="(default: %(default)s)")
    add("--size", choices=SIZES, help="joint: (default: usual, or that of --init)")
    add("--spread", action="store_true", help="joint: for noise that a pixel filter has spread")
    add("--init", type=Path, help="checkpoint of another run, of any scale, to start from")
    add("--batch", type=int, default=4, help="pairs per step (default: %(default)s)")
    add("--patch", type=int, help="width in HRLS pixels (default: by the scale)")
    add("--lr", type=float, default=4e-4, help="peak learning rate (default: %(default)s)")
    add("--fine-tune", type=float, default=0.06, help="joint: share of the learning rate for pretrained weights")
    add("--final-lr", type=float, default=0.01, help="share of the learning rate at the end (default: %(default)s)")
    add("--noise", choices=("independent", "spread"), help="only such pairs of --pool (default: all)")
    add("--loss", choices=losses.LOSSES, default="relative", help="(default: %(default)s)")
    add("--precision", choices=("bf16", "fp32"), default="bf16", help="of convolutions (default: %(default)s)")
    add("--threads", type=int, default=1, help="CPU threads; no more than idle cores (default: %(default)s)")
    add("--device", default="cpu")
    add("--seed", type=int, default=0)
    add("--val-views", type=int, default=24, help="validation views, at most")
    add("--val-patch", type=int, default=128, help="width of the validation crops in HRLS pixels")
    add("--checkpoint-seconds", type=float, default=120)
    args = parser.parse_args(arguments)
    if args.noise and not args.pool:
        parser.error("--noise chooses pairs of --pool")
    return args


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    Run(parse()).train()
