"""Figures of the page "Gradients"."""

import numpy as np
import torch
from drawing import Drawing

from snowsplat import Gaussians
from snowsplat.ops import View, reference


def chain() -> None:
    panel = Drawing(340, 430, x=(0, 10), y=(12.2, 0), margins=(4, 4, 4, 4))

    def box(x: float, y: float, words: str, width: float = 2.6, colour: str = "soft") -> None:
        panel.rectangle(
            (x - width / 2, y - 0.42),
            (x + width / 2, y + 0.42),
            colour,
            fill=colour,
            fill_opacity=0.12,
            width=1.4,
        )
        panel.text((x, y), words, dy=5, size=13)

    def link(x0: float, y0: float, x1: float, y1: float) -> None:
        panel.arrow((x0, y0 + 0.46), (x1, y1 - 0.5), "soft", 1.4)

    box(1.4, 0.8, "quats q", colour="blue")
    box(4.4, 0.8, "log scales ℓ", colour="blue")
    box(7.0, 0.8, "means μ", 2.0, colour="blue")
    box(9.0, 0.8, "SH h", 1.6, colour="blue")
    box(2.9, 2.6, "M = R S")
    box(6.0, 2.6, "p = Wμ + t")
    box(8.8, 2.6, "v", 1.2)
    box(4.4, 4.3, "U = J W M", 2.8)
    box(4.4, 5.9, "Σ′ = U Uᵀ + 0.3 I", 3.8)
    box(4.4, 7.5, "K = Σ′⁻¹", 2.6)
    box(7.5, 7.2, "m = π(p)", 2.1)
    box(1.3, 7.5, "o", 1.4, colour="blue")
    box(9.0, 8.4, "c", 1.2)
    box(4.4, 9.2, "α = o exp(−½ dᵀ K d)", 5.0)
    box(6.4, 10.8, "C = Σ T α c   →   loss L", 5.4, colour="orange")
    for a in (
        (1.4, 0.8, 2.5, 2.6),
        (4.4, 0.8, 3.3, 2.6),
        (7.0, 0.8, 6.2, 2.6),
        (7.2, 0.8, 8.6, 2.6),
        (2.9, 2.6, 4.0, 4.3),
        (5.6, 2.6, 4.8, 4.3),
        (4.4, 4.3, 4.4, 5.9),
        (4.4, 5.9, 4.4, 7.5),
        (6.4, 2.6, 7.4, 7.2),
        (4.4, 7.5, 4.4, 9.2),
        (7.5, 7.2, 6.0, 9.2),
        (1.3, 7.5, 3.2, 9.2),
        (8.8, 2.6, 8.9, 8.4),
        (9.5, 0.8, 9.4, 8.4),
        (4.4, 9.2, 5.6, 10.8),
        (9.0, 8.4, 7.6, 10.8),
    ):
        link(*a)
    panel.save("gradients-chain", "Boxes of the intermediate results, connected by arrows")


def scene(dtype: torch.dtype) -> tuple[dict[str, torch.Tensor], View]:
    random = torch.Generator().manual_seed(3)
    n = 6

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    means = normal(n, 3) * 0.4 + torch.tensor([0.0, 0.0, 4.0])
    parameters = {
        "means": means,
        "log_scales": normal(n, 3) * 0.3 - 1.0,
        "quats": normal(n, 4),
        "opacity_logits": normal(n),
        "sh_dc": normal(n, 1, 3),
        "sh_rest": normal(n, 3, 3) * 0.2,
    }
    view = View(torch.eye(3, 4), 24, 20, 26.0, 26.0, 12.0, 10.0, sh_degree=1)
    return {k: v.to(dtype) for k, v in parameters.items()}, view


def images(parameters: dict[str, torch.Tensor], view: View) -> tuple[torch.Tensor, torch.Tensor]:
    """The image of the small scene, and the number of blended splats per pixel."""
    splats = reference.project(Gaussians(**parameters), view)
    image = reference.rasterize(splats, view.width, view.height)[0]
    return image, reference.count_blended(splats, view.width, view.height)


def differences() -> None:
    panel = Drawing(340, 250, x=(-10, -0.5), y=(-11, 1), margins=(44, 26, 10, 40))
    panel.axes(
        "step h",
        "relative difference",
        x_ticks=[(e, f"1e{e}") for e in (-10, -8, -6, -4, -2)],
        y_ticks=[(e, f"1e{e}" if e else "1") for e in (-9, -6, -3, 0)],
    )
    for dtype, colour, words in (
        (torch.float64, "blue", "double"),
        (torch.float32, "orange", "single"),
    ):
        parameters, view = scene(dtype)
        target = torch.linspace(0, 1, 20 * 24 * 3, dtype=dtype).reshape(20, 24, 3)
        means = parameters["means"].clone().requires_grad_()
        loss = (images({**parameters, "means": means}, view)[0] - target).square().sum()
        (grad,) = torch.autograd.grad(loss, means)
        found = []
        for h in 10.0 ** np.arange(-10, -0.4, 0.25):
            values, counts = [], []
            for sign in (1, -1):
                moved = parameters["means"].clone()
                moved[2, 0] += sign * h
                image, count = images({**parameters, "means": moved}, view)
                values.append(float((image - target).square().sum()))
                counts.append(count)
            if dtype == torch.float64 and 1e-3 < h < 0.02:
                pixels = int((counts[0] != counts[1]).sum())
                print(f"h = {h:.4f}: the splats with α ≥ 1/255 differ at {pixels} pixels")
            estimate = (values[0] - values[1]) / (2 * h)
            error = abs(estimate / float(grad[2, 0]) - 1)
            found.append((np.log10(h), np.log10(max(error, 1e-12))))
        panel.line([p for p in found if p[1] < 0.9], colour, 2)
        print(words, "smallest difference:", min(found, key=lambda p: p[1]))
        y = 14 if colour == "blue" else 32
        panel.text((-7, 1), words, colour, anchor="end", dx=-4, dy=y + 16)
    panel.save("gradients-differences", "Two V-shaped curves of the error over the step size")


def across_an_edge() -> None:
    """The gradients of both parts of the loss, at the pixels of a line across a blurred edge."""
    x = torch.arange(48) - 23.5
    photo = 0.2 + 0.6 * (x > 0).double()
    image = (0.2 + 0.6 * torch.sigmoid(x / 2.5).double()).expand(48, 48).clone().requires_grad_()
    pixels, target = image[..., None].expand(48, 48, 3), photo.expand(48, 48)[..., None]
    target = target.expand(48, 48, 3)
    ssim = reference.photometric_loss(pixels, target, 1.0)
    (of_ssim,) = torch.autograd.grad(ssim, image)
    of_ssim = of_ssim[24] / of_ssim.abs().max()
    of_l1 = torch.sign(image.detach()[24] - photo)
    panel = Drawing(340, 220, x=(-12, 12), y=(-1.2, 1.2), margins=(44, 26, 10, 40))
    panel.axes("pixel", "gradient", counts=(5, 5))
    panel.line([(-12, -0.6), (0, -0.6), (0, 0.6), (12, 0.6)], "soft", 5, opacity=0.4)
    for values, colour, words, dy in ((of_l1, "blue", "L1", 14), (of_ssim, "orange", "SSIM", 32)):
        inside = [(a, b) for a, b in zip(x.tolist(), values.tolist(), strict=True) if abs(a) < 12]
        panel.line(inside, colour, 2)
        panel.text((12, 1.2), words, colour, anchor="end", dx=-4, dy=dy)
    panel.save("gradients-edge", "Two curves of a gradient across an edge")


def filter_factor() -> None:
    """√(det UUᵀ / det Σ′) of a round splat, and its derivative by ln σ."""
    panel = Drawing(340, 220, x=(0, 3), y=(0, 1.1), margins=(44, 26, 10, 40))
    panel.axes("σ in pixels", "o′ / o", counts=(4, 5))
    sigma = torch.linspace(0.01, 3, 120, dtype=torch.float64, requires_grad=True)
    factor = sigma**2 / (sigma**2 + 0.3)
    (slope,) = torch.autograd.grad(factor.sum(), sigma)
    for values, colour, words, dy in (
        (factor, "blue", "factor", 40),
        (slope * sigma, "orange", "derivative by ln σ", 120),
    ):
        points = torch.stack([sigma, values], 1).tolist()
        panel.line(points, colour, 2)
        panel.text((3, 1.1), words, colour, anchor="end", dx=-4, dy=dy)
    panel.save("gradients-filter", "A curve that rises to 1, and its derivative, a bump")


def without_length() -> None:
    """The gradient of a quaternion has no part along it: lines of equal loss are rays."""
    panel = Drawing(340, 220, x=(-1.6, 1.6), y=(-0.35, 1.75), equal=True, margins=(4, 4, 4, 4))
    circle = np.linspace(-0.1, np.pi + 0.1, 60)
    panel.line(np.stack([np.cos(circle), np.sin(circle)], 1), "line", 2)
    for angle in np.radians(range(10, 171, 20)):
        ray = np.array([np.cos(angle), np.sin(angle)])
        panel.line([0 * ray, 1.6 * ray], "line", 1, dash="4 4")
    q, g = 1.3 * np.array([np.cos(0.9), np.sin(0.9)]), np.array([-0.15, 0.7])
    tangent = (g - (g @ q) / (q @ q) * q) / np.linalg.norm(q)
    panel.arrow((0, 0), q, "ink")
    panel.arrow(q, q + g, "soft")
    panel.arrow(q, q + tangent, "orange", 2.4)
    panel.text(q, "q", anchor="start", dx=6, dy=12)
    panel.text(q + g, "∂L/∂q̂", "soft", anchor="start", dx=8, dy=12)
    panel.text(q + tangent, "∂L/∂q", "orange", anchor="end", dx=-6)
    panel.save("gradients-quaternion", "A vector, its gradient, and the part of it across")


def motion_of_pixels() -> None:
    """How pixels move if the camera turns, and if it moves ahead."""
    for name, words, move in (
        ("turn", "turn about y", lambda p: np.cross([0, 1, 0], p)),
        ("ahead", "move ahead", lambda p: np.array([0, 0, -1.0])),
    ):
        panel = Drawing(330, 220, x=(-1, 1), y=(0.66, -0.66), margins=(6, 26, 6, 6))
        panel.rectangle((-1, -0.66), (1, 0.66), "line")
        for x in np.linspace(-0.8, 0.8, 7):
            for y in np.linspace(-0.5, 0.5, 5):
                for depth, colour in ((1.5, "orange"), (4.0, "blue")):
                    p = depth * np.array([x, y, 1])
                    d = move(p)
                    shift = 0.13 * (d[:2] - p[:2] / p[2] * d[2]) / p[2]
                    shift = shift if name == "turn" else 3 * shift
                    panel.arrow((x, y), (x + shift[0], y + shift[1]), colour, 1.4)
        panel.title(words)
        panel.save(f"gradients-{name}", f"Arrows at the pixels: {words}")


def main() -> None:
    chain()
    across_an_edge()
    filter_factor()
    without_length()
    motion_of_pixels()
    differences()


if __name__ == "__main__":
    main()
