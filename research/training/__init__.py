# SPDX-License-Identifier: Apache-2.0
"""Training: networks, data, the run, and export to ONNX. The only part of the project that needs PyTorch.

``make`` retrains a model by its recipe in ``recipes.toml``.
Networks: ``paper`` is the paper's, ``joint`` in three sizes is ours.
``ops``, ``encoding``, ``oidn``, ``render_mean`` and ``denoisers`` are what they are made of.
Training: ``data`` and ``pool`` draw pairs from views, ``losses``, ``validation``, ``train``, ``checkpoints``.
Checkpoints: ``average``, ``prune`` and ``error`` change one. ``export``, ``gpu`` and ``quantise`` make a model of it:
``tracing`` and ``whole_model`` write its graph.
"""

from pathlib import Path

#: Weights that further training begins from, and quantised denoisers of both renders' mean.
CHECKPOINTS = Path(__file__).parent / "checkpoints"
