# SPDX-License-Identifier: Apache-2.0
"""Train a network for a given number of minutes.

    python -m research.training.train --scale 4 --data VIEWS --out RUN --minutes 60
    python -m research.training.train --scale 2 --data VIEWS --out RUN2 --minutes 20 --init RUN/checkpoint.pt

The learning rate depends on the share of the minutes that has passed, not on the number of steps, so a run ends in time
on any machine. The same command continues an interrupted run from its last checkpoint. RUN holds ``checkpoint.pt``,
written every few minutes and on SIGTERM; ``best.pt``, the best one on the validation views, by which the paper selects
its model, too; and ``log.csv``, with a line for each checkpoint.
"""

from __future__ import annotations

import argparse
import csv
import functools
import logging
import math
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from oiio_msspl.exr.atomic import replacing
from research.datagen.views import Folder, SampleView, View
from research.training import checkpoints, losses
from research.training.data import PAPER_PATCH, PAPER_SAMPLING, Batches, Sampling, spp_range
from research.training.joint import SIZES, JointFusion
from research.training.networks import NETWORKS, Network, preparation, run
from research.training.paper import MultiResolutionFusion
from research.training.pool import PooledBatches
from research.training.validation import ValidationPair, evaluate

log = logging.getLogger(__name__)

#: A step is skipped if its gradient is this many times longer than usual. One bad batch could undo a run in spite of
#: clipping, because Adam divides it by the small gradients before it.
SPIKE = 4.0
#: A run that falls this many dB behind its best checkpoint returns to it, with half the learning rate.
COLLAPSE = 2.0
#: Share of the run in which the learning rate rises.
WARM_UP = 0.03
#: Largest decay of the averaged weights.
EMA_DECAY = 0.999


@dataclass(frozen=True)
class Recipe:
    """How a network is trained, see ``--preset``."""

    optimizer: type[torch.optim.Optimizer]
    options: dict[str, Any]
    lr: float
    loss: str
    batch: int
    patch: dict[int, int]
    """Width of the training patches in HRLS pixels, by scale."""
    schedule: bool
    """Warm-up and cosine decay; otherwise the learning rate is constant."""
    clip_gradient: float
    """Upper bound of the gradient's norm."""
    sampling: Sampling


RECIPES = {
    # For a CPU and an hour, where many small steps beat few large ones.
    "ours": Recipe(
        optimizer=torch.optim.AdamW,
        # Larger than the default: where a softmax saturates the gradient is tiny, yet Adam would take full steps, all
        # in one direction, until the features explode.
        options={"eps": 1e-6},
        lr=4e-4,
        loss="l1",
        batch=4,
        patch={2: 64, 4: 96, 8: 128},
        schedule=True,
        clip_gradient=1.0,
        sampling=Sampling(),
    ),
    # As in the paper, apart from the log encoding. Its 500 epochs took a week on a GPU.
    "paper": Recipe(
        optimizer=torch.optim.SGD,
        options={},
        lr=1e-4,
        loss="robust",
        batch=16,
        patch=PAPER_PATCH,
        schedule=False,
        clip_gradient=math.inf,
        sampling=PAPER_SAMPLING,
    ),
}


# What a step needs


def lr_factor(progress: float, final: float = 0.01) -> float:
    """Learning rate as a share of its peak after a share of the run in [0, 1]: linear warm-up, then half a cosine that
    ends at ``final``."""
    if progress < WARM_UP:
        return max(progress / WARM_UP, 1e-3)
    done = min((progress - WARM_UP) / (1 - WARM_UP), 1.0)
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done))


@torch.no_grad()
def warming_ema(averages: Any, weights: Any, count: Tensor | int) -> None:
    """Update an exponential moving average in place; its decay grows with the number of averaged weights."""
    torch._foreach_lerp_(averages, weights, 1 - min(EMA_DECAY, (1 + int(count)) / (10 + int(count))))


def averaged(network: Network) -> AveragedModel:
    """The moving average of a network's weights, which counts the initial weights as the first."""
    average = AveragedModel(network, multi_avg_fn=warming_ema).requires_grad_(False)
    average.n_averaged.fill_(1)
    return average


# The run


def new_network(args: argparse.Namespace) -> Network:
    """An untrained network, as the command line describes it."""
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


def parameter_groups(network: Network, args: argparse.Namespace, peak_lr: float) -> list[dict[str, Any]]:
    """The parameters to train. Differences from pretrained weights have a smaller learning rate."""
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name.startswith(args.only))
    learning = [parameter for parameter in network.parameters() if parameter.requires_grad]
    if not learning:
        raise SystemExit(f"--only {args.only}: the network has no such part")
    differences = {id(p) for p in network.differences()} if isinstance(network, JointFusion) else set()
    groups = (
        ([p for p in learning if id(p) not in differences], 1.0),
        ([p for p in learning if id(p) in differences], args.fine_tune),
    )
    return [{"params": params, "lr": peak_lr * share, "share": share} for params, share in groups if params]


class Run:
    """A training run: its networks, optimiser and checkpoints. See :func:`parse` for ``args``."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.recipe = args, RECIPES[args.preset]
        self.scales = tuple(args.scale)
        self.batch = args.batch or self.recipe.batch
        self.patch = args.patch or max(self.recipe.patch[scale] for scale in self.scales)
        self.peak_lr = args.lr or self.recipe.lr
        self.loss_name = args.loss or self.recipe.loss
        self.device = torch.device(
            args.device if args.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
        )
        torch.backends.cudnn.benchmark = True  # batches of a scale have one size
        self.checkpoint_path, self.best_path = args.out / "checkpoint.pt", args.out / "best.pt"
        self.step, self.elapsed, self.best_gain = 0, 0.0, -math.inf

        # Data
        self.folder = Folder(args.data)
        if not self.train_views():
            raise SystemExit(f"{args.data}: no training views (*.npz with split 'train'); render some first")
        self.validation: dict[tuple[Path, int], ValidationPair] = {}

        # Network: from the last checkpoint, from another run, or new
        self.network = new_network(args)
        #: It reads pairs that only a pool has.
        self.large = isinstance(self.network, JointFusion) and self.network.mean_denoiser is None
        if self.large and not args.pool:
            raise SystemExit(
                "--size large: needs a --pool of pairs that research.training.pool has drawn with --denoise"
            )
        state = checkpoints.read(self.checkpoint_path) if self.checkpoint_path.exists() else None
        if state is None and args.init:
            checkpoints.warm_start(self.network, args.init)
        self.network.to(self.device, memory_format=torch.channels_last)
        self.average = averaged(self.network)
        self.optimizer = self.recipe.optimizer(
            parameter_groups(self.network, args, self.peak_lr), lr=self.peak_lr, **self.recipe.options
        )
        if state is not None:
            self.restore(state)
            self.step, self.elapsed = state["step"], state["seconds"]
            self.best_gain = state.get("best_gain", -math.inf)
            log.info("continues at step %d, minute %.1f", self.step, self.elapsed / 60)
        self.schedule = self.new_schedule()
        seed = args.seed + self.step
        self.pairs: Batches | PooledBatches
        if args.pool:
            spread = None if args.noise is None else args.noise == "spread"
            self.pairs = PooledBatches(
                args.pool, self.scales, self.patch, self.batch, seed, self.device, spread=spread
            )  # fmt: skip
        else:
            self.pairs = Batches(
                args.data, self.scales, self.patch, self.batch, self.recipe.sampling, seed, self.device,
                functools.partial(preparation, args.network),
            )  # fmt: skip
        self.reset_statistics()

    def new_schedule(self) -> LambdaLR:
        """Set the learning rate by the clock, at every ``step()`` of the schedule."""
        for group in self.optimizer.param_groups:
            group["initial_lr"] = self.peak_lr * group["share"]
        budget = max(self.args.minutes * 60, 1e-9)

        def factor(_: int) -> float:
            return lr_factor(self.elapsed / budget, self.args.final_lr) if self.recipe.schedule else 1.0

        return LambdaLR(self.optimizer, factor)

    def restore(self, state: checkpoints.State) -> None:
        """Return to the weights and the optimiser of a checkpoint."""
        self.network.load_state_dict(state["network"])
        self.average.module.load_state_dict(state["ema"])
        self.average.n_averaged.fill_(1 + state["step"])
        self.optimizer.load_state_dict(state["optimizer"])

    def reset_statistics(self) -> None:
        """Start to count anew, for the next line of the log."""
        self.since = {"time": time.monotonic(), "steps": 0, "skipped": 0, "loss": 0.0, "waited": 0.0}

    def train(self) -> None:
        """Train until the minutes are over or a signal comes."""
        stop = False

        def on_signal(*_: object) -> None:
            nonlocal stop
            stop = True

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)

        budget, started = self.args.minutes * 60, time.monotonic() - self.elapsed
        self.checkpoint()
        next_checkpoint = self.elapsed + self.args.checkpoint_seconds
        if stop or self.elapsed >= budget:
            return
        batches, usual = iter(self.pairs.loader()), math.inf
        while not stop and self.elapsed < budget:
            self.step += 1
            usual = self.take_step(batches, usual)
            self.elapsed = time.monotonic() - started
            if stop or self.elapsed >= min(budget, next_checkpoint):
                self.checkpoint()
                next_checkpoint = self.elapsed + self.args.checkpoint_seconds
            self.schedule.step()

    def take_step(self, batches: Any, usual: float) -> float:
        """Train on a batch, unless its gradient is a spike; return the usual length of a gradient."""
        before = time.monotonic()
        pair = next(batches)
        self.since["waited"] += time.monotonic() - before
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.args.precision == "bf16"):
            output, _ = run(self.network, pair["lrhs"], pair["hrls"])
        loss = losses.LOSSES[self.loss_name](output.float(), pair["target"])
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        learning = [parameter for group in self.optimizer.param_groups for parameter in group["params"]]
        length = float(torch.nn.utils.clip_grad_norm_(learning, self.recipe.clip_gradient))
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
        """Evaluate, log a line and write the state; return to the best checkpoint if training has collapsed."""
        scores = self.evaluate()
        self.log_row(scores)
        gain = scores["psnr"] - scores["bicubic_psnr"] if scores else math.nan
        if scores and self.best_path.exists() and not gain >= self.best_gain - COLLAPSE:  # or it is NaN
            self.peak_lr /= 2
            self.restore(checkpoints.read(self.best_path))
            self.schedule = self.new_schedule()
            message = "collapsed to %+.1f dB, back to %+.1f dB, peak learning rate %.2g"
            log.warning(message, gain, self.best_gain, self.peak_lr)
        else:
            better = not scores or gain > self.best_gain  # without validation views the newest is the best
            if better and scores:
                self.best_gain = gain
            state = self.state(scores)
            if better:
                checkpoints.save(state, self.best_path)
            checkpoints.save(state, self.checkpoint_path)
        self.reset_statistics()

    def evaluate(self) -> dict[str, float]:
        """Scores of the averaged weights on the validation views of the run's start."""
        if self.large:
            return {}
        if not self.validation:  # views that are added later would make scores incomparable
            prepare = preparation(self.args.network)
            for view in self.folder.split("validation")[: self.args.val_views]:
                for scale in self.scales:
                    pair = ValidationPair.centre(view, scale, self.args.val_patch, prepare)
                    self.validation[view.path, scale] = pair
        return evaluate(self.average.module, self.validation.values(), self.device)

    def train_views(self) -> list[View | SampleView]:
        """The training views that there are so far, of both kinds."""
        return [*self.folder.split("train"), *self.folder.sample_views("train")]

    def log_row(self, scores: dict[str, float]) -> None:
        """Append a line to ``log.csv``."""
        self.folder.scan()
        since, interval = self.since, max(time.monotonic() - self.since["time"], 1e-9)
        row = {
            "step": self.step,
            "minutes": self.elapsed / 60,
            "loss": since["loss"] / max(since["steps"], 1),
            "lr": self.optimizer.param_groups[0]["lr"],
            "skipped_steps": since["skipped"],
            "samples_per_s": since["steps"] * self.batch / interval,
            "wait_share": since["waited"] / interval,
            "train_views": len(self.train_views()),
            "val_pairs": len(self.validation),
            **scores,
        }
        log.info("%s", "  ".join(f"{k} {v:.4g}" for k, v in row.items()))
        write_row(self.args.out / "log.csv", row)

    def spp_range(self, views: list[View | SampleView], scale: int) -> dict[str, list[int]]:
        """Lowest and highest spp of all pairs, by render."""
        ranges = [spp_range(view, self.recipe.sampling, scale) for view in views]
        return {
            render: [min(each[render][0] for each in ranges), max(each[render][1] for each in ranges)]
            for render in ranges[0]
        }

    def state(self, scores: dict[str, float]) -> checkpoints.State:
        """The checkpoint, see :mod:`research.training.checkpoints`."""
        views = self.train_views()
        return {
            "network": self.network.state_dict(),
            "ema": self.average.module.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "architecture": self.args.network,
            "config": self.network.config,
            "step": self.step,
            "seconds": self.elapsed,
            "best_gain": self.best_gain,
            "training_spp": {str(scale): self.spp_range(views, scale) for scale in self.scales},
            "provenance": {
                "steps": self.step,
                "minutes": round(self.elapsed / 60, 1),
                "batch": self.batch,
                "patch": self.patch,
                "loss": self.loss_name,
                "preset": self.args.preset,
                "seed": self.args.seed,
                **({"init": self.args.init.name} if self.args.init else {}),
                "views": len(views),
                "scenes": len({view.scene for view in views}),
                "sources": sorted({view.source for view in views}),
                "torch": str(torch.__version__),
                "validation": {"pairs": len(self.validation), "hrls_spp": 1} | scores,
            },
        }


def train(args: argparse.Namespace) -> None:
    """Train a network; see :func:`parse` for the arguments."""
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    args.out.mkdir(parents=True, exist_ok=True)
    Run(args).train()


def write_row(path: Path, row: dict[str, float]) -> None:
    """Add a line to a CSV file, and the columns that it lacks."""
    rows: list[dict[str, object]] = []
    if path.exists():
        with path.open(newline="") as file:
            rows += csv.DictReader(file)
    rows.append({name: f"{value:.5g}" if isinstance(value, float) else value for name, value in row.items()})
    with replacing(path, overwrite=True) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for each in rows for name in each)))
        writer.writeheader()
        writer.writerows(rows)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scale",
        type=int,
        choices=(2, 4, 8),
        required=True,
        nargs="+",
        help="upsampling factors; the paper's network has one",
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of views (.npz)")
    parser.add_argument(
        "--pool", type=Path, help="joint on a GPU: folder of pairs drawn ahead by research.training.pool"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; continued if it has a checkpoint")
    parser.add_argument("--minutes", type=float, required=True, help="length of the whole run, continuations included")
    parser.add_argument("--network", choices=NETWORKS, default="paper", help="(default: %(default)s)")
    parser.add_argument("--size", choices=SIZES, help="joint: (default: usual, or that of --init)")
    parser.add_argument("--spread", action="store_true", help="joint: for noise that a pixel filter has spread")
    parser.add_argument("--preset", choices=RECIPES, default="ours")
    parser.add_argument("--init", type=Path, help="checkpoint of another run, of any scale, to start from")
    parser.add_argument("--only", default="", help="train only the part of the network with this name, such as heads")
    parser.add_argument("--batch", type=int, help="(default: the preset's)")
    parser.add_argument("--patch", type=int, help="width in HRLS pixels (default: the preset's)")
    parser.add_argument("--lr", type=float, help="peak learning rate (default: the preset's)")
    parser.add_argument(
        "--fine-tune",
        type=float,
        default=0.06,
        help="joint: share of the learning rate for pretrained weights",
    )
    parser.add_argument(
        "--final-lr", type=float, default=0.01, help="share of the learning rate at the end (default: %(default)s)"
    )
    parser.add_argument("--noise", choices=("independent", "spread"), help="only such pairs of --pool (default: all)")
    parser.add_argument("--loss", choices=losses.LOSSES, help="(default: the preset's)")
    parser.add_argument(
        "--precision",
        choices=("bf16", "fp32"),
        default="bf16",
        help="of convolutions; weights stay fp32 (default: %(default)s)",
    )
    parser.add_argument(
        "--threads", type=int, default=1, help="CPU threads; no more than idle cores (default: %(default)s)"
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--val-views", type=int, default=24, help="validation views, at most")
    parser.add_argument("--val-patch", type=int, default=128, help="width of the validation crops in HRLS pixels")
    parser.add_argument("--checkpoint-seconds", type=float, default=120)
    args = parser.parse_args(arguments)
    if args.noise and not args.pool:
        parser.error("--noise chooses pairs of --pool")
    return args


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    train(parse())
