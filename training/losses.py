# SPDX-License-Identifier: Apache-2.0
"""Losses between an output and a reference of the same shape, both in network values, mean over all elements."""

from __future__ import annotations

import torch
from torch import Tensor

from training.pyramid import linear

#: The paper's robust factor. It was chosen for linear values clipped at 100; we apply it to the network values of
#: :mod:`oiio_msspl.transforms`, where 0.1 is an error of about half a stop at mid-grey.
BETA = 0.1

#: RelMSE's own floor, in exposed radiance, and the relative squared error that counts half.
RELATIVE_FLOOR, RELATIVE_LARGE = 0.01, 8.0


def robust(output: Tensor, reference: Tensor, beta: float = BETA) -> Tensor:
    """The paper's ``l_r = mean(|e| / (beta + |e|))``: ``|e| / beta`` for small errors, never above 1 for large ones.

    Its gradient ``beta / (beta + |e|)^2`` is largest at zero error, ``1 / beta``.
    """
    error = (output - reference).abs()
    return (error / (beta + error)).mean()


def l1(output: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute error."""
    return (output - reference).abs().mean()


def display(output: Tensor, reference: Tensor) -> Tensor:
    """Mean squared error of the sRGB pictures, as PSNR has it, and some :func:`l1` for highlights beyond white.

    Where a few samples leave a pixel open, l1 asks for the median of what it may be and the squared error for its mean:
    the one is darker and hides noise, the other is what PSNR and RelMSE score. The weights make the two parts about
    equal where training begins.
    """
    squared = (srgb(linear(output)) - srgb(linear(reference))).square().mean()
    return 10.0 * squared + 0.3 * l1(output, reference)


def relative(output: Tensor, reference: Tensor) -> Tensor:
    """:func:`display`, and the squared error relative to the reference, as RelMSE with (0.5, 0.01) has it.

    That is what light where there is none costs: a firefly believed. The largest count less than in RelMSE, or the few
    that nothing could have told would be all that a batch has to say.
    """
    light = linear(reference)
    squared = (linear(output) - light).square() / (light.square() + RELATIVE_FLOOR)
    return display(output, reference) + 0.5 * (squared / (1 + squared / RELATIVE_LARGE)).mean()


def of_error(log_error: Tensor, output: Tensor, reference: Tensor) -> Tensor:
    """Of a prediction (N, 1, H, W) of the logarithm of the absolute error, mean of the channels: the negative
    log-likelihood of errors that are distributed exponentially, which is least where the prediction is their mean."""
    error = (output - reference).abs().mean(dim=1, keepdim=True)
    return (error * torch.exp(-log_error) + log_error).mean()


def srgb(exposed: Tensor) -> Tensor:
    """Exposed radiance to sRGB values in [0, 1]."""
    exposed = exposed.clamp(0.0, 1.0)
    return torch.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)


LOSSES = {"robust": robust, "l1": l1, "display": display, "relative": relative}
