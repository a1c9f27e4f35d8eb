"""Figures of the pages "Density control" and "Optimisation"."""

import numpy as np
import torch
from drawing import Drawing
from training_run import STEPS, record, snapshot

import scene
from snowsplat.scene.render import project, render
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.settings.schedule import Schedule


def clone_and_split() -> None:
    t = np.linspace(0, 1, 60)
    curve = np.stack([-2.2 + 4.4 * t, 0.9 * np.sin(2.6 * t + 0.3) - 0.35], axis=1)
    for name, old, new in (
        (
            "clone",
            [((-0.38, 0.5), (0.5, 0.22), 15)],
            [((-0.9, 0.36), (0.5, 0.22), 30), ((0.2, 0.55), (0.5, 0.22), 0)],
        ),
        (
            "split",
            [((0.0, 0.25), (1.9, 0.75), 3)],
            [((-0.85, 0.25), (1.19, 0.47), 18), ((1.0, 0.3), (1.19, 0.47), -18)],
        ),
    ):
        panel = Drawing(330, 190, x=(-2.6, 2.6), y=(-1.3, 1.6), equal=True, margins=(4, 26, 4, 4))
        panel.line(curve, "line", 12)
        for mean, (a, b), degrees in old:
            panel.ellipse(
                mean,
                shape(a, b, degrees),
                1,
                "soft",
                1.6,
                dash="5 4",
                fill="soft",
                fill_opacity=0.1,
            )
        for (mean, (a, b), degrees), colour in zip(new, ("blue", "orange"), strict=True):
            panel.ellipse(
                mean, shape(a, b, degrees), 1, colour, 2.2, fill=colour, fill_opacity=0.15
            )
            panel.dot(mean, colour)
        panel.title(name)
        panel.save(f"density-{name}", f"{name}: a grey ellipse becomes two coloured ones")


def shape(a: float, b: float, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return R @ np.diag([a * a, b * b]) @ R.T


def histogram() -> None:
    grads = record()["events"][600]["grads"].double().numpy()
    grads = grads[grads > 0]
    threshold = np.log10(2e-4)
    edges = threshold + 0.1 * np.arange(-33, 13)  # the threshold is between two bars
    counts, _ = np.histogram(np.log10(grads), edges)
    top = counts.max() * 1.1
    panel = Drawing(340, 220, x=(-7, -2.5), y=(0, float(top)), margins=(44, 26, 10, 40))
    panel.axes(
        "τ", "Gaussians", x_ticks=[(e, f"1e{e}") for e in (-7, -6, -5, -4, -3)], counts=(5, 4)
    )
    for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True):
        colour = "orange" if low >= threshold - 1e-9 else "blue"
        panel.rectangle((low, 0), (high - 0.01, count), fill=colour, fill_opacity=0.75)
    panel.line([(threshold, 0), (threshold, top)], "ink", 1.6, dash="5 4")
    panel.text((threshold, top), "2e-4", anchor="start", dx=6, dy=12)
    print(f"step 600: {(grads > 2e-4).mean():.1%} above the threshold")
    panel.save("density-histogram", "A histogram of gradients with a threshold")


def curves() -> None:
    data = record()
    count = np.array(data["count"])
    panel = Drawing(
        340, 230, x=(0, STEPS), y=(0, float(count.max()) * 1.1), margins=(44, 26, 10, 40)
    )
    panel.axes("step", "Gaussians", counts=(5, 5))
    panel.line(zip(range(1, STEPS + 1, 10), count[::10], strict=False), "blue", 2.4)
    for step in (1000, 2000):
        panel.line([(step, 0), (step, panel.y[1])], "red", 1.2, dash="4 4")
    panel.text((2050, panel.y[1]), "opacity resets", "red", anchor="start", dy=14)
    panel.save("density-count", "A rising curve of the number of Gaussians")

    events = data["events"]
    steps = sorted(events)
    top = max(e["clones"] + e["splits"] for e in events.values())
    low = max(e["prunes"] for e in events.values())
    panel = Drawing(340, 230, x=(400, 2600), y=(-low * 1.1, top * 1.25), margins=(44, 26, 10, 40))
    panel.axes("step", "Gaussians per densification", counts=(5, 6))
    for step in steps:
        e = events[step]
        bar = (step - 38, step + 38)
        panel.rectangle((bar[0], 0), (bar[1], e["clones"]), fill="blue")
        panel.rectangle((bar[0], e["clones"]), (bar[1], e["clones"] + e["splits"]), fill="orange")
        panel.rectangle((bar[0], 0), (bar[1], -e["prunes"]), fill="red")
    for i, (words, colour) in enumerate(
        (("cloned", "blue"), ("split", "orange"), ("pruned", "red"))
    ):
        panel.text((2600, panel.y[1]), words, colour, anchor="end", dx=-4, dy=14 + 17 * i)
    panel.save("density-events", "Bars of cloned, split and pruned Gaussians")
    print(
        "counts",
        count[0],
        count.max(),
        count[-1],
        {s: data["events"][s]["clones"] for s in (500, 1000)},
        {s: {k: e[k] for k in ("clones", "splits", "prunes")} for s, e in events.items()},
    )

    loss = np.array(data["loss"])
    window = np.ones(50) / 50
    smooth = np.convolve(loss, window, "valid")
    panel = Drawing(340, 230, x=(0, STEPS), y=(0, 32), margins=(38, 26, 40, 40))
    panel.axes("step", "PSNR (dB)", counts=(5, 5))
    psnr = sorted(data["psnr"].items())
    panel.line(psnr, "blue", 2.2)
    scale = 30 / smooth.max()
    panel.line(zip(range(25, STEPS, 20), scale * smooth[::20], strict=False), "orange", 1.8)
    panel.text((STEPS, 32), "PSNR", "blue", anchor="end", dx=-4, dy=30)
    panel.text(
        (STEPS, 32),
        f"loss (from {smooth[0]:.2f} to {smooth[-1]:.3f})",
        "orange",
        anchor="end",
        dx=-4,
        dy=128,
    )
    print("psnr", psnr[0], psnr[-1], max(psnr, key=lambda p: p[1]), "loss", smooth[0], smooth[-1])
    panel.save("optimisation-loss", "PSNR rises, the loss falls; both jump at opacity resets")


def pictures() -> None:
    view = scene.camera(320)
    for name, step in (("start", 0), ("200", 200), ("1000", 1000), ("4000", 4000)):
        panel = Drawing(300, 247, margins=(0, 24, 0, 0))
        panel.title("start" if step == 0 else f"step {step}")
        panel.picture(scene.rendering(snapshot(step), view), (0, 0), (1, 1), quality=75)
        panel.save(f"optimisation-{name}", f"The scene after {step} steps")
    for i, (step, words) in enumerate(
        ((1000, "step 1000"), (1010, "step 1010"), (1500, "step 1500")), 1
    ):
        panel = Drawing(222, 189, margins=(0, 24, 0, 0))
        panel.title(words)
        panel.picture(scene.rendering(snapshot(step), view), (0, 0), (1, 1), quality=75)
        panel.save(f"density-reset-{i}", f"The scene at {words}")
    for step in (0, 600, 4000):
        gaussians = snapshot(step)
        # Every Gaussian as a small opaque ellipsoid, at a quarter of its size.
        with torch.no_grad():
            gaussians.log_scales -= np.log(4)
            gaussians.opacity_logits[:] = 6.0
        panel = Drawing(222, 189, margins=(0, 24, 0, 0))
        panel.title(f"{len(gaussians):,}")
        image = render(gaussians, view, sh_degree=0).image
        panel.picture(scene.pixels(image), (0, 0), (1, 1), quality=75)
        panel.save(f"density-ellipses-{step}", f"{len(gaussians)} ellipsoids at step {step}")
        print(step, len(gaussians), "visible", len(project(gaussians, view)))


def activations() -> None:
    x = np.linspace(-5, 1, 121)
    panel = Drawing(320, 220, x=(-5, 1), y=(0, 2.8), margins=(38, 26, 10, 40))
    panel.axes("log scale ℓ", "s", counts=(7, 4))
    panel.line(zip(x, np.exp(x), strict=True), "blue", 2.4)
    for at in (-3, -2, -1, 0):
        panel.dot((at, np.exp(at)), "orange", 3.6)
    panel.save("optimisation-exp", "The exponential function")
    x = np.linspace(-7, 7, 141)
    o = 1 / (1 + np.exp(-x))
    panel = Drawing(320, 220, x=(-7, 7), y=(0, 1.05), margins=(38, 26, 10, 40))
    panel.axes("logit x", "o", counts=(7, 5))
    panel.line(zip(x, o, strict=True), "blue", 2.4)
    panel.line(zip(x, o * (1 - o), strict=True), "orange", 1.8, dash="5 4")
    panel.dot((np.log(0.1 / 0.9), 0.1), "green", 4.5)
    panel.text((np.log(0.1 / 0.9), 0.1), "start: 0.1", "green", dx=-34, dy=-10)
    panel.save("optimisation-sigmoid", "The sigmoid and its derivative")


def rates() -> None:
    panel = Drawing(340, 230, x=(0, 1), y=(-2.2, 0.2), margins=(44, 26, 10, 40))
    panel.axes(
        "share of the steps",
        "rate / first rate",
        counts=(5, 3),
        y_ticks=[(-2, "1%"), (-1, "10%"), (0, "100%")],
    )
    for config, colour, words in (
        (recipe("paper"), "blue", "paper"),
        (recipe("default"), "orange", "default"),
    ):
        rates_: LearningRates = config.learning_rates
        schedule = Schedule(config.iterations)
        for name, dash in (("means", ""), ("log_scales", "5 4")):
            steps = np.linspace(1, config.iterations, 60).astype(int)
            values = [rates_.at(int(s), schedule, 1.0)[name] for s in steps]
            points = [
                (s / config.iterations, np.log10(v / values[0]))
                for s, v in zip(steps, values, strict=True)
            ]
            panel.line(points, colour, 2.2, dash=dash)
        panel.text(
            (0, -2.2), words, colour, anchor="start", dx=8, dy=-10 if colour == "blue" else -27
        )
    panel.text(
        (0, -2.2), "solid: positions; dashed: others", "soft", anchor="start", dx=8, dy=-46, size=12
    )
    panel.save("optimisation-rates", "Falling curves of the learning rates")


def main() -> None:
    clone_and_split()
    activations()
    rates()
    histogram()
    curves()
    pictures()


if __name__ == "__main__":
    main()
