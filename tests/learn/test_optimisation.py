"""The formulas of docs/learn/optimisation.md."""

import math
from types import SimpleNamespace

import pytest
import torch

from snowsplat import Gaussians, Points, TrainConfig, ops
from snowsplat.ops import reference
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule


def test_the_table_of_parameters():
    """Numbers of parameters, initial values and rates of the page."""
    random = torch.Generator().manual_seed(0)
    points = Points(
        torch.randn(20, 3, generator=random), torch.full((20, 3), 51, dtype=torch.uint8)
    )
    gaussians = Gaussians.from_points(points)
    sizes = {name: p[0].numel() for name, p in gaussians.parameters().items()}
    assert sizes == {
        "means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1, "sh_dc": 3, "sh_rest": 45,
    }  # fmt: skip
    assert sum(sizes.values()) == 59
    distances = reference.neighbours(points.xyz, 3)
    assert torch.allclose(gaussians.scales, distances.mean(dim=1, keepdim=True).expand(-1, 3))
    assert gaussians.quats[0].tolist() == [1, 0, 0, 0]
    assert torch.allclose(gaussians.opacities, torch.tensor(0.1))
    assert gaussians.opacity_logits[0].item() == pytest.approx(-2.197, abs=5e-4)
    assert torch.allclose(0.5 + reference.C0 * gaussians.sh_dc[:, 0], torch.tensor(51 / 255))
    assert not gaussians.sh_rest.any()
    rates = TrainConfig().learning_rates
    assert (rates.means, rates.means_final) == (1.6e-4, 1.6e-6)
    assert (rates.log_scales, rates.quats, rates.opacity_logits) == (5e-3, 1e-3, 0.05)
    assert (rates.sh_dc, rates.sh_rest) == (2.5e-3, 1.25e-4)


def test_adam():
    """One number over 10 steps: the formulas of the page, PyTorch, and the operation."""
    n, lr, beta1, beta2 = 1, 0.01, 0.9, 0.999
    random = torch.Generator().manual_seed(1)
    parameters = {
        "means": torch.tensor([[0.1, 0.2, 3.0]]),
        "log_scales": torch.full((n, 3), -1.5),
        "quats": torch.tensor([[1.0, 0.1, 0.2, 0.3]]),
        "opacity_logits": torch.zeros(n),
        "sh_dc": torch.zeros(n, 1, 3),
        "sh_rest": torch.zeros(n, 0, 3),
    }
    parameters = {name: p.double() for name, p in parameters.items()}
    m_all = {name: torch.zeros_like(p) for name, p in parameters.items()}
    v_all = {name: torch.zeros_like(p) for name, p in parameters.items()}
    rates = dict.fromkeys(parameters, lr)
    view = ops.View(torch.eye(3, 4), 16, 16, 16.0, 16.0, 8.0, 8.0)
    x = m = v = 0.0
    torch_x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([torch_x], lr=lr, eps=1e-15)
    for t in range(1, 11):
        g = float(torch.randn(1, generator=random))
        m = beta1 * m + (1 - beta1) * g
        v = beta2 * v + (1 - beta2) * g * g
        step = lr * (m / (1 - beta1**t)) / (math.sqrt(v / (1 - beta2**t)) + 1e-15)
        x -= step
        if t == 1:
            assert abs(step) == pytest.approx(lr)  # exercise 2
        torch_x.grad = torch.tensor([g], dtype=torch.float64)
        adam.step()
        # The gradient of the logit x through the opacity o is do · o (1 − o).
        o = parameters["opacity_logits"].sigmoid()
        packed = torch.zeros(1, 16, dtype=torch.float64)
        packed[:, 5] = g / (o * (1 - o))
        reference.adam_step(
            SimpleNamespace(**parameters),
            ops.Moments(m_all, v_all),
            ops.SplatGradient(torch.zeros(1, dtype=torch.int32), packed),
            view,
            ops.AdamRates(rates, t),
        )
        assert torch_x.item() == pytest.approx(x)
        assert float(parameters["opacity_logits"]) == pytest.approx(x)


def test_the_rate_of_the_positions():
    rates, schedule = LearningRates(means_steps=1.0), Schedule(1000)
    for step in (0, 250, 500, 1000):
        t = step / 1000
        expected = 3.0 * 1.6e-4 ** (1 - t) * 1.6e-6**t
        assert rates.at(step, schedule, 3.0)["means"] == pytest.approx(expected)
    assert rates.at(500, schedule, 1.0)["means"] == pytest.approx(1.6e-5)  # exercise 3


def test_the_degree_in_use():
    config = TrainConfig()
    for step in (0, 999, 1000, 2500, 3000, 30_000):
        assert config.sh_degree_at(step) == min(3, step // 1000)


def test_ssim_by_its_formula():
    """The mean over all windows of an 11 × 11 image, padded with zeros."""
    random = torch.Generator().manual_seed(2)
    a, b = (torch.rand(11, 11, generator=random, dtype=torch.float64) for _ in range(2))
    x = torch.arange(11, dtype=torch.float64) - 5
    w = torch.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * 1.5**2))
    w = w / w.sum()
    k1, k2 = 0.01**2, 0.03**2
    padded_a, padded_b = (torch.nn.functional.pad(image, (5, 5, 5, 5)) for image in (a, b))
    values = []
    for i in range(11):
        for j in range(11):
            pa, pb = padded_a[i : i + 11, j : j + 11], padded_b[i : i + 11, j : j + 11]
            mu_a, mu_b = (w * pa).sum(), (w * pb).sum()
            var_a, var_b = (w * pa * pa).sum() - mu_a**2, (w * pb * pb).sum() - mu_b**2
            covariance = (w * pa * pb).sum() - mu_a * mu_b
            upper = (2 * mu_a * mu_b + k1) * (2 * covariance + k2)
            values.append(upper / ((mu_a**2 + mu_b**2 + k1) * (var_a + var_b + k2)))
    found = reference.ssim(a[:, :, None], b[:, :, None])
    assert float(found) == pytest.approx(float(torch.stack(values).mean()))
    assert float(reference.ssim(a[:, :, None], a[:, :, None])) == pytest.approx(1)
