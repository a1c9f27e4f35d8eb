"""Figures of the page "Blending"."""

from itertools import pairwise

import numpy as np
import torch
from drawing import Drawing

import scene
from snowsplat import ops
from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.render import project


def density(s: np.ndarray) -> np.ndarray:
    return 2.2 * np.exp(-0.5 * ((s - 2) / 0.35) ** 2) + 2.6 * np.exp(-0.5 * ((s - 4.2) / 0.3) ** 2)


def ray() -> None:
    s = np.linspace(0, 6, 601)
    tau = density(s)
    step = s[1] - s[0]
    T = np.exp(-np.concatenate([[0], np.cumsum((tau[1:] + tau[:-1]) / 2 * step)]))
    panel = Drawing(330, 240, x=(0, 6), y=(0, 2.8), margins=(32, 26, 8, 40))
    panel.axes("distance s", counts=(7, 4))
    panel.line(
        [(0, 0), *zip(s, tau, strict=True), (6, 0)], "soft", 1, fill="soft", fill_opacity=0.22
    )
    panel.line(zip(s, T, strict=True), "blue", 2.2)
    panel.line(zip(s, T * tau, strict=True), "orange", 2.2)
    for i, (words, colour) in enumerate(
        (("density τ", "soft"), ("transmittance T", "blue"), ("weight T τ", "orange"))
    ):
        panel.text((0, 2.8), words, colour, anchor="start", dx=8, dy=14 + 17 * i)
    panel.save("blending-density", "A density with two peaks, and the falling transmittance")

    edges = np.linspace(0, 6, 13)
    panel = Drawing(330, 240, x=(0, 6), y=(0, 1.05), margins=(32, 26, 8, 40))
    panel.axes("distance s", counts=(7, 5))
    before = 1.0
    for low, high in pairwise(edges):
        inside = np.linspace(low, high, 101)
        alpha = 1 - np.exp(-density(inside).mean() * (high - low))
        weight = before * alpha
        panel.rectangle((low + 0.05, 0), (high - 0.05, alpha), fill="line")
        panel.rectangle((low + 0.05, 0), (high - 0.05, weight), fill="orange")
        panel.line([(low, before), (high, before)], "blue", 2.4)
        before *= 1 - alpha
    for i, (words, colour) in enumerate(
        (("α of each layer", "soft"), ("transmittance T", "blue"), ("weight T α", "orange"))
    ):
        panel.text((6, 1.05), words, colour, anchor="end", dx=-2, dy=14 + 17 * i)
    panel.save("blending-weights", "Bars of the opacity and the weight of twelve layers")


def profile() -> None:
    k = np.linspace(-3.5, 3.5, 201)
    g = np.exp(-0.5 * k**2)
    panel = Drawing(320, 240, x=(-3.5, 3.5), y=(0, 1.05), margins=(38, 26, 8, 40))
    panel.axes("standard deviations from the centre", "α", counts=(7, 5))
    for o, colour in ((0.5, "green"), (0.9, "orange"), (0.99, "blue")):
        panel.line(zip(k, o * g, strict=True), colour, 2.2)
        panel.line(zip(k, 1 - np.exp(np.log(1 - o) * g), strict=True), colour, 1.6, dash="5 4")
    panel.save("blending-profile", "Bell curves, and flatter dashed curves of the same maximum")


def real() -> None:
    view = scene.camera(480)
    splats = project(scene.trained(), view)
    order = splats.depths.argsort(stable=True)
    for name, count, words in (
        ("step-1", 10_000, "the first 10,000 splats"),
        ("step-10", 60_000, "the first 60,000 splats"),
        ("step-all", len(order), f"all {len(order):,} splats"),
    ):
        rows = order[:count].sort().values
        part = Splats2D(splats.packed[rows], None, splats.channels)
        image, alpha, _ = ops.rasterize(part, view.width, view.height)
        panel = Drawing(300, 247, margins=(0, 24, 0, 0))
        panel.title(words.removeprefix("the "))
        panel.picture(scene.pixels(image), (0, 0), (1, 1), quality=75)
        panel.save(f"blending-{name}", f"The scene with {words}")
    counts = ops.count_blended(splats, view.width, view.height)
    print("blended splats per pixel:", float(counts.mean()), float(counts.max()))
    panel = Drawing(300, 247, margins=(0, 24, 0, 0))
    panel.title("blended splats")
    shade = (counts / 150).clamp(0, 1)[:, :, None].expand(-1, -1, 3)
    panel.picture(scene.pixels(shade), (0, 0), (1, 1), quality=75)
    panel.save("blending-count", "A grey image of the number of splats per pixel")

    x, y = 214.5, 96.5  # a pixel on the globe
    pixel = torch.tensor([[x, y]])
    means, conics, opacities = (v[order] for v in (splats.means2d, splats.conics, splats.opacities))
    near = ((means - pixel).norm(dim=1) < 200).nonzero()[:, 0]
    alpha, T, _ = reference._blend_weights(pixel, means[near], conics[near], opacities[near])
    blended = alpha[0] > 0
    weights, before = (alpha * T)[0, blended].numpy(), T[0, blended].numpy()
    n = len(weights)
    print(f"pixel {x, y}: {n} splats, the largest five have {np.sort(weights)[-5:].sum():.2f}")
    colors = splats.colors[order][near][blended].clamp(0, 1).numpy()
    panel = Drawing(330, 240, x=(0, n), y=(0, 1.05), margins=(38, 26, 8, 40))
    panel.axes("splats, front to back", counts=(5, 5))
    for i in range(n):
        panel.rectangle((i + 0.08, 0), (i + 0.92, weights[i]), "soft", rgb=colors[i], width=0.5)
    steps = [(i + d, before[i]) for i in range(n) for d in (0, 1)]
    panel.line(steps, "blue", 2)
    panel.text((n, 1.05), "transmittance", "blue", anchor="end", dx=-4, dy=16)
    panel.text((n, 1.05), "weight, in the colour of the splat", "soft", anchor="end", dx=-4, dy=34)
    panel.save("blending-order", "Bars of the weights of the splats of a pixel")


def main() -> None:
    ray()
    profile()
    real()


if __name__ == "__main__":
    main()
