"""Figures of the page "Projection"."""

import numpy as np
from drawing import Drawing

FOCAL = 1.0  # positions in the image are in units of the focal length


def jacobian(p: np.ndarray) -> np.ndarray:
    x, y, z = p
    return np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])


def outline(p: np.ndarray, radius: float) -> np.ndarray:
    """(N, 2): the outline of a ball. Its tangent rays d satisfy (d·p)² = |d|² (|p|² − r²)."""
    axis = p / np.linalg.norm(p)
    side = np.cross(axis, [0, 1, 0])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    opening = np.arcsin(radius / np.linalg.norm(p))
    angles = np.linspace(0, 2 * np.pi, 91)[:, None]
    rays = np.cos(opening) * axis + np.sin(opening) * (np.cos(angles) * side + np.sin(angles) * up)
    return rays[:, :2] / rays[:, 2:]


def outlines() -> None:
    radius = 0.2
    for name, degrees in (("middle", 0), ("edge", 45)):
        p = np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])
        centre = p[:2] / p[2]
        half = 0.56
        panel = Drawing(
            300,
            230,
            x=(centre[0] - half, centre[0] + half),
            y=(-0.4, 0.4),
            equal=True,
            margins=(4, 26, 4, 4),
        )
        J = jacobian(p)
        curve = outline(p, radius)
        panel.ellipse(centre, radius**2 * J @ J.T, 1, "blue", 2.2, fill="blue", fill_opacity=0.13)
        panel.line(curve, "orange", 2.2, dash="6 4")
        true_centre = (curve.max(axis=0) + curve.min(axis=0)) / 2
        for at, colour in ((centre, "blue"), (true_centre, "orange")):
            d = 0.025
            panel.line([(at[0] - d, at[1]), (at[0] + d, at[1])], colour, 1.8)
            panel.line([(at[0], at[1] - d), (at[0], at[1] + d)], colour, 1.8)
        panel.title("on the optical axis" if degrees == 0 else f"{degrees}° from the axis")
        panel.save(f"projection-outline-{name}", "A solid and a dashed ellipse, nearly equal")


def errors(size: float, degrees: float, samples: np.ndarray) -> tuple[float, float]:
    """Shift of the mean, in standard deviations, and relative error of the larger σ."""
    angle = np.radians(degrees)
    p = np.array([np.sin(angle), 0, np.cos(angle)])
    x = p + size * samples
    exact = x[:, :2] / x[:, 2:]
    J = jacobian(p)
    sigma = np.sqrt(np.linalg.eigvalsh(size**2 * J @ J.T)[1])
    shift = np.linalg.norm(exact.mean(axis=0) - p[:2] / p[2]) / sigma
    true_sigma = np.sqrt(np.linalg.eigvalsh(np.cov(exact.T))[1])
    return shift, abs(true_sigma / sigma - 1)


def error_curves() -> None:
    samples = np.random.default_rng(0).standard_normal((100_000, 3))
    samples = np.concatenate([samples, -samples])  # so that the mean of the samples is exact
    sizes = np.linspace(0.005, 0.15, 16)
    angles = np.linspace(0, 50, 21)
    for name, xs, at, label in (
        ("depth", sizes, [errors(s, 30, samples) for s in sizes], "s / D, at 30° from the axis"),
        ("angle", angles, [errors(0.05, a, samples) for a in angles], "angle from the axis (°)"),
    ):
        values = 100 * np.array(at)
        panel = Drawing(
            320,
            230,
            x=(0, float(xs[-1])),
            y=(0, float(values.max()) * 1.1),
            margins=(38, 26, 10, 40),
        )
        panel.axes(label, "% of the standard deviation", counts=(5, 5))
        for i, (words, colour) in enumerate(
            (("shift of the mean", "orange"), ("error of σ", "blue"))
        ):
            panel.line(zip(xs, values[:, i], strict=True), colour, 2.2)
            panel.text((0, panel.y[1]), words, colour, anchor="start", dx=10, dy=18 + 18 * i)
        panel.save(f"projection-error-{name}", "Two rising curves of the error")
        print(
            name,
            [(round(float(x), 3), v.round(2).tolist()) for x, v in zip(xs, values, strict=True)][
                ::5
            ],
        )


def filters() -> None:
    covariance = np.array([[6.0, 2.9], [2.9, 1.41]])
    for name, dilation in (("off", 0.0), ("on", 0.3)):
        panel = Drawing(300, 200, x=(-6, 6), y=(-4, 4), margins=(4, 26, 4, 4))
        inverse = np.linalg.inv(covariance + dilation * np.eye(2))
        for i in range(-6, 6):
            for j in range(-4, 4):
                d = np.array([i + 0.5, j + 0.5]) - (0.1, 0.15)
                value = np.exp(-0.5 * d @ inverse @ d)
                panel.rectangle(
                    (i, j),
                    (i + 1, j + 1),
                    "line",
                    fill="blue",
                    fill_opacity=round(0.85 * value, 3),
                    width=0.8,
                )
        for k in (1, 2):
            panel.ellipse((0.1, 0.15), covariance + dilation * np.eye(2), k, "orange", 1.6)
        panel.title("without the filter" if dilation == 0 else "with the filter")
        panel.save(f"projection-filter-{name}", f"Pixels of a thin splat, {panel.width:g} wide")


def main() -> None:
    outlines()
    error_curves()
    filters()


if __name__ == "__main__":
    main()
