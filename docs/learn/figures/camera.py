"""Figures of the page "Cameras"."""

import numpy as np
from drawing import Drawing

import scene


def pinhole() -> None:
    panel = Drawing(340, 220, x=(-0.5, 6.5), y=(-1.35, 2.9), margins=(6, 6, 6, 6))
    panel.line([(0, 0), (6.4, 0)], "soft", 1.2, dash="4 4")
    panel.line([(2, -0.35), (2, 2.2)], "soft", 2.4)
    panel.text((2, 2.2), "image", "soft", dy=-7, size=12)
    for depth, colour in ((3.2, "blue"), (6.0, "orange")):
        panel.line([(0, 0), (depth, 2)], colour, 1.4)
        panel.arrow((depth, 0), (depth, 2), colour, 3)
        panel.dot((2, 4 / depth), colour, 4.5)
    panel.dot((0, 0), "ink", 5)
    panel.text((0, 0), "camera", dy=-12, dx=6, size=12)
    panel.text((3.2, 1), "y", "blue", dx=11, dy=4, bold=True)
    panel.text((2, 1.25), "v", "blue", dx=-10, dy=-4, bold=True)
    for high, y, words in ((2, -0.55, "f"), (3.2, -1.1, "z")):
        panel.line([(0, y), (high, y)], "ink", 1)
        panel.line([(0, y - 0.09), (0, y + 0.09)], "ink", 1)
        panel.line([(high, y - 0.09), (high, y + 0.09)], "ink", 1)
        panel.text((high, y), words, dx=11, dy=4, bold=True)
    panel.save("camera-pinhole", "Two arrows of equal height at two depths, and their images")


def top_view() -> None:
    data = scene.dataset()
    assert data.points is not None
    points = data.points.xyz.double().numpy()
    # The world frame of a dataset has y down: seen from above, x goes right and z up.
    panel = Drawing(320, 260, x=(-2.3, 2.3), y=(-2.0, 2.0), equal=True, margins=(4, 4, 4, 4))
    for k in range(-4, 5):
        panel.line([(k, panel.y[0]), (k, panel.y[1])], "line", 1)
        panel.line([(panel.x[0], k), (panel.x[1], k)], "line", 1)
    random = np.random.default_rng(0)
    middle = np.median(points, axis=0)
    near = np.abs(points - middle)[:, [0, 2]].max(axis=1) < 1.9
    for p in points[near][random.permutation(near.sum())[:900]]:
        panel.dot((p[0] - middle[0], p[2] - middle[2]), "soft", 0.9)
    for view in [*data.train, *data.test]:
        position = view.camera.position.numpy() - middle
        forward = view.camera.cam_from_world[2, :3].numpy()
        chosen = view.name == scene.VIEW
        colour = "orange" if chosen else "blue"
        start = position[[0, 2]]
        panel.line([start, start + 0.22 * forward[[0, 2]]], colour, 2.6 if chosen else 1.2)
        panel.dot(start, colour, 4.5 if chosen else 2.6)
    panel.save("camera-top", "Cameras in two rings around a table, from above, with 3D points")

    photo = Drawing(320, 260, x=(0, 1), y=(0, 1), margins=(0, 10, 0, 12))
    (view,) = (v for v in [*data.train, *data.test] if v.name == scene.VIEW)
    from snowsplat.data.photos.image_loader import ImageLoader

    image = ImageLoader([view]).get(view, 1).rgb
    photo.picture(np.asarray(image), (0, 0), (1, 1))
    photo.save("camera-photo", "A photo of a table with a globe, books, cans and boxes")


def pixel_grid() -> None:
    for name, factor in (("pixels", 1), ("half", 2)):
        w, h = 6 // factor, 4 // factor
        panel = Drawing(
            300,
            222,
            x=(-0.4 / factor, w + 0.4 / factor),
            y=(h + 0.5 / factor, -0.5 / factor),
            margins=(4, 4, 4, 4),
        )
        for i in range(w + 1):
            panel.line([(i, 0), (i, h)], "line", 1.4)
        for j in range(h + 1):
            panel.line([(0, j), (w, j)], "line", 1.4)
        for i in range(w):
            for j in range(h):
                panel.dot((i + 0.5, j + 0.5), "soft", 2)
        panel.dot((w / 2, h / 2), "orange", 4.5)
        panel.text((w / 2, h / 2), f"({w / 2:g}, {h / 2:g})", "orange", dy=18, bold=True)
        m = np.array([4.2, 1.3]) / factor
        panel.dot(m, "blue", 4.5)
        panel.text(m, f"({m[0]:g}, {m[1]:g})", "blue", dy=-9, bold=True)
        panel.text((0, 0), "(0, 0)", "soft", anchor="start", size=12, dy=-5)
        panel.text((w, h), f"({w}, {h})", "soft", anchor="end", size=12, dy=15)
        panel.save(f"camera-{name}", f"A grid of {w} by {h} pixels with their centres")


def main() -> None:
    pinhole()
    top_view()
    pixel_grid()


if __name__ == "__main__":
    main()
