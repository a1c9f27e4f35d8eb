"""Figures of the page "The PLY file"."""

import numpy as np
from drawing import Drawing

import scene

FIELDS = (
    ("x y z", 3, "blue"),
    ("normals", 3, "soft"),
    ("f_dc", 3, "orange"),
    ("f_rest: red", 15, "red"),
    ("f_rest: green", 15, "green"),
    ("f_rest: blue", 15, "blue"),
    ("opacity", 1, "ink"),
    ("scale", 3, "violet"),
    ("rot", 4, "orange"),
)


def row() -> None:
    # Two lines of 31 numbers, so that the squares are large enough on a phone.
    panel = Drawing(340, 150, x=(0, 31), y=(8.4, 0), margins=(2, 4, 2, 4))
    position = 0
    for words, count, colour in FIELDS:
        start = position
        for _ in range(count):
            line, column = divmod(position, 31)
            y = 1.4 + 4.2 * line
            panel.rectangle(
                (column + 0.06, y), (column + 0.94, y + 1.2), colour, fill=colour, fill_opacity=0.25
            )
            position += 1
        line, column = divmod(start, 31)
        if words == "f_rest: blue" or line == (position - 1) // 31:
            middle = (start + position) / 2 - 31 * line
            below = words in ("normals", "opacity", "rot")
            y = 1.4 + 4.2 * line + (2.15 if below else -0.4)
            panel.text((min(middle, 30.0), y), words, colour, size=12)
        else:
            panel.text((column + (31 - column) / 2, 1.4 - 0.45), words, colour, size=12)
    panel.save("ply-row", "A row of 62 squares in the colours of the fields")


def histograms() -> None:
    gaussians = scene.trained()
    for name, label, values, (low, high) in (
        ("opacity", "opacity (logit)", gaussians.opacity_logits, (-3, 8)),
        ("scale", "scale_0 … scale_2 (logarithm)", gaussians.log_scales.flatten(), (-13, 1)),
        ("dc", "f_dc_0 … f_dc_2", gaussians.sh_dc.flatten(), (-2.5, 2.5)),
    ):
        counts, edges = np.histogram(values.numpy(), 50, (low, high))
        share = counts / counts.max()
        panel = Drawing(222, 170, x=(low, high), y=(0, 1.05), margins=(6, 8, 6, 40))
        for left, right, height in zip(edges[:-1], edges[1:], share, strict=True):
            panel.rectangle((left, 0), (right, height), fill="blue", fill_opacity=0.75)
        panel.axes(label, y_ticks=[], counts=(5, 5))
        panel.save(f"ply-{name}", f"Histogram of {label}")
        print(name, values.quantile(0.5) if len(values) < 1e7 else "", float(values.mean()))


def main() -> None:
    row()
    histograms()


if __name__ == "__main__":
    main()
