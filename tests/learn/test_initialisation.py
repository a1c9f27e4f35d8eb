"""The formulas of docs/learn/initialisation.md, its study, and experiments/basins."""

from __future__ import annotations

import importlib
import json
import math
import re
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]

# Pairs (d, σ) in units of τ; the amplitudes of the model and the target differ.
STARTS = [(0.0, 1.0), (0.7, 0.5), (1.5, 1.0), (2.5, 3.0), (5.0, 1.4)]
a, A, TAU = 0.7, 1.3, 1.2


@pytest.fixture(scope="module")
def experiment():
    """A function that imports a module of the experiment."""
    folder = ROOT / "experiments" / "basins"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield importlib.import_module
    for file in folder.glob("*.py"):
        sys.modules.pop(file.stem, None)


@pytest.fixture(scope="module")
def closed_form(experiment):
    return experiment("closed_form")


def grid(n: int) -> tuple[torch.Tensor, float]:
    """Points (P, n) of a regular grid, and the volume of a cell. Sums over it are integrals.

    For smooth functions that vanish at the border, the error of the sum is exponentially small.
    """
    spacing = 0.25 if n == 3 else 0.1
    axis = torch.arange(-20, 20, spacing, dtype=torch.float64)
    if n == 3:
        axis = axis[axis.abs() < 12]
    return torch.cartesian_prod(*[axis] * n).reshape(-1, n), spacing**n


def gaussian(x: torch.Tensor, mean: float | torch.Tensor, sigma: float) -> torch.Tensor:
    """exp(−|x − mean|² / 2σ²); the mean is on the first axis."""
    return torch.exp(-((x[:, 0] - mean) ** 2 + (x[:, 1:] ** 2).sum(1)) / (2 * sigma**2))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_overlap_and_loss_are_the_integrals(closed_form, n):
    x, volume = grid(n)
    for d, sigma in [(0.0, 1.0), (1.5, 0.8), (2.5, 1.6)]:
        model, target = gaussian(x, d, sigma), gaussian(x, 0.0, TAU)
        product = float((model * target).sum()) * volume
        assert float(closed_form.overlap(d, sigma, TAU, n)) == pytest.approx(product, rel=1e-9)
        expected = 0.5 * float((a * model - A * target).square().sum()) * volume
        assert float(closed_form.loss(d, sigma, TAU, a, A, n)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize(("d", "sigma"), STARTS)
def test_gradients_are_the_derivatives_of_the_loss(closed_form, n, d, sigma):
    place = torch.tensor(d, dtype=torch.float64, requires_grad=True)
    log_scale = torch.tensor(math.log(sigma), dtype=torch.float64, requires_grad=True)
    amplitude = torch.tensor(a, dtype=torch.float64, requires_grad=True)
    loss = closed_form.loss(place, log_scale.exp(), TAU, amplitude, A, n)
    by_d, by_scale, by_a = torch.autograd.grad(loss, (place, log_scale, amplitude))
    assert torch.allclose(by_d, closed_form.position_gradient(d, sigma, TAU, a, A, n))
    assert torch.allclose(by_scale, closed_form.log_scale_gradient(d, sigma, TAU, a, A, n))
    energy = closed_form.overlap(0.0, sigma, sigma, n)
    assert torch.allclose(by_a, (a - closed_form.best_amplitude(d, sigma, TAU, A, n)) * energy)


def test_the_pull_is_largest_at_rho_and_decays_as_a_gaussian(closed_form):
    rho = math.hypot(0.8, TAU)
    d = torch.linspace(0.01, 8, 80_000, dtype=torch.float64) * rho
    pull = closed_form.position_gradient(d, 0.8, TAU, a, A)
    assert float(d[pull.argmax()]) == pytest.approx(rho, rel=1e-3)
    # The table of the page: k exp((1 − k²) / 2) at d = k ρ.
    largest = float(pull.max())
    for k, expected in ((2, 0.446), (3, 0.0549), (4, 0.00221), (5, 3.07e-5), (6, 1.51e-7)):
        here = float(closed_form.position_gradient(k * rho, 0.8, TAU, a, A))
        assert here / largest == pytest.approx(k * math.exp((1 - k * k) / 2), rel=1e-6)
        assert here / largest == pytest.approx(expected, rel=5e-3)


def test_the_residual_of_a_point_decays_with_the_width_of_the_model(closed_form):
    """For τ → 0, the gradient is that of exp(−d²/2σ²)."""
    d = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    pull = closed_form.position_gradient(d, 1.0, 1e-4)
    expected = d * torch.exp(-(d**2) / 2)
    assert torch.allclose(pull / pull[0], expected / expected[0], rtol=1e-6)


def test_hessian_and_the_largest_stable_rate(closed_form):
    sigma = 0.8

    def loss(p):
        return closed_form.loss(p[0], p[1].exp(), sigma, p[2], a)

    optimum = torch.tensor([0.0, math.log(sigma), a], dtype=torch.float64)
    H = torch.autograd.functional.hessian(loss, optimum)
    assert torch.allclose(H, closed_form.hessian(sigma, a), atol=1e-12)
    assert float(torch.linalg.eigvalsh(H).min()) > 0

    # The largest stable rate of the position alone is 4σ / (a² √π).
    limit = 4 * sigma / (a * a * math.sqrt(math.pi))
    assert limit == pytest.approx(2 / float(H[0, 0]))

    def descend(rate):
        d = torch.tensor(0.02, dtype=torch.float64)
        for _ in range(300):
            d = d - rate * closed_form.position_gradient(d, sigma, sigma, a, a)
        return abs(float(d))

    assert descend(0.98 * limit) < 1e-4
    assert descend(1.02 * limit) > 0.1


def test_travel_time_is_that_of_gradient_descent_with_a_small_rate(closed_form):
    sigma, rate = 0.8, 0.01
    rho = math.hypot(sigma, TAU)
    for start in (1.5 * rho, 2.5 * rho):
        d, steps = torch.tensor(start, dtype=torch.float64), 0
        while d > rho / 10:
            d = d - rate * closed_form.position_gradient(d, sigma, TAU, a, A)
            steps += 1
        expected = closed_form.travel_time(start, rho / 10, sigma, TAU, a, A) / rate
        assert steps == pytest.approx(expected, rel=0.01)
    time = closed_form.travel_time(3 * rho, rho / 10, sigma, TAU, a, A)
    assert closed_form.reach(time, sigma, TAU, a, A) == pytest.approx(3 * rho, rel=1e-6)


def test_visible_distance(closed_form):
    d = closed_form.visible_distance(1e-8, 0.8, TAU, a, A)
    assert d > math.hypot(0.8, TAU)
    assert float(closed_form.position_gradient(d, 0.8, TAU, a, A)) == pytest.approx(1e-8)


def test_the_exponential_integral(closed_form):
    """Against the integral of (exp(t) − 1) / t, by the midpoint rule."""
    for x in (0.005, 1.0, 18.0):
        t = (torch.arange(200_000, dtype=torch.float64) + 0.5) * (x / 200_000)
        integral = float((torch.expm1(t) / t).sum()) * x / 200_000
        expected = 0.5772156649015329 + math.log(x) + integral
        assert closed_form.exponential_integral(x) == pytest.approx(expected, rel=1e-7)


def test_wider_or_narrower(closed_form):
    """Equal widths and amplitudes: a Gaussian widens if d < 2.242 σ for n = 1, never for n ≥ 2."""
    k = 1.25643
    assert math.exp(k) == pytest.approx(1 + 2 * k, rel=1e-4)
    threshold = 2 * math.sqrt(k)
    assert threshold == pytest.approx(2.242, abs=1e-3)
    for n in (1, 2, 3):
        d = torch.linspace(0.01, 8, 800, dtype=torch.float64)
        wider = closed_form.log_scale_gradient(d, 1.0, 1.0, n=n) < 0
        assert torch.equal(wider, d < threshold if n == 1 else torch.zeros_like(wider))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_reduced_loss_and_best_width(closed_form, n):
    for d, sigma in STARTS:
        amplitude = closed_form.best_amplitude(d, sigma, TAU, A, n)
        full = closed_form.loss(d, sigma, TAU, amplitude, A, n)
        assert torch.allclose(full, closed_form.reduced_loss(d, sigma, TAU, A, n))
    widths = torch.linspace(0.1, 40, 400_000, dtype=torch.float64)
    for d in (0.5, 2.0, 9.0):
        found = widths[closed_form.reduced_loss(d, widths, TAU, A, n).argmin()]
        assert float(found) == pytest.approx(float(closed_form.best_width(d, TAU, n)), abs=2e-4)
    assert float(closed_form.best_width(100.0, 1.0, n)) == pytest.approx(
        100 * math.sqrt(2 / n), rel=1e-3
    )


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_width_with_the_largest_pull(closed_form, n):
    """A small target at the distance d pulls most if σ = d/√2, in any dimension."""
    widths = torch.linspace(0.5, 20, 200_000, dtype=torch.float64)
    pull = closed_form.position_gradient(6.0, widths, 1e-3, n=n)
    assert float(widths[pull.argmax()]) == pytest.approx(6 / math.sqrt(2), rel=1e-3)


def test_two_targets_have_a_minimum_in_the_middle_if_they_are_near(closed_form):
    sigma = 0.8
    rho = math.hypot(sigma, TAU)
    m = torch.linspace(-6, 6, 24_001, dtype=torch.float64)
    for h, minima in ((0.5 * rho, 1), (0.98 * rho, 1), (1.02 * rho, 2), (2 * rho, 2)):
        loss = -(closed_form.overlap(m - h, sigma, TAU) + closed_form.overlap(m + h, sigma, TAU))
        inner = (loss[1:-1] < loss[:-2]) & (loss[1:-1] < loss[2:])
        assert int(inner.sum()) == minima
        place = abs(float(m[1:-1][inner][0]))
        if minima == 1:
            assert place == pytest.approx(0, abs=1e-3)
        else:  # m = h tanh(h m / ρ²)
            assert place == pytest.approx(h * math.tanh(h * place / rho**2), abs=1e-3)


def test_split_curvature(closed_form):
    x, volume = grid(1)
    sigma = 0.8

    for h in (0.3, 1.0, 2.5):
        target = A * (gaussian(x, h, TAU) + gaussian(x, -h, TAU))

        def loss(e, target=target):
            model = a / 2 * (gaussian(x, e, sigma) + gaussian(x, -e, sigma))
            return 0.5 * (model - target).square().sum() * volume

        zero = torch.tensor(0.0, dtype=torch.float64)
        expected = float(torch.autograd.functional.hessian(loss, zero))
        found = closed_form.split_curvature(h, sigma, TAU, a, A)
        assert found == pytest.approx(expected, rel=1e-8)


def test_a_copy_with_the_same_parameters_never_separates():
    """Equal parameters have equal gradients, so gradient descent keeps them equal."""
    x, volume = grid(1)
    target = gaussian(x, 1.5, 0.5) + gaussian(x, -1.5, 0.5)
    p = torch.tensor([[0.3, 0.0, 0.5]] * 2, dtype=torch.float64)
    start = p.clone()
    for _ in range(50):
        q = p.clone().requires_grad_()
        model = sum(row[2] * gaussian(x, row[0], row[1].exp()) for row in q)
        loss = 0.5 * (model - target).square().sum() * volume
        p = p - 0.1 * torch.autograd.grad(loss, q)[0]
        assert torch.equal(p[0], p[1])
    assert not torch.allclose(p, start, atol=0.1)


def test_a_blurred_target_is_a_wider_and_lower_gaussian(closed_form):
    """Blur by s: the width is √(τ² + s²), the height τ/√(τ² + s²), and ρ² grows by s²."""
    x, volume = grid(1)
    s = 1.7
    kernel = gaussian(x, 0.0, s) / (math.sqrt(2 * math.pi) * s)
    wide = math.hypot(TAU, s)
    for at in (0.0, 1.0, 4.0):
        blurred = float((kernel * gaussian(x, at, TAU)).sum()) * volume
        assert blurred == pytest.approx(TAU / wide * math.exp(-(at**2) / (2 * wide**2)))
    d = torch.linspace(0.01, 12, 12_000, dtype=torch.float64)
    pull = closed_form.position_gradient(d, 0.8, wide, A=TAU / wide)
    expected = math.sqrt(0.8**2 + TAU**2 + s**2)
    assert float(d[pull.argmax()]) == pytest.approx(expected, abs=2e-3)


def test_the_exercises(closed_form):
    narrow, wide = (closed_form.position_gradient(4.0, s, 1e-6) for s in (1.0, 2.0))
    assert float(wide / narrow) == pytest.approx(101, abs=0.5)
    rho2 = 1 + 1 + 9.9**2
    assert math.sqrt(rho2) == pytest.approx(10, abs=0.01)
    end = math.sqrt(2 * 0.3725074)  # Ei(end²/2) = 0
    near, far = (closed_form.travel_time(k, end, math.sqrt(0.5), math.sqrt(0.5)) for k in (4, 5))
    assert far / near == pytest.approx(53.5, abs=0.05)
    assert math.exp(4.5) * 8 / 12.5 == pytest.approx(58, abs=0.5)


# The code of the experiment.


def test_the_losses_of_signals_are_the_integrals(experiment):
    """The loss of a sum of Gaussians without a grid; for mixtures and boxes, with blur."""
    targets = experiment("targets")
    x = torch.arange(-40, 60, 0.01, dtype=torch.float64)
    model = torch.tensor([[[1.0, 0.2, 0.8], [4.0, -0.4, -0.3]]], dtype=torch.float64)
    mixture = torch.tensor([[[0.0, 0.0, 1.0], [5.0, 0.3, 0.6]]], dtype=torch.float64)
    edges = torch.tensor([[1.0], [6.0]], dtype=torch.float64)
    signals = [targets.Mixture((0.0, 10.0), mixture), targets.Box((0.0, 10.0), *edges)]
    for signal in signals:
        value = signal.value(x)[0]
        error = targets.evaluate(model, x)[0] - value
        expected = float(error.square().sum() / value.square().sum())
        assert float(signal.relative_error(model)[0]) == pytest.approx(expected, rel=5e-3)
        places = signal.places()[:, 0]
        assert torch.allclose(
            signal.residual(model), signal.value(places) - targets.evaluate(model, places)
        )
        # With blur: only the product with the target changes.
        kernel = torch.exp(-(torch.arange(-8, 8, 0.01, dtype=torch.float64) ** 2) / (2 * 1.5**2))
        kernel /= kernel.sum()
        blurred = torch.nn.functional.conv1d(value[None, None], kernel[None, None], padding=800)
        blurred = blurred[0, 0, : len(x)]
        product = targets.evaluate(model, x)[0] * (value - blurred)
        difference = float(signal.loss(model, 1.5) - signal.loss(model, 0.0))
        assert difference == pytest.approx(float(product.sum()) * 0.01, abs=5e-3)


@pytest.mark.parametrize("optimizer", ["gradient descent", "momentum", "Adam"])
def test_fits_arrive_from_near_and_not_from_far(experiment, optimizer):
    fit, targets = experiment("fit"), experiment("targets")
    target = targets.Mixture((-9.0, 9.0), torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64))
    start = torch.tensor([[[1.5, 0.3, 0.6]], [[9.0, 0.3, 0.6]]], dtype=torch.float64)
    rate = {"gradient descent": 0.3, "momentum": 0.05, "Adam": 0.03}[optimizer]
    error = target.relative_error(fit.fit(start, target, fit.Options(optimizer, rate, steps=400)))
    assert float(error[0]) < 1e-3
    assert float(error[1]) > 0.5


@pytest.mark.slow
def test_the_studies_run_with_few_restarts(experiment):
    """Each study yields rows with the settings that the figures select."""
    studies = experiment("run").studies(restarts=2, steps=10, seeds=1)
    for name in ("two targets", "failures", "rules", "images"):
        rows = list(studies[name])
        published = results(name.replace(" ", "_"))
        assert [set(row) for row in rows] == [set(row) for row in published]
        settings = ("signal", "gaussians", "start_share", "rule", "image", "start", "h_over_rho")
        for key in settings:
            assert [row.get(key) for row in rows] == [row.get(key) for row in published]


# The numbers of the page.


def results(study: str, **values: object) -> list[dict]:
    path = ROOT / "experiments" / "basins" / "results.json"
    rows = [row for row in json.loads(path.read_text("utf-8")) if row["study"] == study]
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def page() -> str:
    """The text of the page, with single spaces."""
    text = (ROOT / "docs" / "learn" / "initialisation-study.md").read_text("utf-8")
    return re.sub(r"\s+", " ", text)


def percent(study: str, **values: object) -> str:
    (row,) = results(study, **values)
    return f"{100 * float(row['share']):.0f}%"


def test_the_tables_of_the_page():
    text = page()
    travel = {}
    for row in results("travel"):
        assert row["measured"] == pytest.approx(row["expected"], abs=0.04)
        travel[round(row["steps"] * row["rate"])] = row["expected"]
    reach = " | ".join(f"{travel[work]:.2f}" for work in (10, 100, 1000, 10_000))
    assert f"| reach, by the formula | {reach} |" in text
    for row in results("adam", dtype="float64"):
        noise = row["gradient_noise"]
        power = round(math.log10(noise or row["eps"]))
        name = rf"noise of \$10\^\{{{power}\}}\$" if noise else rf"epsilon = 10\^\{{{power}\}}\$"
        found = re.search(name + r"[^|]*\| ([\d.]+) \| ([\d.]+) \|", text)
        assert found is not None
        assert float(found[1]) == pytest.approx(row["gradient_equals_limit"], abs=0.051)
        assert float(found[2]) == pytest.approx(row["measured"], abs=0.051)
    escape = results("escape")
    for name, key in (("by Kramers' formula", "expected"), (", measured", "measured")):
        row = " | ".join(f"{round(r[key])}" for r in escape)
        assert re.search(rf"\| time,? ?{re.escape(name)} \| {re.escape(row)} \|", text)
    images = {(r["image"], r["start"], r["rule"]): r for r in results("images")}
    rules = ("none", "noise", "clone and split", "MCMC", "refill")
    for image, start in dict.fromkeys(key[:2] for key in images):
        cells = [images[image, start, rule] for rule in rules]
        row = " | ".join(f"{r['mean']:.1f} ± {r['deviation']:.1f}" for r in cells)
        assert f"| {image}, {start} | {row} |" in text


def test_the_probabilities_of_the_page():
    text = page()

    def rule(name: str, count: int, share: float = 1.0, signal: str = "mixture") -> str:
        where = {"signal": signal, "gaussians": count, "start_share": share}
        return percent("rules", rule=name, **where)

    refill, none = ([rule(name, n) for n in (6, 9, 12)] for name in ("refill", "none"))
    joined = [f"{a}, {b} and {c}" for a, b, c in (refill, none)]
    assert f"{joined[0]}, instead of {joined[1]} without density control" in text
    third = [rule(name, 12, 0.333) for name in ("refill", "MCMC", "clone and split", "none")]
    assert "only refill succeeds often ({}); MCMC has {}, clone and split {}, and".format(
        *third[:3]
    ) in text  # fmt: skip
    assert f"no density control {third[3]}." in text
    names = ("none", "MCMC", "clone and split", "refill")
    everywhere = [rule(name, 8, 1.0, "box") for name in names]
    assert (
        "is {} without density control, {} with MCMC, {} with clone and split and {} with refill"
    ).format(*everywhere) in text
    corner = [rule(name, 8, 0.333, "box") for name in names]
    assert "third of the line, it is {}, {}, {} and {}.".format(*corner) in text
    none, refill = (results("failures", rule=name)[0] for name in ("none", "refill"))
    assert f"still fails in {refill['failed']} of {refill['trials']} fits" in text
    assert refill["with_dead"] == 0
    assert f"In {refill['shared']} of them, one target" in text
    assert f"{none['failed']} fits fail, {none['with_dead']} of them with a dead" in text
    found = [percent("targets", k=k, gaussians=k) for k in (1, 4, 8)]
    assert (
        "{} of the fits succeed for one target, {} for four targets, and {} for eight".format(
            *found
        )
        in text
    )
    assert f"find eight targets in {percent('targets', k=8, gaussians=16)} of the fits" in text
    for optimizer in ("gradient descent", "Adam"):
        few, many = (percent("gaussians", optimizer=optimizer, gaussians=n) for n in (6, 18))
        assert re.search(rf"{optimizer} (improves )?from {few} to {many}", text)


def test_the_basins_of_the_page():
    """The statements about one Gaussian and about two targets."""

    def share(optimizer: str, distance: float, only_means: bool = False) -> float:
        more = {"optimizer": optimizer, "only_means": only_means, "distance": distance}
        (row,) = results("basin", n=1, **more)
        return float(row["share"])

    slow = ("gradient descent", "momentum")
    text = page()
    assert all(share("Adam", d / 2, True) == 1 for d in range(21))
    assert all(share(name, d / 2, True) == 1 for name in slow for d in range(10))
    worst, best = min(share(name, 3.0) for name in slow), max(share(name, 5.0) for name in slow)
    assert (
        f"succeed from 3 in at least {worst:.0%} of the fits, and from 5 in at most {best:.0%}"
    ) in text
    assert all(share("Adam", d / 2) == 1 for d in range(9))
    assert f"Adam in all fits from 4 and in {share('Adam', 5.0):.0%} from 5" in text
    near = [
        row["share"] for name in slow
        for row in results("basin", n=3, optimizer=name, only_means=False) if row["distance"] < 2.5
    ]  # fmt: skip
    assert f"fail in up to {1 - min(near):.0%} of the fits from distances of less than" in text
    for row in results("two_targets"):
        assert row["share"] == (1.0 if row["h_over_rho"] < 1 else 0.0)
    counts = {row["distance"]: row["successes"] for row in results("cutoff")}
    assert [counts[d] for d in (1, 6, 6.5, 7, 8)] == [8, 8, 6, 1, 0]
