"""Figures of the page "Spherical harmonics"."""

import numpy as np
import torch
from drawing import Drawing

import scene
from snowsplat import Camera, Gaussians
from snowsplat.ops import reference
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render
from snowsplat.scene.sh_constants import SH_C0

BLUE, ORANGE = torch.tensor([0.25, 0.50, 0.86]), torch.tensor([0.93, 0.50, 0.16])


def sphere(count: int) -> torch.Tensor:
    """(count, 3) evenly distributed unit vectors: a Fibonacci lattice."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * i / count, i * np.pi * (3 - 5**0.5)
    r = (1 - z * z).sqrt()
    return torch.stack([r * angle.cos(), r * angle.sin(), z], dim=1)


def balloon(k: int, size: int = 150) -> np.ndarray:
    """(size, size, 4) uint8: the surface |Y_k| as a set of small opaque Gaussians."""
    v = sphere(40_000).requires_grad_()
    values = reference.sh_basis(v, 3)[:, k]
    # The surface is the level set f = 0 of f(p) = |p| − |Y(p/|p|)|; its normal is ∇f.
    (slope,) = torch.autograd.grad(values.abs().sum(), v)
    v, values = v.detach(), values.detach()
    radius = values.abs()
    tangential = slope - (slope * v).sum(dim=1, keepdim=True) * v
    normal = v * radius[:, None] - tangential
    normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-9)
    light = torch.tensor([-0.45, -0.6, 0.66], dtype=torch.float64)
    shade = 0.55 + 0.5 * (normal @ light).clamp(min=0)
    rgb = torch.where(values[:, None] > 0, BLUE, ORANGE) * shade[:, None].float()
    n = len(v)
    spacing = (4 * np.pi / n) ** 0.5 * radius.clamp(min=0.02)
    gaussians = Gaussians(
        means=(v * radius[:, None]).float(),
        log_scales=(0.6 * spacing).log()[:, None].repeat(1, 3).float(),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 4.0),
        sh_dc=((rgb - 0.5) / SH_C0)[:, None],
        sh_rest=torch.zeros(n, 0, 3),
    )
    eye = torch.tensor([2.0, -7.0, 2.6], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    pose = look_at(eye, torch.zeros(3, dtype=torch.float64), up)
    focal = size * float(eye.norm()) / 1.62
    out = render(gaussians, Camera(size, size, focal, focal, size / 2, size / 2, pose))
    rgb = out.image / out.alpha.clamp(min=1e-6)[:, :, None]
    return scene.pixels(torch.cat([rgb, out.alpha[:, :, None]], dim=2))


def balloons() -> None:
    panel = Drawing(700, 400, x=(-4.15, 3.5), y=(-3.5, 0.5), margins=(2, 2, 2, 2))
    for degree in range(4):
        for m in range(-degree, degree + 1):
            k = degree * degree + degree + m
            panel.picture(balloon(k), (m - 0.5, -degree - 0.55), (m + 0.5, -degree + 0.45))
            panel.text((m, -degree), f"{k}", "soft", size=17, dx=-36, dy=-26)
    for degree in range(4):
        panel.text((-4.1, -degree), f"l = {degree}", size=18, anchor="start", dy=6)
    panel.save("sh-balloons", "Sixteen surfaces in four rows of 1, 3, 5 and 7")


def highlight(v: torch.Tensor, sharpness: float) -> torch.Tensor:
    """A colour with a highlight in direction (1, 0, 0): 0.25 + 0.65 exp(s (v·a − 1))."""
    return 0.25 + 0.65 * torch.exp(sharpness * (v[:, 0] - 1))


def fit(sharpness: float, degree: int) -> torch.Tensor:
    """The coefficients of the best approximation: integrals over the sphere."""
    v = sphere(20_000)
    basis = reference.sh_basis(v, degree)
    return (basis * (highlight(v, sharpness) - 0.5)[:, None]).mean(dim=0) * 4 * np.pi


def curves() -> None:
    panel = Drawing(330, 240, x=(-180, 180), y=(0, 1), margins=(38, 26, 10, 40))
    panel.axes(
        "angle from the highlight (°)",
        "colour",
        x_ticks=[(a, f"{a}") for a in (-180, -90, 0, 90, 180)],
    )
    a = torch.linspace(-np.pi, np.pi, 241, dtype=torch.float64)
    v = torch.stack([a.cos(), a.sin(), 0 * a], dim=1)
    degrees = np.degrees(a.numpy())
    panel.line(zip(degrees, highlight(v, 6).numpy(), strict=True), "soft", 5, opacity=0.45)
    for degree, colour in enumerate(("orange", "green", "violet", "blue")):
        values = 0.5 + reference.sh_basis(v, degree) @ fit(6, degree)
        panel.line(zip(degrees, values.numpy(), strict=True), colour, 2)
        panel.text((-180, 1), f"degree {degree}", colour, anchor="start", dx=8, dy=16 + 17 * degree)
    panel.save("sh-highlight", "A bell-shaped curve and four approximations of it")

    panel = Drawing(300, 240, x=(-0.3, 3.3), y=(0, 1.05), margins=(38, 26, 10, 40))
    panel.axes("degree", "error", x_ticks=[(d, str(d)) for d in range(4)])
    v = sphere(20_000)
    for sharpness, colour, words in ((3, "green", "wide highlight"), (25, "red", "narrow")):
        errors = []
        for degree in range(4):
            values = 0.5 + reference.sh_basis(v, degree) @ fit(sharpness, degree)
            errors.append(float((values - highlight(v, sharpness)).square().mean()))
        relative = [e / errors[0] for e in errors]
        print(words, [round(e, 3) for e in relative])
        panel.line(enumerate(relative), colour, 2.2)
        for degree, error in enumerate(relative):
            panel.dot((degree, error), colour, 3.6)
        panel.text((3.3, 1.05), words, colour, anchor="end", dy=18 if sharpness == 3 else 36)
    panel.save("sh-degrees", "Two falling curves of the error")


def real() -> None:
    view = scene.camera(452)
    full = render(scene.trained(), view).image
    constant = render(scene.trained(), view, sh_degree=0).image
    for name, words, image in (
        ("full", "degree 3", full),
        ("constant", "degree 0", constant),
        ("difference", "difference × 8", 8 * (full.clamp(0, 1) - constant.clamp(0, 1)).abs()),
    ):
        panel = Drawing(226, 192, margins=(0, 24, 0, 0))
        panel.title(words)
        panel.picture(scene.pixels(image), (0, 0), (1, 1), quality=75)
        panel.save(f"sh-{name}", f"The scene: {words}")


def main() -> None:
    balloons()
    curves()
    real()


if __name__ == "__main__":
    main()
