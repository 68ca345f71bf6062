# SPDX-License-Identifier: Apache-2.0
"""Networks in 8 bits.

    python -m research.training.quantise VIEWS

Open Image Denoise's U-Nets, and the ``joint`` networks that are made of them, need more than ONNX Runtime's quantiser:
their inputs and outputs are HDR colours, and rounding their weights to the nearest code costs 0.7 dB. ``gptq`` chooses
the weights layer by layer, and ``graph`` builds the ONNX graph. ``joint`` does both for the ``joint`` networks,
``layers`` for the denoisers of albedo and normal, and the command for the denoisers of both renders' mean.
"""
