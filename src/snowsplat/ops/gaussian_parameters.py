"""The six tensors of Gaussians that the operations read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor

from snowsplat.ops.check import check_float, check_tensor
from snowsplat.ops.native import Struct

#: Their names, in the order of the native functions.
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


class GaussianParameters(Protocol):
    """N Gaussians, for example a `snowsplat.Gaussians`; all tensors are float32, or all float64."""

    means: Tensor  # (N, 3), in world units
    log_scales: Tensor  # (N, 3)
    quats: Tensor  # (N, 4) wxyz, not necessarily normalised; zero means no rotation
    opacity_logits: Tensor  # (N,)
    sh_dc: Tensor  # (N, 1, 3)
    sh_rest: Tensor  # (N, K, 3)


def checked_parameters(op: str, gaussians: GaussianParameters, sh_degree: int) -> dict[str, Tensor]:
    """The tensors by name.

    Raises ValueError unless they are the parameters of the same Gaussians, and `sh_rest` has the
    rows of the degree.
    """
    means = gaussians.means
    check_float(op, "means", means)
    n = means.shape[0] if means.dim() else None
    shapes = ((n, 3), (n, 3), (n, 4), (n,), (n, 1, 3), (n, None, 3))
    tensors = {name: getattr(gaussians, name) for name in PARAMETERS}
    for (name, tensor), shape in zip(tensors.items(), shapes, strict=True):
        check_tensor(op, name, tensor, shape, means)
    rows = tensors["sh_rest"].shape[1]
    if rows < (sh_degree + 1) ** 2 - 1:
        raise ValueError(f"{op}: sh_rest has too few rows ({rows}) for degree {sh_degree}")
    return tensors


def check_each(
    op: str, what: str, given: Mapping[str, Tensor], tensors: Mapping[str, Tensor]
) -> None:
    """Raises ValueError unless `given` has a tensor of the same shape for each of `tensors`."""
    missing = [name for name in tensors if name not in given]
    if missing:
        raise ValueError(f"{op}: {what} has no {', '.join(missing)}")
    for name, tensor in tensors.items():
        check_tensor(op, f"{what}[{name!r}]", given[name], tuple(tensor.shape), tensor)


def gaussian_tensors(tensors: Mapping[str, Tensor], sh_degree: int) -> Struct:
    """The parameters, contiguous, as a parameter of native functions."""
    contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    rows = {"sh_rest_rows": tensors["sh_rest"].shape[1], "sh_degree": sh_degree, "sh_dc_rows": 1}
    return contiguous | rows
