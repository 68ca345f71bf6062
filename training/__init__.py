# SPDX-License-Identifier: Apache-2.0
"""Training: data, network, losses, the run, and export to ONNX. The only part of the project that needs PyTorch."""
