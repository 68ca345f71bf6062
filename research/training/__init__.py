# SPDX-License-Identifier: Apache-2.0
"""Training: networks, data, the run, and export to ONNX. The only part of the project that needs PyTorch.

Networks: ``paper`` is the paper's, ``joint`` in three sizes is ours; ``networks`` lists both.
``ops``, ``encoding``, ``pu_curve``, ``oidn``, ``render_mean`` and ``mean_denoiser`` are what they are made of.
Training: ``data`` draws pairs from views of :mod:`datagen`, ``losses``, ``validation``, ``train``, ``checkpoints``.
Checkpoints: ``average``, ``prune`` and ``error`` change one. ``export``, ``gpu`` and ``quantise`` make a model of it:
``tracing`` and ``whole_model`` write its graph, and ``export_checks`` compares it with PyTorch.
"""
