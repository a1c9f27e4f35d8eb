"""Figures of the page "Why the start matters"."""

import json
import sys

import numpy as np
from drawing import FOLDER, Drawing

EXPERIMENT = FOLDER.parents[2] / "experiments" / "basins"
sys.path.append(str(EXPERIMENT))

import closed_form  # noqa: E402
import torch  # noqa: E402
from fit import Options, fit  # noqa: E402
from images import Picture, blobs, draw, landscape, ring  # noqa: E402
from pictures import picture_fit  # noqa: E402
from targets import Mixture, evaluate  # noqa: E402

ROWS = json.loads((EXPERIMENT / "results.json").read_text())
OPTIMISERS = {"gradient descent": "blue", "momentum": "green", "Adam": "orange"}
RULES = {
    "none": "none",
    "noise": "noise",
    "clone and split": "clone, split",
    "MCMC": "MCMC",
    "refill": "refill",
}
COLOURS = ("soft", "violet", "blue", "green", "orange")


def rows(study: str, **values: object) -> list[dict]:
    found = [r for r in ROWS if r["study"] == study]
    return [r for r in found if all(r[name] == value for name, value in values.items())]


def curve(panel: Drawing, points: list[dict], x: str, colour: str, dash: str = "") -> None:
    """The shares of successes, with their intervals as an area."""
    band = [(r[x], r["low"]) for r in points] + [(r[x], r["high"]) for r in reversed(points)]
    panel.line(band, "", 0, closed=True, fill=colour, fill_opacity=0.16)
    panel.line([(r[x], r["share"]) for r in points], colour, 2.2, dash=dash)


def probability_panel(x: tuple[float, float], label: str, **axes: object) -> Drawing:
    panel = Drawing(330, 226, x=x, y=(0, 1.04), margins=(40, 26, 10, 40))
    panel.axes(label, "share of starts that succeed", counts=(6, 5), **axes)
    return panel


def legend(panel: Drawing, words: dict[str, str], *, top: float = 16) -> None:
    """Names in colours, at the right."""
    for i, (name, colour) in enumerate(words.items()):
        panel.text((panel.x[1], panel.y[1]), name, colour, anchor="end", dx=-4, dy=top + 17 * i)


def near_and_far() -> None:
    """Fits by gradient descent from two distances."""
    target = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
    x = torch.linspace(-7, 3, 201, dtype=torch.float64)
    for name, distance in (("near", 2.5), ("far", 5.0)):
        start = torch.tensor([[[-distance, 0.0, 0.8]]], dtype=torch.float64)
        options = Options("gradient descent", 0.3, steps=800)
        end = fit(start, Mixture((-7, 3), target), options)
        panel = Drawing(330, 190, x=(-7, 3), y=(-0.05, 1.1), margins=(8, 12, 8, 28))
        panel.axes(x_ticks=[(v, str(v).replace("-", "−")) for v in (-6, -4, -2, 0, 2)], y_ticks=[])
        g, f0, f1 = (
            list(zip(x.tolist(), evaluate(p, x)[0].tolist(), strict=True))
            for p in (target, start, end)
        )
        panel.line([(-7, 0), *g, (3, 0)], "", 0, closed=True, fill="soft", fill_opacity=0.25)
        panel.line(f0, "blue", 1.8, dash="5 4")
        panel.line(f1, "blue", 2.4)
        words = "The Gaussian has moved to the target" if name == "near" else (
            "The Gaussian has stayed far from the target and is nearly invisible"
        )  # fmt: skip
        panel.save(f"initialisation-{name}", words)


def loss_and_pull() -> None:
    d = np.linspace(-8, 8, 321)
    loss = Drawing(330, 220, x=(-8, 8), y=(0, 1.1), margins=(40, 26, 10, 40))
    ticks = [(v, str(v).replace("-", "−")) for v in (-8, -4, 0, 4, 8)]
    loss.axes("distance d", "loss / largest loss", x_ticks=ticks, counts=(5, 5))
    pull = Drawing(330, 220, x=(0, 8), y=(0, 1.1), margins=(40, 26, 10, 40))
    pull.axes("distance d", "pull / largest pull", counts=(5, 5))
    names = {}
    for sigma, colour in ((0.5, "orange"), (1.0, "blue"), (2.0, "violet")):
        names[f"σ = {sigma:g}"] = colour
        values = closed_form.loss(torch.tensor(d), sigma, sigma).numpy()
        loss.line(zip(d, values / values.max(), strict=True), colour, 2.2)
        far = d[d >= 0]
        values = closed_form.position_gradient(torch.tensor(far), sigma, sigma).numpy()
        pull.line(zip(far, values / values.max(), strict=True), colour, 2.2)
    legend(pull, names)
    loss.save("initialisation-loss", "Three wells of different widths; outside, the loss is flat")
    pull.save("initialisation-pull", "The pull has a maximum and then decays to nearly 0")


def basins() -> None:
    for name, only_means in (("position", True), ("all", False)):
        panel = probability_panel((0, 10), "distance of the start, in σ of the target")
        for optimizer, colour in OPTIMISERS.items():
            points = rows("basin", n=1, optimizer=optimizer, only_means=only_means)
            curve(panel, points, "distance", colour)
        legend(panel, OPTIMISERS, top=34)
        panel.save(f"initialisation-basin-{name}", "Success by distance, for three optimisers")


def widths() -> None:
    ticks = [(np.log2(v), f"{v:g}") for v in (0.5, 1, 2, 4, 8, 16)]
    for n in (1, 2):
        panel = probability_panel((-1, 4.5), "width of the start", x_ticks=ticks)
        for optimizer in ("gradient descent", "Adam"):
            points = [
                {**r, "log": np.log2(r["sigma"])} for r in rows("width", n=n, optimizer=optimizer)
            ]
            curve(panel, points, "log", OPTIMISERS[optimizer])
        legend(panel, {k: OPTIMISERS[k] for k in ("gradient descent", "Adam")})
        panel.save(f"initialisation-width-{n}", "Success by the width of the start")


def blurs() -> None:
    for name, optimizer in (("descent", "gradient descent"), ("adam", "Adam")):
        panel = probability_panel((0, 12), "distance of the start, in σ of the target")
        names = {}
        for s, colour in ((0.0, "soft"), (2.0, "blue"), (4.0, "green"), (8.0, "orange")):
            points = [r for r in rows("blur", optimizer=optimizer, blur=s) if r["distance"] <= 12]
            curve(panel, points, "distance", colour)
            names["no blur" if s == 0 else f"s = {s:g}"] = colour
        legend(panel, names)
        panel.save(f"initialisation-blur-{name}", f"Success by distance and blur, {optimizer}")


def counts() -> None:
    panel = probability_panel((1, 8), "number of targets k")
    names = {"2k Gaussians": "orange", "k Gaussians": "blue"}
    for factor, colour in ((1, "blue"), (2, "orange")):
        points = [r for r in rows("targets") if r["gaussians"] == factor * r["k"]]
        curve(panel, points, "k", colour)
    for i, (name, colour) in enumerate(names.items()):
        panel.text((1, 0), name, colour, anchor="start", dx=8, dy=-27 + 17 * i)
    panel.save("initialisation-targets", "Success by the number of targets")
    panel = probability_panel((4, 18), "number of Gaussians, for 6 targets")
    for optimizer, colour in OPTIMISERS.items():
        curve(panel, rows("gaussians", optimizer=optimizer), "gaussians", colour)
    for i, (name, colour) in enumerate(OPTIMISERS.items()):
        panel.text((18, 0), name, colour, anchor="end", dx=-4, dy=-44 + 17 * i)
    panel.save("initialisation-gaussians", "Success by the number of Gaussians")


def density() -> None:
    cases = ((6, 1.0), (9, 1.0), (12, 1.0), (12, 0.333))
    words = ((0, "6"), (1, "9"), (2, "12"), (3, "12, in a third"))
    panel = Drawing(340, 270, x=(-0.5, 3.5), y=(0, 1.0), margins=(40, 56, 6, 40))
    panel.axes("number of Gaussians", "share of starts that succeed", x_ticks=words)
    for j, (rule, colour) in enumerate(zip(RULES, COLOURS, strict=True)):
        for i, (count, share) in enumerate(cases):
            (r,) = rows("rules", signal="mixture", gaussians=count, start_share=share, rule=rule)
            at = i + 0.155 * (j - 2)
            panel.rectangle((at - 0.07, 0), (at + 0.07, r["share"]), fill=colour)
            panel.line([(at, r["low"]), (at, r["high"])], "ink", 1.2)
    for x, name, colour in zip((0, 46, 96, 178, 232), RULES.values(), COLOURS, strict=True):
        panel.text((-0.5, 1.0), name, colour, anchor="start", dx=x, dy=-34)
    panel.save("initialisation-rules", "Success of five rules of density control")


def pictures() -> None:
    """The images, and fits of the landscape with two rules from a corner."""
    image = landscape()
    targets = torch.cat([ring(), blobs().clamp(0, 1), image], dim=1)
    fits = [
        draw(picture_fit(Picture(image), "corner", rule, seed=0)[0]).detach().clamp(0, 1)
        for rule in ("none", "clone and split", "refill")
    ]
    for name, row in (("targets-2d", targets), ("fits", torch.cat(fits, dim=1))):
        panel = Drawing(330, 112, x=(0, 3), y=(0, 1), margins=(0, 0, 0, 0))
        panel.picture(row[..., None].expand(-1, -1, 3).numpy(), (0, 0), (3, 1), pixelated=True)
        words = "A ring, blobs, a landscape" if name != "fits" else "Three fits of the landscape"
        panel.save(f"initialisation-{name}", words)


def main() -> None:
    near_and_far()
    loss_and_pull()
    basins()
    widths()
    blurs()
    counts()
    density()
    pictures()


if __name__ == "__main__":
    main()
