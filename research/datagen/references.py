# SPDX-License-Identifier: Apache-2.0
"""Denoise the references of training views.

    python -m research.datagen.references VIEWS

A reference of some hundred spp is still noisy where light is hard to sample, and there its noise exceeds the error that
a network could still remove. Open Image Denoise, guided by the albedo and normal of all passes, removes nearly all of
it. The result is stored beside each training and validation view as ``NAME.ref.npy``, which
:class:`research.datagen.views.View` reads instead of ``ref``. Test views keep the rendered reference, because a
denoiser must not be scored against its own results.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from oiio_msspl.aovs.features import ALBEDO, NORMAL
from oiio_msspl.exr.atomic import replacing
from oiio_msspl.model.encoding import MAX_RADIANCE
from research.datagen import views


def denoised(color: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Denoise a scene-linear reference (H, W, 3), guided by albedo and normal."""
    import pyoidn

    color, albedo, normal = (np.ascontiguousarray(image, np.float32) for image in (color, albedo.clip(0, 1), normal))
    return pyoidn.denoise(color, albedo=albedo, normal=normal, hdr=True, quality="high")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("views", type=Path, help="folder of views")
    args = parser.parse_args()
    made, whole = 0, slice(None)
    folder = views.Folder(args.views)
    for view in folder.split("train") + folder.split("validation"):
        path = views.denoised_reference(view.path)
        if path.exists():
            continue
        guides = views.split_features(np.mean(views.read_hrls(view, list(range(len(view.hr))), whole, whole), axis=0))
        clean = denoised(views.as_float32(view.ref), guides[ALBEDO], guides[NORMAL])
        with replacing(path, overwrite=True) as temporary:
            np.save(temporary, np.minimum(clean, MAX_RADIANCE).astype(np.float16))
        made += 1
    print(f"{made} references denoised")


if __name__ == "__main__":
    main()
