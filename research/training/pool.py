# SPDX-License-Identifier: Apache-2.0
"""Training pairs that are drawn ahead and kept on a GPU.

    python -m research.training.pool VIEWS POOL --draws 8
    python -m research.training.pool VIEWS POOL --denoise JOINT.pt JOINT_SPREAD.pt
    python -m research.training.pool VIEWS POOL --denoise JOINT.pt JOINT_SPREAD.pt --teach LARGE.pt LARGE_SPREAD.pt

A GPU takes a step in less time than :func:`research.training.data.draw` takes for one pair. So whole views are drawn
ahead, some times each: with other samples, filters, light and missing layers at each draw. The pairs of a view lie in a
file of POOL. The same command goes on with new views. Training keeps all pairs on the GPU. Each batch has crops of some
of them, mirrored, turned, and with permuted colours.

With ``--denoise``, pairs are those that the size ``large`` of `joint` reads: albedo, normal and the mean of both
renders are denoised. Of views with single samples, every second pair then has noise that the pixel filter has spread.

With ``--teach``, the target of a pair is not the reference, but what a :class:`Teacher` makes of both renders.

References that were stored with their noise (:mod:`research.datagen.mitsuba.render_samples`) become the mean of the
rendered and of a denoised one: half of the noise is left, and half of what a denoiser gets wrong.
"""

from __future__ import annotations

import argparse
import functools
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from research.datagen.views import NO_REFERENCE, Folder, SampleView, View
from research.training import checkpoints
from research.training.data import Batch, SampleTensors, Sampling, ViewTensors, draw, turned
from research.training.denoisers import FullSizeDenoiser, LayerDenoisers, denoise_mean
from research.training.encoding import compress, exposure_of, log_decode, log_encode
from research.training.joint import HRLS_CHANNELS, JointFusion
from research.training.render_mean import with_mean

log = logging.getLogger(__name__)

#: Widths of a view are cut to a multiple of this.
ALIGNMENT = 128
#: Share of the pairs in which parts of both renders have more samples.
UNEVEN = 0.3

#: Entry of a pair: whether the pixel filter has spread its noise.
SPREAD_NOISE = "spread"

Pair = dict[str, Tensor]
M = TypeVar("M", bound=nn.Module)


# Drawing


class Denoisers:
    """The networks that prepare pairs, and OIDN's large one, which denoises references and teaches.

    Args:
        joints: two ``joint`` networks, for independent noise and for spread noise. Their denoisers of both renders'
            mean prepare pairs for the size ``large``; none for pairs of the other sizes.

    Raises:
        SystemExit: the networks are others.
    """

    def __init__(self, joints: Sequence[JointFusion], device: torch.device) -> None:
        self.device = device
        self.joints = [self.moved(joint) for joint in joints]
        self.means = [joint.mean_denoiser for joint in self.joints if joint.mean_denoiser is not None]
        if joints and (len(self.means) != 2 or [joint.spread for joint in joints] != [False, True]):
            raise SystemExit("--denoise: give a joint network for independent noise, then one for spread noise")

    @functools.cached_property
    def layers(self) -> LayerDenoisers:
        """The networks for albedo and normal."""
        return self.moved(LayerDenoisers())

    @functools.cached_property
    def large(self) -> FullSizeDenoiser:
        """OIDN's large network."""
        return self.moved(FullSizeDenoiser())

    def moved(self, network: M) -> M:
        """Return a network without gradients, on the device."""
        moved: M = network.requires_grad_(False).to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return moved

    def reference(self, colour: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """Return the mean of a rendered reference and of a denoised one, all (1, 3, H, W)."""
        exposure = exposure_of(colour.movedim(1, -1))
        encoded = compress(colour.movedim(1, -1), exposure).movedim(-1, 1)
        return 0.5 * (colour + log_decode(self.large(encoded, *self.layers(albedo, normal))) / exposure)

    def prepared(self, lrhs: Tensor, hrls: Tensor, spread: bool) -> tuple[Tensor, Tensor]:
        """Convert the arguments of :meth:`JointFusion.forward` to those of :meth:`JointFusion.fuse_prepared`."""
        return denoise_mean(self.means[spread], lrhs, hrls), self.layers.applied(hrls)


class Teacher:
    """Targets from the renders themselves: a weighted mean of what several networks make of them.

    The networks err in different places, so their mean is better than each. One network that learns to reproduce it
    from many pairs comes close, without their time (Hinton et al. 2015, *Distilling the knowledge in a neural
    network*). It needs no reference, so views for it are rendered in a few seconds.

    The members are ``joint`` (one quarter), OIDN's large network on the HRLS (one quarter), and a first network of the
    size ``large`` (one half). OIDN has not learnt spread noise, so it is left out there.

    Args:
        denoisers: with two ``joint`` networks.
        larges: two of the size ``large``, for independent noise and for spread noise.
    """

    def __init__(self, denoisers: Denoisers, larges: Sequence[JointFusion]) -> None:
        if len(denoisers.means) != 2 or [large.size for large in larges] != ["large", "large"]:
            raise SystemExit("--teach: give two networks of the size large, and --denoise")
        self.denoisers, self.larges = denoisers, [denoisers.moved(large) for large in larges]

    def target(self, lrhs: Tensor, hrls: Tensor, prepared: Tensor, spread: bool) -> Tensor:
        """Return the mean (1, 3, s*H, s*W), log-encoded.

        ``lrhs`` and ``prepared`` are the arguments of :meth:`JointFusion.fuse_prepared`. The albedo and normal of
        ``hrls`` are as rendered.
        """
        joint, _ = self.denoisers.joints[spread].fuse(lrhs, hrls)
        first, _ = self.larges[spread].fuse_prepared(lrhs, prepared)
        results = [joint, first, first]
        if not spread:
            results.append(self.denoisers.large(prepared[:, :3], prepared[:, 3:6], 0.5 * prepared[:, 6:9] + 0.5))
        return log_encode(torch.stack([log_decode(result) for result in results]).mean(dim=0))


@torch.no_grad()
def draw_pairs(
    view: View | SampleView, scales: tuple[int, ...], count: int, device: torch.device,
    denoisers: Denoisers | None = None, teacher: Teacher | None = None,
) -> list[Pair]:  # fmt: skip
    """Draw a view ``count`` times: ``lrhs`` (7, h, w), ``hrls`` (9, s*h, s*w), ``target`` (3, s*h, s*w), half floats.

    The LRHS has the mean of both renders and its noise, see :func:`research.training.render_mean.with_mean`. Or it is
    (6, h, w), with the denoised mean, see :meth:`Denoisers.prepared`; ``spread`` then says whether noise is spread.
    Without ``denoisers``, references that were stored with their noise keep it. With a ``teacher``, targets are its
    results.
    """
    rng = np.random.default_rng([*view.path.name.encode(), count])
    tensors: ViewTensors | SampleTensors
    if isinstance(view, SampleView):
        tensors = SampleTensors(view, device)
        if denoisers is not None and (noisy := tensors.noisy_reference()) is not None:
            tensors.clean_reference = denoisers.reference(*noisy)
    else:
        tensors = ViewTensors(view, device)
    patch = min(tensors.size) // ALIGNMENT * ALIGNMENT
    prepares = denoisers is not None and bool(denoisers.means)
    pairs = []
    for index in range(count):
        spread = prepares and isinstance(view, SampleView) and index % 2 == 1
        sampling = Sampling(spread_noise=spread if prepares else None, uneven=UNEVEN)
        batch = draw([tensors], int(rng.choice(scales)), patch, 1, rng, sampling)
        lrhs, hrls = batch["lrhs"], batch["hrls"]
        lrhs, hrls = with_mean(lrhs, hrls), hrls[:, :HRLS_CHANNELS]
        target, rendered = batch["target"], hrls
        if denoisers is not None and prepares:
            lrhs, hrls = denoisers.prepared(lrhs, hrls, spread)
        if teacher is not None:
            target = teacher.target(lrhs, rendered, hrls, spread)
        batch = {"lrhs": lrhs, "hrls": hrls, "target": target}
        pair = {name: image[0].half().contiguous().cpu() for name, image in batch.items()}
        if all(bool(image.isfinite().all()) for image in pair.values()):
            pairs.append(pair | ({SPREAD_NOISE: torch.tensor(spread)} if prepares else {}))
    return pairs


def fill(
    views: Path, pool: Path, scales: tuple[int, ...], draws: int, denoisers: Denoisers, teacher: Teacher | None = None
) -> None:
    """Write the pairs of all training views that have none yet. Views without a reference are only for a teacher."""
    folder = Folder(views)
    pool.mkdir(parents=True, exist_ok=True)
    todo: list[View | SampleView] = [*folder.split("train"), *folder.sample_views("train")]
    todo += folder.sample_views(NO_REFERENCE) if teacher is not None else []
    for view in todo:
        file = pool / f"{view.path.name}.pt"
        if not file.exists():
            checkpoints.save(draw_pairs(view, scales, draws, denoisers.device, denoisers, teacher), file)
            log.info("%s", file.name)


# Batches


class PooledBatches:
    """Endless random batches of the pairs of a folder, on a GPU.

    Args:
        pool: the folder that :func:`fill` writes.
        scales: of each batch, one of these at random.
        patch: width and height of a patch in HRLS pixels.
        batch: pairs per batch.
        spread: of pairs for the size ``large``, only those with spread noise, only the others, or all (None).
    """

    def __init__(
        self, pool: Path, scales: tuple[int, ...], patch: int, batch: int, seed: int, device: torch.device, *,
        spread: bool | None = None,
    ) -> None:  # fmt: skip
        self.scales, self.patch, self.batch, self.device = scales, patch, batch, device
        self.rng = np.random.default_rng(seed)
        self.pairs: dict[int, list[Pair]] = {scale: [] for scale in scales}
        for file in sorted(pool.glob("*.pt")):
            for pair in torch.load(file, weights_only=True):
                self._keep(pair, file, spread)
        if not any(self.pairs.values()):
            raise SystemExit(f"{pool}: holds no pairs for this training; draw some with research.training.pool")

    def _keep(self, pair: Pair, file: Path, wanted: bool | None) -> None:
        """Move a pair to the device, if it is of use."""
        spread = pair.pop(SPREAD_NOISE, None)
        if wanted is not None and spread is None:
            raise SystemExit(f"{file}: does not tell spread noise apart; draw pairs with --denoise")
        scale = pair["hrls"].shape[-1] // pair["lrhs"].shape[-1]
        of_kind = wanted is None or wanted == bool(spread)
        if of_kind and scale in self.pairs and pair["hrls"].shape[-1] >= self.patch:
            self.pairs[scale].append({name: image.to(self.device) for name, image in pair.items()})

    def loader(self) -> Iterator[Batch]:
        """Yield endless batches, see :data:`research.training.data.Batch`."""
        ready = [scale for scale in self.scales if self.pairs[scale]]
        while True:
            yield self.draw(int(self.rng.choice(ready)))

    def draw(self, scale: int) -> Batch:
        """Draw a batch of one scale."""
        rng, pairs = self.rng, self.pairs[scale]
        parts: dict[str, list[Tensor]] = {"lrhs": [], "hrls": [], "target": []}
        for index in rng.integers(len(pairs), size=self.batch):
            pair = pairs[index]
            top, left = (int(rng.integers((side * scale - self.patch) // scale + 1)) for side in pair["lrhs"].shape[1:])
            order = rng.permutation(3) if rng.random() < 0.5 else np.arange(3)
            channels = torch.from_numpy(np.concatenate([order, order + 3, [6, 7, 8]])).to(self.device)
            for name, image in pair.items():
                factor = 1 if name == "lrhs" else scale
                side = self.patch * factor // scale
                crop = image[:, top * factor : top * factor + side, left * factor : left * factor + side]
                parts[name].append(crop[channels[: len(crop)]])
        return turned({name: torch.stack(crops).float() for name, crops in parts.items()}, rng)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, help="folder of training views")
    parser.add_argument("pool", type=Path, help="folder for the pairs")
    parser.add_argument("--scale", type=int, nargs="+", default=(2, 4, 2, 4, 8), help="drawn from these (2 4 2 4 8)")
    parser.add_argument("--draws", type=int, default=6, help="pairs per view (%(default)s)")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    denoise, teach = "pairs for the size large, see above", "targets by a teacher with these, see above"
    parser.add_argument("--denoise", type=Path, nargs=2, default=(), metavar="JOINT", help=denoise)
    parser.add_argument("--teach", type=Path, nargs=2, default=(), metavar="LARGE", help=teach)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    joints, larges = ([checkpoints.load_joint(path)[0] for path in paths] for paths in (args.denoise, args.teach))
    denoisers = Denoisers(joints, torch.device(args.device))
    teacher = Teacher(denoisers, larges) if larges else None
    fill(args.views, args.pool, tuple(args.scale), args.draws, denoisers, teacher)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    main()
