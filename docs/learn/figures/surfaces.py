"""Figures of the page "Surfaces"."""

import math
from statistics import NormalDist

import numpy as np
from drawing import Drawing


def wall() -> None:
    """The weight of a wall of many faint Gaussians, with the opacity 0.9."""
    u = np.linspace(-3, 3, 301)
    kappa = -math.log(1 - 0.9)
    density = kappa * np.exp(-(u**2) / 2) / math.sqrt(2 * math.pi)
    T = np.exp(-kappa * np.array([NormalDist().cdf(v) for v in u]))
    weight = T * density
    mean = (weight * u).sum() / weight.sum()
    median = NormalDist().inv_cdf(math.log(2) / kappa)
    print(f"wall: mean {mean:.2f}, median {median:.2f} standard deviations")
    panel = Drawing(330, 240, x=(-3, 3), y=(0, 1.05), margins=(32, 26, 8, 40))
    panel.axes("depth, in σ from the wall", counts=(7, 5))
    panel.line(
        [(-3, 0), *zip(u, density, strict=True), (3, 0)], "soft", 1, fill="soft", fill_opacity=0.22
    )
    panel.line(zip(u, T, strict=True), "blue", 2.2)
    panel.line(zip(u, weight, strict=True), "orange", 2.2)
    panel.line([(mean, 0), (mean, 1.05)], "orange", 1.4, dash="5 4")
    panel.line([(median, 0), (median, 1.05)], "green", 1.4)
    for i, (words, colour) in enumerate(
        (
            ("density", "soft"),
            ("transmittance", "blue"),
            ("weight; its mean", "orange"),
            ("median", "green"),
        )
    ):
        panel.text((3, 1.05), words, colour, anchor="end", dx=-2, dy=14 + 17 * i)
    panel.save("surfaces-wall", "A bell of density, and the mean and median depth in front of it")


def edge() -> None:
    """Mean and median depth at the edge of an object at 2 before a wall at 5."""
    x = np.linspace(0, 4, 201)
    near, far = 0.99 * np.exp(-(x**2) / 2), 0.9
    weights = near, (1 - near) * far
    mean = (2 * weights[0] + 5 * weights[1]) / (weights[0] + weights[1])
    step = math.sqrt(2 * math.log(0.99 / 0.5))
    panel = Drawing(330, 240, x=(0, 4), y=(1, 6), margins=(32, 26, 8, 40))
    panel.axes("place in the image, in σ of the near splat", "depth", counts=(5, 6))
    panel.line(zip(x, mean, strict=True), "orange", 2.2, dash="5 4")
    panel.line([(0, 2), (step, 2), (step, 5), (4, 5)], "green", 2.2)
    panel.text((4, 3.5), "mean depth", "orange", anchor="end", dx=-4)
    panel.text((4, 3), "median depth", "green", anchor="end", dx=-4)
    panel.save("surfaces-edge", "A smooth curve between two depths, and a step")


def ray() -> None:
    """Where a Gaussian is densest along rays, and the straight line to first order."""
    turn = np.array([[math.cos(0.6), -math.sin(0.6)], [math.sin(0.6), math.cos(0.6)]])
    covariance = turn @ np.diag([0.9**2, 0.3**2]) @ turn.T
    precision = np.linalg.inv(covariance)
    mean = np.array([0.2, 3.0])
    panel = Drawing(330, 300, x=(-1.9, 1.9), y=(-0.1, 4.2), equal=True)
    for k in (1, 2):
        panel.ellipse(mean, covariance, k, "blue", 1.4, fill="blue", fill_opacity=0.10)
    centre = mean / mean[1]
    g = precision @ centre / (centre @ precision @ centre)
    exact, straight = [], []
    for x in np.linspace(-0.36, 0.5, 44):
        d = np.array([x, 1.0])
        exact.append(d * (d @ precision @ mean) / (d @ precision @ d))
        straight.append(d * mean[1] / (g @ d))
    for i in (0, 9, 18, 26, 34, 43):
        panel.line([(0, 0), 1.2 * exact[i]], "soft", 1)
        panel.dot(exact[i], "orange")
    panel.line(exact, "orange", 2.2)
    panel.line(straight, "green", 1.8, dash="5 4")
    panel.dot(mean, "ink")
    panel.text(mean, "μ", anchor="start", dx=7, dy=14)
    panel.dot((0, 0), "ink")
    panel.text((0, 0), "camera", anchor="start", dx=10, dy=4)
    panel.save("surfaces-ray", "An ellipse, rays from a camera, and the densest point on each")


def distance() -> None:
    """Three depth maps, as truncated signed distances along a ray, and their mean."""
    z = np.linspace(1.8, 2.2, 401)
    total, weights = np.zeros_like(z), np.zeros_like(z)
    panel = Drawing(330, 240, x=(1.8, 2.2), y=(-1.05, 1.05), margins=(38, 26, 8, 40))
    panel.axes("depth of the voxel", "signed distance s", counts=(5, 5))
    for depth, weight in ((2.00, 1.0), (2.03, 0.5), (1.96, 0.5)):
        s = ((depth - z) / 0.1).clip(max=1)
        seen = s > -1
        w = np.where(seen, weight * (1 + s).clip(max=1), 0)
        total, weights = total + w * s, weights + w
        panel.line(zip(z[seen], s[seen], strict=True), "blue", 1.2, dash="5 4")
    known = weights > 1e-3
    field = total[known] / weights[known]
    panel.line(zip(z[known], field, strict=True), "orange", 2.4)
    zero = float(np.interp(0, -field, z[known]))
    print(f"distance: the mean is 0 at {zero:.4f}")
    panel.dot((zero, 0), "orange")
    panel.text((2.2, 1.05), "three maps", "blue", anchor="end", dx=-2, dy=14)
    panel.text((2.2, 1.05), "their weighted mean", "orange", anchor="end", dx=-2, dy=31)
    panel.save("surfaces-distance", "Three falling lines, and their mean, which crosses zero")


def net() -> None:
    """A surface net in two dimensions, of a circle in a grid of six by six voxels."""
    centre, radius = np.array([2.4, 2.6]), 1.75

    def field(x: int, y: int) -> float:
        return float(np.hypot(*(np.array([x, y]) - centre)) - radius)

    panel = Drawing(300, 300, x=(-0.4, 5.4), y=(-0.4, 5.4), equal=True)
    for i in range(6):
        panel.line([(i, 0), (i, 5)], "line", 1)
        panel.line([(0, i), (5, i)], "line", 1)
    panel.ellipse(centre, np.eye(2) * radius**2, 1, "soft", 1.2, dash="4 4")
    cells = {}
    for x in range(5):
        for y in range(5):
            corners = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
            crossings = []
            for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
                a, b = field(*p), field(*q)
                if (a < 0) != (b < 0):
                    crossings.append(np.array(p) + a / (a - b) * (np.array(q) - np.array(p)))
            if crossings:
                cells[x, y] = np.mean(crossings, axis=0)
                for point in crossings:
                    panel.dot(point, "blue", 2.4)
    for (x, y), vertex in cells.items():
        for step, corner in (((1, 0), (x + 1, y)), ((0, 1), (x, y + 1))):
            other = x + step[0], y + step[1]
            end = corner[0] + step[1], corner[1] + step[0]
            if other in cells and (field(*corner) < 0) != (field(*end) < 0):
                panel.line([vertex, cells[other]], "orange", 2.2)
        panel.dot(vertex, "orange", 3.6)
    for x in range(6):
        for y in range(6):
            panel.text((x, y), "−" if field(x, y) < 0 else "+", "ink", size=13, dx=6, dy=-4)
    panel.save("surfaces-net", "A grid of signs, a circle, and a polygon near it")


def main() -> None:
    wall()
    edge()
    ray()
    distance()
    net()


if __name__ == "__main__":
    main()
