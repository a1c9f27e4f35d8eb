"""One Gaussian that is fitted to another one: the loss, its derivatives and their consequences.

The target is A exp(−|x|² / 2τ²), the model a exp(−|x − d|² / 2σ²), both isotropic in n dimensions,
without a normalising factor. The loss is L = ½ ∫ (model − target)² dx. docs/learn/initialisation.md
derives the formulas. Lengths have the unit of τ. Arguments are floats or float64 tensors of
shapes that can be broadcast; so are the results.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

Number = Tensor | float


def _tensor(value: Number) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def overlap(d: Number, sigma: Number, tau: Number, n: int = 1) -> Tensor:
    """∫ exp(−|x − d|² / 2σ²) exp(−|x|² / 2τ²) dx; d is a distance."""
    d, sigma, tau = map(_tensor, (d, sigma, tau))
    rho2 = sigma**2 + tau**2
    return (2 * math.pi * sigma**2 * tau**2 / rho2) ** (n / 2) * torch.exp(-(d**2) / (2 * rho2))


def loss(
    d: Number, sigma: Number, tau: Number, a: Number = 1.0, A: Number = 1.0, n: int = 1
) -> Tensor:
    """L. It is 0 if and only if d = 0, σ = τ and a = A (for positive a and A)."""
    a, A = _tensor(a), _tensor(A)
    energies = a**2 * overlap(0.0, sigma, sigma, n) + A**2 * overlap(0.0, tau, tau, n)
    return energies / 2 - a * A * overlap(d, sigma, tau, n)


def position_gradient(
    d: Number, sigma: Number, tau: Number, a: Number = 1.0, A: Number = 1.0, n: int = 1
) -> Tensor:
    """∂L/∂d. It has its maximum at d = ρ = √(σ² + τ²), and is proportional to d exp(−d² / 2ρ²)."""
    d, sigma, tau, a, A = map(_tensor, (d, sigma, tau, a, A))
    return a * A * d / (sigma**2 + tau**2) * overlap(d, sigma, tau, n)


def log_scale_gradient(
    d: Number, sigma: Number, tau: Number, a: Number = 1.0, A: Number = 1.0, n: int = 1
) -> Tensor:
    """∂L/∂ln σ. The Gaussian becomes wider in a step of gradient descent if this is negative."""
    d, sigma, tau, a, A = map(_tensor, (d, sigma, tau, a, A))
    rho2 = sigma**2 + tau**2
    growth = n * tau**2 / rho2 + (d * sigma / rho2) ** 2  # ∂ ln(overlap) / ∂ ln σ
    own = n / 2 * a**2 * overlap(0.0, sigma, sigma, n)
    return own - a * A * overlap(d, sigma, tau, n) * growth


def best_amplitude(d: Number, sigma: Number, tau: Number, A: Number = 1.0, n: int = 1) -> Tensor:
    """The a that minimises L for given d and σ."""
    return _tensor(A) * overlap(d, sigma, tau, n) / overlap(0.0, sigma, sigma, n)


def reduced_loss(d: Number, sigma: Number, tau: Number, A: Number = 1.0, n: int = 1) -> Tensor:
    """L with the best amplitude: ½A²‖target‖² (1 − (2στ/ρ²)ⁿ exp(−d²/ρ²))."""
    d, sigma, tau, A = map(_tensor, (d, sigma, tau, A))
    rho2 = sigma**2 + tau**2
    explained = (2 * sigma * tau / rho2) ** n * torch.exp(-(d**2) / rho2)
    return A**2 / 2 * overlap(0.0, tau, tau, n) * (1 - explained)


def best_width(d: Number, tau: Number, n: int = 1) -> Tensor:
    """The σ that minimises `reduced_loss` for a given d: about d √(2/n) if d is large."""
    d, tau = _tensor(d), _tensor(tau)
    delta = d**2 / (n * tau**2)
    return tau * (delta + (delta**2 + 1).sqrt()).sqrt()


def hessian(sigma: float, a: float = 1.0) -> Tensor:
    """(3, 3): the Hessian of L at the optimum for n = 1, in the order d, ln σ, a."""
    energy = math.sqrt(math.pi) * sigma  # ∫ exp(−x²/σ²) dx
    matrix = [
        [a**2 / (2 * sigma**2), 0.0, 0.0],
        [0.0, 0.75 * a**2, 0.5 * a],
        [0.0, 0.5 * a, 1.0],
    ]
    return energy * _tensor(matrix)  # type: ignore[arg-type]


def exponential_integral(x: float) -> float:
    """Ei(x) = γ + ln x + Σ xᵏ / (k k!), for 0 < x < 300."""
    total, term, k = 0.5772156649015329 + math.log(x), 1.0, 0
    while k < x or term > 1e-17 * abs(total):
        k += 1
        term *= x / k
        total += term / k
    return total


def travel_time(
    start: float, end: float, sigma: float, tau: float, a: float = 1.0, A: float = 1.0
) -> float:
    """The time of gradient flow, d' = −∂L/∂d for n = 1, from d = start to d = end < start.

    Gradient descent with a small rate η needs about this time divided by η as its number of steps.
    """
    rho2 = sigma**2 + tau**2
    pull = a * A * math.sqrt(2 * math.pi) * sigma * tau / rho2**1.5
    far, near = (exponential_integral(d**2 / (2 * rho2)) for d in (start, end))
    return (far - near) / (2 * pull)


def reach(time: float, sigma: float, tau: float, a: float = 1.0, A: float = 1.0) -> float:
    """The distance from which gradient flow arrives at d = ρ/10 in the given time."""
    rho = math.hypot(sigma, tau)
    return _largest(lambda d: travel_time(d, rho / 10, sigma, tau, a, A) < time, rho / 10, 20 * rho)


def visible_distance(
    gradient: float, sigma: float, tau: float, a: float = 1.0, A: float = 1.0
) -> float:
    """The largest distance at which |∂L/∂d| is at least `gradient` (n = 1)."""
    rho = math.hypot(sigma, tau)
    return _largest(
        lambda d: float(position_gradient(d, sigma, tau, a, A)) >= gradient, rho, 50 * rho
    )


def _largest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """The largest d between low and high for which a condition holds, by bisection."""
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def split_curvature(h: float, sigma: float, tau: float, a: float, A: float = 1.0) -> float:
    """The curvature d²L/de² at e = 0, if the model is divided into halves at ±e (n = 1).

    The targets are at ±h, each half has the amplitude a/2. The curvature is a ∫ (model − target)
    G'' dx with G = exp(−x²/2σ²). If it is negative, the halves move apart.
    """
    rho2 = sigma**2 + tau**2
    own = -a * math.sqrt(math.pi) / (2 * sigma)
    each = float(overlap(h, sigma, tau)) * (h**2 / rho2 - 1) / rho2
    return a * (own - 2 * A * each)


def escape_time(
    well: float, barrier: float, curvature_well: float, curvature_barrier: float, noise: float
) -> float:
    """Kramers' mean time of an escape over one barrier by d' = −L'(d) + √(2 · noise) · white noise.

    Args:
        well, barrier: L at the minimum and at the maximum.
        curvature_well, curvature_barrier: L'' there; the second one is negative.
        noise: the temperature. The formula holds if it is much smaller than barrier − well.
    """
    prefactor = 2 * math.pi / math.sqrt(curvature_well * -curvature_barrier)
    return prefactor * math.exp((barrier - well) / noise)
