# SPDX-License-Identifier: Apache-2.0
"""Networks in 8 bits.

    python -m training.quantise VIEWS

``static`` quantises an exported ``pyramid`` or ``mix`` network with ONNX Runtime's quantiser. Open Image Denoise's
U-Nets, and the ``joint`` network that is made of one, need more: their inputs and outputs are HDR colours, and rounding
their weights to the nearest code costs 0.7 dB. ``gptq`` chooses their weights layer by layer, ``graph`` builds the ONNX
graph, ``joint`` does both for the ``joint`` network, and the command does both for Open Image Denoise's own networks.
"""
