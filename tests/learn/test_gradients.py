"""The formulas of docs/learn/gradients.md: each is compared with automatic differentiation."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat.ops import View, reference
from snowsplat.ops.splats import CONICS, DEPTHS, MEANS2D, OPACITIES, Splats2D

FX, FY = 40.0, 42.0


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def parameters(n: int) -> dict[str, Tensor]:
    values = {
        "means": normal(n, 3, seed=0) * 0.3 + torch.tensor([0.0, 0.0, 4.0]),
        "log_scales": normal(n, 3, seed=1) * 0.3 - 1.2,
        "quats": normal(n, 4, seed=2),
        "opacity_logits": normal(n, seed=3),
        "sh_dc": normal(n, 1, 3, seed=4) * 0.3,
        "sh_rest": normal(n, 8, 3, seed=5) * 0.1,
    }
    return {name: value.requires_grad_() for name, value in values.items()}


POSE = torch.eye(3, 4, dtype=torch.float64)
POSE[:, :3] = torch.linalg.qr(torch.eye(3).double() + 0.1 * normal(3, 3, seed=6))[0]
POSE[:, :3] *= torch.linalg.det(POSE[:, :3])
if POSE[2, 2] < 0:  # the camera looks in the direction of the Gaussians
    POSE[1:, :3] *= -1
POSE[:, 3] = torch.tensor([0.05, -0.1, 0.2])
VIEW = View(POSE, 24, 20, FX, FY, 12.0, 10.0, sh_degree=2)


def sym(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return torch.stack([torch.stack([a, b]), torch.stack([b, c])])


def test_image_to_splats():
    """Steps 2 and 3: the gradients of colour, mean, conic and opacity from sums over pixels."""
    splats = reference.project(SimpleNamespace(**parameters(5)), VIEW)
    packed = splats.packed.detach().requires_grad_()
    splats = Splats2D(packed, None, 3)
    w, h = VIEW.width, VIEW.height
    background = normal(3, seed=7).sigmoid()
    image, _, _ = reference.rasterize(splats, w, h, background)
    g = normal(h, w, 3, seed=8)
    (image * g).sum().backward()

    with torch.no_grad():
        order = splats.depths.argsort()
        pixels, g = reference._pixel_centres(0, 0, w, h).double(), g.reshape(-1, 3)
        K, o, c = splats.conics[order], splats.opacities[order], splats.colors[order]
        means = splats.means2d[order]
        alpha, T, T_end = reference._blend_weights(pixels, means, K, o)
        weights = T * alpha
        gc = g @ c.T  # (P, M)
        C = weights @ c + T_end * background
        S = (g * C).sum(dim=1)  # S₀: everything is behind
        for i in range(len(order)):
            row = packed.grad[order[i]]
            S = S - weights[:, i] * gc[:, i]
            q = weights[:, i] * gc[:, i] - alpha[:, i] * S / (1 - alpha[:, i])
            d = pixels - means[i]
            # B_i, the colour without this splat and those in front: α ∂C/∂α = w (c − B)
            later = weights[:, i + 1 :] @ c[i + 1 :] + T_end * background
            B = later / (T[:, i] * (1 - alpha[:, i]))[:, None]
            assert torch.allclose(q, weights[:, i] * (g * (c[i] - B)).sum(dim=1), atol=1e-10)
            matrix = sym(*K[i])
            assert torch.allclose(row[MEANS2D], matrix @ (q[:, None] * d).sum(dim=0), atol=1e-9)
            moments = torch.stack([-0.5 * d[:, 0] ** 2, -d[:, 0] * d[:, 1], -0.5 * d[:, 1] ** 2], 1)
            assert torch.allclose(row[CONICS], (q[:, None] * moments).sum(dim=0), atol=1e-9)
            assert torch.allclose(row[OPACITIES], q.sum() / o[i], atol=1e-9)
            assert torch.allclose(row[8:11], weights[:, i] @ g, atol=1e-9)


def gradient_of_rotation(q: Tensor, dR: Tensor) -> Tensor:
    """Step 6 for a unit quaternion: from R̄ to the gradient of (w, x, y, z)."""
    w, x, y, z = q.tolist()
    by = torch.tensor(
        [  # ∂R/∂w, ∂R/∂x, ∂R/∂y, ∂R/∂z, read off the matrix R(q)
            [[0, -2 * z, 2 * y], [2 * z, 0, -2 * x], [-2 * y, 2 * x, 0]],
            [[0, 2 * y, 2 * z], [2 * y, -4 * x, -2 * w], [2 * z, 2 * w, -4 * x]],
            [[-4 * y, 2 * x, 2 * w], [2 * x, 0, 2 * z], [-2 * w, 2 * z, -4 * y]],
            [[-4 * z, -2 * w, 2 * x], [2 * w, -4 * z, 2 * y], [2 * x, 2 * y, 0]],
        ],
        dtype=torch.float64,
    )
    return (by * dR).sum(dim=(1, 2))


def test_splats_to_parameters():
    """Steps 4 to 8, for one Gaussian at a time."""
    n = 4
    values = parameters(n)
    splats = reference.project(SimpleNamespace(**values), VIEW)
    assert len(splats) == n
    upstream = normal(*splats.packed.shape, seed=9)
    upstream[:, DEPTHS] = 0
    (splats.packed * upstream).sum().backward()

    W = POSE[:, :3]
    camera = -W.T @ POSE[:, 3]
    for i in range(n):
        one: dict[str, Any] = {name: value[i].detach() for name, value in values.items()}
        q_hat = one["quats"] / one["quats"].norm()
        s, p = one["log_scales"].exp(), W @ one["means"] + POSE[:, 3]
        x, y, z = p
        R = reference._rotation_matrices(one["quats"][None])[0]
        M = R * s
        J = torch.tensor([[FX / z, 0, -FX * x / z**2], [0, FY / z, -FY * y / z**2]]).double()
        T = J @ W
        U = T @ M
        K = sym(*splats.conics[i].detach())
        row = upstream[i]
        dm, (da, db, dc), do = row[MEANS2D], row[CONICS], row[OPACITIES]

        dSigma = -K @ sym(da, db / 2, dc) @ K  # 4
        dU = 2 * dSigma @ U  # 5
        dM, dT = T.T @ dU, dU @ M.T
        dJ = dT @ W.T
        assert torch.allclose(values["log_scales"].grad[i], (M * dM).sum(dim=0))  # 6
        dR = dM * s
        dq = gradient_of_rotation(q_hat, dR)
        w_only = 2 * (q_hat[1] * (dR[2, 1] - dR[1, 2]) + q_hat[2] * (dR[0, 2] - dR[2, 0])
                      + q_hat[3] * (dR[1, 0] - dR[0, 1]))  # fmt: skip
        assert dq[0] == pytest.approx(float(w_only))
        w_hat, xyz = q_hat[0], q_hat[1:]
        for k in range(3):  # x̄ of the page, and ȳ and z̄ by the cyclic replacement
            i1, i2, i3 = k, (k + 1) % 3, (k + 2) % 3
            by_page = 2 * (
                xyz[i2] * (dR[i1, i2] + dR[i2, i1])
                + xyz[i3] * (dR[i3, i1] + dR[i1, i3])
                + w_hat * (dR[i3, i2] - dR[i2, i3])
            ) - 4 * xyz[i1] * (dR[i2, i2] + dR[i3, i3])
            assert dq[1 + k] == pytest.approx(float(by_page))
        expected = (dq - (dq @ q_hat) * q_hat) / one["quats"].norm()
        assert torch.allclose(values["quats"].grad[i], expected)

        dp = J.T @ dm  # 7
        dp[0] += -FX / z**2 * dJ[0, 2]
        dp[1] += -FY / z**2 * dJ[1, 2]
        dp[2] += (-FX / z**2 * dJ[0, 0] - FY / z**2 * dJ[1, 1] + 2 * FX * x / z**3 * dJ[0, 2]
                  + 2 * FY * y / z**3 * dJ[1, 2])  # fmt: skip
        u = one["means"] - camera
        v = (u / u.norm()).requires_grad_()
        h = torch.cat([one["sh_dc"], one["sh_rest"]])
        basis = reference.sh_basis(v[None], 2)[0]
        color = 0.5 + basis.detach() @ h
        dcolor = torch.where(color > 0, row[8:11], 0)
        (dv,) = torch.autograd.grad((basis * (h @ dcolor)).sum(), v)
        v = v.detach()
        du = (dv - (dv @ v) * v) / u.norm()
        assert torch.allclose(values["means"].grad[i], W.T @ dp + du)

        o = one["opacity_logits"].sigmoid()  # 8
        assert values["opacity_logits"].grad[i] == pytest.approx(float(do * o * (1 - o)))
        basis = basis.detach()
        assert torch.allclose(values["sh_dc"].grad[i], basis[:1, None] * dcolor)
        assert torch.allclose(values["sh_rest"].grad[i], basis[1:, None] * dcolor)


def test_the_loss():
    """∂L/∂C of the L1 part: (1 − λ) sign(C − P) / n."""
    C, P = normal(6, 5, 3, seed=1).sigmoid().requires_grad_(), normal(6, 5, 3, seed=2).sigmoid()
    reference.photometric_loss(C, P, 0.0).backward()
    assert torch.allclose(C.grad, (C - P).sign() / C.numel())
    full = reference.photometric_loss(C, P, 0.2)
    expected = 0.8 * (C - P).abs().mean() + 0.2 * (1 - reference.ssim(C, P))
    assert full.item() == pytest.approx(expected.item())


def test_finite_differences():
    """The best central difference agrees to nine digits in double precision."""
    values = {name: value.detach() for name, value in parameters(4).items()}

    def loss(means: Tensor) -> Tensor:
        splats = reference.project(SimpleNamespace(**{**values, "means": means}), VIEW)
        return reference.rasterize(splats, 24, 20)[0].square().sum()

    x = values["means"].clone().requires_grad_()
    (grad,) = torch.autograd.grad(loss(x), x)
    errors = {}
    for h in (1e-10, 1e-5):
        step = torch.zeros_like(x)
        step[1, 0] = h
        estimate = float(loss(values["means"] + step) - loss(values["means"] - step)) / (2 * h)
        errors[h] = abs(estimate / float(grad[1, 0]) - 1)
    assert errors[1e-5] < 1e-8
    assert errors[1e-10] > 10 * errors[1e-5]


def test_the_gradient_of_ssim_is_three_blurs():
    """Step 1, with the blur as a matrix: the window is symmetric."""
    C, P = (normal(9, 8, 1, seed=seed).sigmoid() for seed in (1, 2))
    C.requires_grad_()
    (expected,) = torch.autograd.grad(reference.ssim(C, P) * C.numel(), C)

    def window(n: int) -> Tensor:
        d = torch.arange(n)[:, None] - torch.arange(n)
        whole = torch.exp(-((torch.arange(11).double() - 5) ** 2) / 4.5).sum()
        return torch.exp(-(d.double() ** 2) / 4.5) * (d.abs() <= 5) / whole

    def blur(X: Tensor) -> Tensor:
        return window(9) @ X @ window(8)

    C, P = C.detach()[:, :, 0], P[:, :, 0]
    mu_C, mu_P, k1, k2 = blur(C), blur(P), 0.01**2, 0.03**2
    A1, A2 = 2 * mu_C * mu_P + k1, 2 * (blur(C * P) - mu_C * mu_P) + k2
    B1, B2 = mu_C**2 + mu_P**2 + k1, blur(C * C) - mu_C**2 + blur(P * P) - mu_P**2 + k2
    S = A1 * A2 / (B1 * B2)
    a, b, c = S * (2 * mu_P / A1 - 2 * mu_C / B1), -S / B2, 2 * S / A2
    gradient = blur(a - 2 * mu_C * b - mu_P * c) + 2 * C * blur(b) + P * blur(c)
    assert torch.allclose(gradient, expected[:, :, 0])


def test_the_filter_of_antialiased_scenes():
    """Step 5: o' = o √(det UUᵀ / det Σ')."""
    U, o, upstream = normal(2, 3, seed=1).requires_grad_(), torch.tensor(0.7).double(), 1.3
    Sigma = U @ U.T + 0.3 * torch.eye(2)
    changed = o * (torch.linalg.det(U @ U.T) / torch.linalg.det(Sigma)).sqrt()
    (upstream * changed).backward()
    with torch.no_grad():
        bar = 0.5 * changed * upstream * ((U @ U.T).inverse() - Sigma.inverse())
        assert torch.allclose(U.grad, 2 * bar @ U)


def test_pose_and_focal_length():
    """Step 9, from the gradients of p, T, J and u that the steps before it give."""
    values = [p.detach() for p in parameters(4).values()]
    omega, tau = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    zoom = torch.ones((), dtype=torch.float64, requires_grad=True)
    x, y, z = omega
    zero = torch.zeros_like(x)
    turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    pose = POSE + turn @ POSE + torch.cat([torch.zeros(3, 3), tau[:, None]], dim=1)
    splats, _ = reference._project_rows(values, pose, VIEW, zoom)
    upstream = normal(*splats.packed.shape, seed=9)
    upstream[:, DEPTHS] = 0
    (splats.packed * upstream).sum().backward()

    W, t = POSE[:, :3], POSE[:, 3]
    by_tau, by_omega, by_focal = torch.zeros(3).double(), torch.zeros(3).double(), 0.0
    for i in range(4):
        mean, log_scales, quat, _, sh_dc, sh_rest = (value[i] for value in values)
        row = upstream[i]
        p = (W @ mean + t).requires_grad_()
        J = torch.zeros(2, 3).double()
        J[0, 0], J[0, 2] = FX / p[2], -FX * p[0] / p[2] ** 2
        J[1, 1], J[1, 2] = FY / p[2], -FY * p[1] / p[2] ** 2
        J.retain_grad()
        T = J @ W
        U = T @ (reference._rotation_matrices(quat[None])[0] * log_scales.exp())
        K = (U @ U.T + reference.LOW_PASS * torch.eye(2)).inverse()
        u = (mean + W.T @ t).requires_grad_()
        basis = reference.sh_basis((u / u.norm())[None], 2)[0]
        color = (0.5 + basis @ torch.cat([sh_dc, sh_rest])).clamp(min=0)
        m = torch.stack([FX * p[0] / p[2], FY * p[1] / p[2]])
        T.retain_grad()
        conic = torch.stack([K[0, 0], K[0, 1], K[1, 1]])
        loss = m @ row[MEANS2D] + conic @ row[CONICS] + color @ row[8:11]
        loss.backward()
        with torch.no_grad():
            A = J.T @ T.grad @ W.T
            axial = torch.stack([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])
            by_tau += p.grad + W @ u.grad
            by_omega += torch.linalg.cross(p, p.grad) + axial
            x, y, z = p
            for f, at, k in ((FX, x, 0), (FY, y, 1)):
                of_f = at / z * row[MEANS2D][k] + J.grad[k, k] / z - at / z**2 * J.grad[k, 2]
                by_focal += f * of_f  # both focal lengths are multiplied by the zoom
    assert torch.allclose(tau.grad, by_tau)
    assert torch.allclose(omega.grad, by_omega)
    assert zoom.grad == pytest.approx(float(by_focal))
