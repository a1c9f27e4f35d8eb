"""Figures of the page "Covariance"."""

import json

import numpy as np
from drawing import FOLDER, Drawing

ANGLE = np.radians(35)
R = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
S = np.diag([1.9, 0.65])
POINTS = [np.array([np.cos(a), np.sin(a)]) for a in np.radians((0, 90, 225))]


def stages() -> None:
    for name, words, matrix in (
        ("ball", "unit ball", np.eye(2)),
        ("scaled", "S", S),
        ("rotated", "R S", R @ S),
    ):
        panel = Drawing(216, 190, x=(-2.1, 2.1), y=(-1.7, 1.7), equal=True, margins=(4, 26, 4, 4))
        panel.line([(-2.1, 0), (2.1, 0)], "line", 1)
        panel.line([(0, -1.7), (0, 1.7)], "line", 1)
        panel.ellipse((0, 0), matrix @ matrix.T, 1, "blue", 2.2, fill="blue", fill_opacity=0.13)
        for point, colour in zip(POINTS, ("orange", "green", "violet"), strict=True):
            panel.line([(0, 0), matrix @ point], colour, 1.6)
            panel.dot(matrix @ point, colour, 4)
        panel.title(words)
        panel.save(f"covariance-{name}", f"{words}: an ellipse with three marked points")


def factors() -> None:
    M = R @ S
    covariance = M @ M.T
    for name, words, factor in (
        ("eigen", "M = R S", M),
        ("cholesky", "M = L", np.linalg.cholesky(covariance)),
    ):
        panel = Drawing(300, 216, x=(-2.4, 2.4), y=(-1.6, 1.6), equal=True, margins=(4, 26, 4, 4))
        panel.line([(-2.4, 0), (2.4, 0)], "line", 1)
        panel.line([(0, -1.6), (0, 1.6)], "line", 1)
        panel.ellipse((0, 0), covariance, 1, "blue", 2.2, fill="blue", fill_opacity=0.13)
        for i, colour in enumerate(("orange", "green")):
            panel.arrow((0, 0), factor[:, i], colour, 2.4)
            side = 1 if factor[0, i] > 1 else -1
            panel.text(factor[:, i], f"column {i + 1}", colour, dx=10 * side, dy=-9, bold=True)
        panel.title(words)
        panel.save(f"covariance-{name}", f"An ellipse and the two columns of {words}")


def experiment() -> None:
    """The results of experiments/cholesky.py."""
    path = FOLDER.parents[2] / "experiments" / "cholesky.json"
    rows = [row for row in json.loads(path.read_text()) if row["psnr"] is not None]
    shapes = list(dict.fromkeys(row["shape"] for row in rows))
    colours = dict(zip(shapes, ("blue", "orange", "green"), strict=True))

    panel = Drawing(330, 240, x=(-2.65, -0.85), y=(22.8, 25.2), margins=(44, 26, 10, 40))
    rates = sorted({row["rate"] for row in rows})
    panel.axes("learning rate", "PSNR (dB)", x_ticks=[(np.log10(r), f"{r:g}") for r in rates])
    for i, shape in enumerate(shapes):
        line = []
        for rate in rates:
            psnr = [r["psnr"] for r in rows if (r["shape"], r["rate"]) == (shape, rate)]
            line.append((np.log10(rate), float(np.mean(psnr))))
            for value in psnr:
                panel.dot((np.log10(rate), value), colours[shape], 2.5)
        panel.line(line, colours[shape], 2)
        panel.text((-2.65, 25.2), shape, colours[shape], anchor="start", dx=8, dy=14 + 17 * i)
    panel.save("covariance-rates", "PSNR of three parameterisations for several learning rates")

    panel = Drawing(330, 240, x=(-0.5, 2.5), y=(24.0, 24.8), margins=(44, 26, 10, 40))
    names = ("R S", "Cholesky", "scaled")
    panel.axes("", "PSNR (dB)", x_ticks=list(enumerate(names)), counts=(2, 5))
    values = []
    for shape in shapes:  # the best rate of each
        own = [[r for r in rows if (r["shape"], r["rate"]) == (shape, rate)] for rate in rates]
        best = max(own, key=lambda runs: np.mean([run["psnr"] for run in runs]))
        values.append([run["psnr"] for run in sorted(best, key=lambda run: run["seed"])])
    for seed in range(len(values[0])):  # the same seed in each column
        panel.line([(i, column[seed]) for i, column in enumerate(values)], "line", 1)
    for i, (shape, column) in enumerate(zip(shapes, values, strict=True)):
        mean = float(np.mean(column))
        panel.line([(i - 0.2, mean), (i + 0.2, mean)], colours[shape], 2.6)
        for value in column:
            panel.dot((i, value), colours[shape], 3.4)
    panel.save("covariance-seeds", "PSNR of five seeds for three parameterisations")


def main() -> None:
    stages()
    factors()
    experiment()


if __name__ == "__main__":
    main()
