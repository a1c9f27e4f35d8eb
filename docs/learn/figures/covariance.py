"""Figures of the page "Covariance"."""

import numpy as np
from drawing import Drawing

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


def main() -> None:
    stages()
    factors()


if __name__ == "__main__":
    main()
