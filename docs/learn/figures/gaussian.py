"""Figures of the page "The 3D Gaussian"."""

import numpy as np
from drawing import Drawing

COLOURS = ("blue", "orange", "green")
COVARIANCE = np.array([[1.6, 0.75], [0.75, 0.7]])


def widths(normalised: bool) -> None:
    """Gaussians of three widths, with and without the normalising factor."""
    top = 0.85 if normalised else 1.08
    panel = Drawing(320, 220, x=(-5, 5), y=(0, top), margins=(38, 26, 8, 40))
    panel.axes("x", "density" if normalised else "G(x)", counts=(5, 5))
    x = np.linspace(-5, 5, 201)
    for sigma, colour in zip((0.5, 1.0, 2.0), COLOURS, strict=True):
        height = 1 / (sigma * np.sqrt(2 * np.pi)) if normalised else 1.0
        panel.line(zip(x, height * np.exp(-0.5 * (x / sigma) ** 2), strict=True), colour, 2.2)
    for i, (word, colour) in enumerate(zip(("σ = 0.5", "σ = 1", "σ = 2"), COLOURS, strict=True)):
        panel.text((5, top), word, colour, anchor="end", dx=-4, dy=16 + 18 * i)
    panel.save(
        "gaussian-normalised" if normalised else "gaussian-unnormalised",
        "Three bell curves of different widths, "
        + ("of equal area" if normalised else "all with the maximum 1"),
    )


def levels() -> None:
    panel = Drawing(330, 240, x=(-3.9, 3.9), y=(-2.6, 2.6), equal=True)
    for k in (3, 2, 1):
        panel.ellipse((0, 0), COVARIANCE, k, "blue", fill="blue", fill_opacity=0.13)
    values, vectors = np.linalg.eigh(COVARIANCE)
    for i, name in ((1, "σ₁ v₁"), (0, "σ₂ v₂")):
        axis = np.sqrt(values[i]) * vectors[:, i] * np.sign(vectors[1, i])
        panel.arrow((0, 0), axis, "orange", 2.2)
        panel.text(axis, name, "orange", dx=22 * np.sign(axis[0]), dy=-8, bold=True)
    panel.dot((0, 0))
    panel.text((0, 0), "μ", dx=-4, dy=18)
    # The lowest point of the level set k is k · (cov(x, y), var(y)) / σ(y), downwards.
    low = -COVARIANCE[1] / np.sqrt(COVARIANCE[1, 1])
    for k in (1, 2, 3):
        panel.text(k * low, f"k = {k}", "soft", size=12, dx=2, dy=-5)
    panel.save("gaussian-levels", "Three nested ellipses with two arrows along their axes")


def affine() -> None:
    panel = Drawing(320, 240, x=(-3.4, 3.8), y=(-2.6, 2.8), equal=True)
    matrix, shift = np.array([[1.5, 0.7], [-0.3, 0.9]]), np.array([1.0, 0.4])
    centre = np.array([-1.6, -0.7])
    panel.ellipse(centre, np.eye(2), 1, "soft", 1.6, dash="5 4")
    panel.ellipse(
        matrix @ centre + shift + [2.6, 0.6],
        matrix @ matrix.T,
        1,
        "blue",
        2.2,
        fill="blue",
        fill_opacity=0.13,
    )
    for angle in np.linspace(0, 2 * np.pi, 9)[:-1]:
        unit = np.array([np.cos(angle), np.sin(angle)])
        start = centre + unit
        end = matrix @ (centre + unit) + shift + [2.6, 0.6]
        panel.line([start, end], "line", 1)
        panel.dot(start, "soft", 2.6)
        panel.dot(end, "orange", 3)
    panel.text(centre, "Σ", "soft", dy=4)
    panel.text(matrix @ centre + shift + [2.6, 0.6], "A Σ Aᵀ", "blue", dy=4, bold=True)
    panel.save("gaussian-affine", "A circle, mapped to an ellipse by an affine map")


def integral() -> None:
    covariance = np.array([[1.0, 0.9], [0.9, 1.4]])
    panel = Drawing(300, 240, x=(-3.4, 3.4), y=(-3.4, 3.4), equal=True, margins=(8, 8, 8, 24))
    n = 170
    x = np.linspace(*panel.x, n)
    z = np.linspace(*panel.y[::-1], n)
    grid = np.stack(np.meshgrid(x, z), -1)
    inverse = np.linalg.inv(covariance)
    values = np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", grid, inverse, grid))
    for k in (1, 2, 3):
        panel.ellipse((0, 0), covariance, k, "blue", 1.4, fill="blue", fill_opacity=0.16)
    for d in np.arange(-3, 3.1, 0.75):
        panel.line([(d, panel.y[0]), (d, panel.y[1])], "line", 1)
    panel.line([(panel.x[0], 0), (panel.x[1], 0)], "orange", 1.8, dash="6 4")
    panel.text((panel.x[1], panel.y[0]), "d →", "soft", anchor="end", size=12, dy=17)
    panel.text((panel.x[0], panel.y[1]), "z ↑", "soft", anchor="start", size=12, dx=4, dy=14)
    panel.save("gaussian-integral", "Ellipses of a Gaussian with vertical lines of integration")

    curve = Drawing(300, 240, x=(-3.4, 3.4), y=(0, 1.08), margins=(38, 26, 8, 40))
    curve.axes("d", "relative to the maximum", counts=(7, 5))
    total = values.sum(axis=0)  # a numerical integral over z: the formula is not used here
    curve.line(zip(x, total / total.max(), strict=True), "blue", 2.4)
    middle = np.exp(-0.5 * inverse[0, 0] * x**2)
    curve.line(zip(x, middle, strict=True), "orange", 2, dash="6 4")
    curve.text((-3.4, 1.08), "integral over z", "blue", anchor="start", dx=8, dy=16)
    curve.text((-3.4, 1.08), "section z = 0", "orange", anchor="start", dx=8, dy=34)
    curve.save("gaussian-slice", "The curve of the integral is wider than that of the section")


def main() -> None:
    widths(normalised=False)
    widths(normalised=True)
    levels()
    affine()
    integral()


if __name__ == "__main__":
    main()
