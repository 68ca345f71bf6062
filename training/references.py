# SPDX-License-Identifier: Apache-2.0
"""Take the noise out of training references.

    python -m training.references VIEWS

A reference of some hundred spp is noisy where the light is hard to find, and there its noise is larger than what a
network has left to learn. Open Image Denoise, with the albedo and normal of all passes, leaves hardly any of it. The
result lies beside each view for training and validation as ``NAME.ref.npy``, which :class:`training.data.View` prefers.
Views for testing keep the reference that was rendered: against its own results no denoiser can be judged.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from oiio_msspl import schema
from oiio_msspl.transforms import MAX_RADIANCE
from training import data


def denoised(view: data.View) -> data.Array:
    """The rendered reference (H, W, 3) without its noise."""
    import pyoidn

    whole = slice(None)
    guides = data.split_features(np.mean(data.read_hrls(view, list(range(len(view.hr))), whole, whole), axis=0))
    return pyoidn.denoise(
        data.read(view.ref),
        albedo=np.ascontiguousarray(guides[schema.ALBEDO].clip(0, 1)),
        normal=np.ascontiguousarray(guides[schema.NORMAL]),
        hdr=True,
        quality="high",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path)
    args = parser.parse_args()
    made = 0
    folder = data.Folder(args.views)
    for view in folder.split("train") + folder.split("validation"):
        path = data.clean_reference(view.path)
        if path.exists():
            continue
        partial = path.with_name(f".{path.name}")
        with partial.open("wb") as file:
            np.save(file, np.minimum(denoised(view), MAX_RADIANCE).astype(np.float16))
        os.replace(partial, path)
        made += 1
    print(f"{made} references denoised")


if __name__ == "__main__":
    main()
