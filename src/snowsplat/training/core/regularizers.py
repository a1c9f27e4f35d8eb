"""`add_regularizers`: the terms of the loss that depend on the Gaussians only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from snowsplat.training.parts.part import Part

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run


def regularizing(parts: Sequence[Part]) -> list[Part]:
    """The parts that override `Part.regularizer`."""
    return [part for part in parts if type(part).regularizer is not Part.regularizer]


def add_regularizers(run: Run) -> None:
    """Add the gradients of `Part.regularizer` of all parts to ``.grad`` of the parameters.

    The optimiser adds ``.grad`` to the gradient of the photos, and clears it.
    """
    used = regularizing(run.parts)
    if not used:
        return
    leaves = run.gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    with torch.enable_grad():
        terms = [part.regularizer(run, leaves) for part in used]
        for term in terms:
            if term is not None and term.requires_grad:
                term.backward()
    leaf_of = leaves.parameters()
    for name, parameter in run.gaussians.parameters().items():
        gradient = leaf_of[name].grad
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
