"""`add_noise`: the noise of MCMC density control."""

import torch

from snowsplat.ops.check import check_float, check_tensor, variant
from snowsplat.ops.gaussian_parameters import GaussianParameters
from snowsplat.ops.native import launch


@torch.no_grad()
def add_noise(
    gaussians: GaussianParameters,
    amount: float,
    *,
    sharpness: float,
    opacity: float,
    negligible: float,
    seed: int,
    first: int = 0,
) -> None:
    """Adds noise to the means, in place: μ += amount · σ(k (t − o)) · Σ η, with η ~ N(0, I).

    Σ = R S² Rᵀ is the covariance and o the opacity of a Gaussian (eq. 8 of Kheradmand et al. 2024).
    The logarithm of a variance, in S², is at most 40.

    Args:
        gaussians: their means are contiguous.
        amount: the factor of the noise, of any sign.
        sharpness, opacity: k and t.
        negligible: rows whose sigmoid is not larger are unchanged.
        seed: 0 to 2⁶³ − 1. The numbers η of a row depend on the seed and on ``first`` + row only.
        first: the number of the first row: with several processes, that among all rows.

    A row whose result would not be finite is unchanged. Each device rounds differently.

    Raises ValueError if shapes, dtypes or devices do not match.
    """
    op, means = "add_noise", gaussians.means
    check_float(op, "means", means)
    check_tensor(op, "means", means, (None, 3), means)
    shapes = {"log_scales": (len(means), 3), "quats": (len(means), 4)}
    tensors = {}
    for name, shape in {**shapes, "opacity_logits": (len(means),)}.items():
        tensor = getattr(gaussians, name)
        check_tensor(op, name, tensor, shape, means)
        tensors[name] = tensor.detach().contiguous()
    launch(
        variant("add_noise", means),
        n=len(means),
        means=means.detach(),
        **tensors,
        amount=float(amount),
        sharpness=float(sharpness),
        opacity=float(opacity),
        negligible=float(negligible),
        seed=seed,
        first=first,
    )
