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
