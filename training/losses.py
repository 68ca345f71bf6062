# SPDX-License-Identifier: Apache-2.0
"""Losses between an output and a reference of the same shape, both in network values, mean over all elements."""

from __future__ import annotations

from torch import Tensor

#: The paper's robust factor. It was chosen for linear values clipped at 100; we apply it to the network values of
#: :mod:`oiio_msspl.transforms`, where 0.1 is an error of about half a stop at mid-grey.
BETA = 0.1


def robust(output: Tensor, reference: Tensor, beta: float = BETA) -> Tensor:
    """The paper's ``l_r = mean(|e| / (beta + |e|))``: ``|e| / beta`` for small errors, never above 1 for large ones.

    Its gradient ``beta / (beta + |e|)^2`` is largest at zero error, ``1 / beta``.
    """
    error = (output - reference).abs()
    return (error / (beta + error)).mean()


def l1(output: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute error."""
    return (output - reference).abs().mean()


LOSSES = {"robust": robust, "l1": l1}
