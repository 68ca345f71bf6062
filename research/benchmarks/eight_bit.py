# SPDX-License-Identifier: Apache-2.0
"""Compare the accuracy of the files for CPUs (8 bits) and for GPUs (half floats) with PyTorch in 32 bits.

    python -m research.benchmarks.eight_bit RENDERS
    python -m research.benchmarks.eight_bit VIEWS

PSNR is of sRGB pictures, with 1, 2 and 4 spp in either render where there are such files, over the development scenes
(:mod:`research.benchmarks.scenes`) or every third validation view (:mod:`research.datagen.views`). The CPU runs all
three; it rounds the weights of the file for GPUs to half floats and multiplies in 32 bits. `paper` has one file.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from oiio_msspl import Session, find_model, fuse
from oiio_msspl.errors import InputError
from oiio_msspl.image.metrics import psnr
from oiio_msspl.model.contract import SCALES
from oiio_msspl.model.devices import gpu_file
from oiio_msspl.model.render_mean import Images, Shares
from research.benchmarks import results, scenes
from research.benchmarks.results import Row
from research.datagen.views import Folder
from research.training.checkpoints import load as load_checkpoint
from research.training.export import denoiser_for
from research.training.joint import JointFusion
from research.training.whole_model import InTorch

SPP = (1, 2, 4)
#: Columns: how the network computes.
WAYS = ("psnr_32bit", "psnr_8bit", "psnr_half")
_FOLDER = Path(__file__).parents[1] / "training/checkpoints"
#: By family of models.
CHECKPOINTS = {
    "joint": _FOLDER / "joint.pt",
    "joint-small": _FOLDER / "joint_small.pt",
    "joint-large": _FOLDER / "joint_large.pt",
}


def accuracy(views: list[scenes.Scene], scale: int, sessions: Sequence[Session]) -> Iterator[tuple[int, list[float]]]:
    """Yield the mean PSNR of every session, for each of `SPP` that all scenes have."""
    for spp in SPP:
        try:
            pairs = [(view.lrhs(scale, spp), view.hrls(spp), view.reference) for view in views]
        except InputError:  # no such file
            continue
        yield spp, [statistics.fmean(psnr(fuse(lr, hr, s).rgb, ref) for lr, hr, ref in pairs) for s in sessions]


class InPyTorch(Session):
    """A model computed by PyTorch in 32 bits, from its checkpoint."""

    def __init__(self, path: Path, family: str) -> None:
        super().__init__(path)
        network, _ = load_checkpoint(CHECKPOINTS[family])
        assert isinstance(network, JointFusion)
        self._model = InTorch(self.contract, network.fuse, denoiser_for(network, self.contract.denoiser))

    @torch.inference_mode()
    def run(self, lrhs: Images, hrls: Images, exposure: float, shares: Shares, **_: object) -> Images:
        feed = {name: torch.from_numpy(values) for name, values in self._feed(lrhs, hrls, exposure, shares).items()}
        return {"fused": self._model(feed)[0].permute(1, 2, 0).numpy()}


def measure(views: list[scenes.Scene], models: list[str]) -> Iterator[Row]:
    """Yield a row for each model and number of spp."""
    for name in models:
        path = find_model(0, name)
        sessions = [InPyTorch(path, name.rpartition("-x")[0]), Session(path), Session(gpu_file(path) or path)]
        for spp, psnrs in accuracy(views, sessions[0].contract.scale, sessions):
            yield {"method": name, "model": name, "spp": spp, **dict(zip(WAYS, psnrs, strict=True))}


def main() -> None:
    """Measure scenes or views."""
    parser = results.parser(__doc__)
    parser.add_argument("scenes", type=Path, metavar="RENDERS_OR_VIEWS")
    models = [f"{family}-x{scale}" for family in CHECKPOINTS for scale in SCALES]
    parser.add_argument("--models", nargs="+", default=models)
    args = parser.parse_args()
    if any(args.scenes.glob("*/ref.exr")):
        views = [scene for scene in scenes.load(args.scenes) if scene.name not in scenes.NOISY_REFERENCE]
    else:
        views = [scenes.of_view(view) for view in Folder(args.scenes).split("validation")[::3]]
    results.show(list(measure(views, args.models)), args.table)


if __name__ == "__main__":
    main()
