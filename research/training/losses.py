# SPDX-License-Identifier: Apache-2.0
"""Losses between an output and a reference of the same shape, both log-encoded, as a mean over all elements."""

from __future__ import annotations

import torch
from torch import Tensor

from research.training.encoding import log_decode, srgb

#: The paper's robust factor, chosen for linear values clipped at 100. In log-encoded radiance, 0.1 is an error of about
#: half a stop at mid-grey.
BETA = 0.1

#: RelMSE's floor in exposed radiance, and the relative squared error that :func:`relative` halves.
RELATIVE_FLOOR, RELATIVE_LARGE = 0.01, 8.0


def robust(output: Tensor, reference: Tensor, beta: float = BETA) -> Tensor:
    """Return the paper's ``l_r = mean(|e| / (beta + |e|))``: ``|e| / beta`` for small errors, never above 1.

    Its gradient ``beta / (beta + |e|)^2`` is largest at zero error, ``1 / beta``.
    """
    error = (output - reference).abs()
    return (error / (beta + error)).mean()


def l1(output: Tensor, reference: Tensor) -> Tensor:
    """Return the mean absolute error."""
    return (output - reference).abs().mean()


def display(output: Tensor, reference: Tensor) -> Tensor:
    """Return the mean squared error of the sRGB images, as in PSNR, plus :func:`l1` for highlights above white.

    If the samples leave a pixel uncertain, l1 is least at the median of its possible values, the squared error at their
    mean. The median is darker and hides noise; the mean is what PSNR and RelMSE score. The weights make both terms
    about equal at the start of training.
    """
    squared = (srgb(log_decode(output)) - srgb(log_decode(reference))).square().mean()
    return 10.0 * squared + 0.3 * l1(output, reference)


def relative(output: Tensor, reference: Tensor) -> Tensor:
    """Return :func:`display`, plus the squared error relative to the reference, as in RelMSE.

    The relative error penalises fireflies in dark regions. Large values are compressed, otherwise the few errors that
    no network could avoid would dominate a batch.
    """
    light = log_decode(reference)
    squared = (log_decode(output) - light).square() / (light.square() + RELATIVE_FLOOR)
    return display(output, reference) + 0.5 * (squared / (1 + squared / RELATIVE_LARGE)).mean()


def error_likelihood(log_error: Tensor, output: Tensor, reference: Tensor) -> Tensor:
    """Return the loss of a predicted logarithm of the absolute error, (N, 1, H, W), mean of the channels.

    It is the negative log-likelihood of exponentially distributed errors, which is least if the prediction is their
    mean.
    """
    error = (output - reference).abs().mean(dim=1, keepdim=True)
    return (error * torch.exp(-log_error) + log_error).mean()


LOSSES = {"robust": robust, "l1": l1, "display": display, "relative": relative}
