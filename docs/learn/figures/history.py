"""Figure of the page "History": a timeline."""

from drawing import Drawing

LINES = (
    (
        "points and splats",
        "blue",
        (
            (1985, "points [1]"),
            (1990, "footprints [4]"),
            (2000, "surfels [6]"),
            (2001.6, "EWA [8, 9]"),
        ),
    ),
    (
        "volume rendering",
        "green",
        (
            (1984, "densities [3]"),
            (1995, "models [5]"),
            (2020, "NeRF [14]"),
            (2021.8, "Plenoxels [15]"),
        ),
    ),
    (
        "photos to points",
        "violet",
        ((2004, "SIFT [11]"), (2006, "Photo Tourism [12]"), (2016, "COLMAP [13]")),
    ),
    (
        "learned points",
        "orange",
        ((2019, "surface splats [18]"), (2020.5, "Pulsar [21]"), (2021.5, "per view [22]")),
    ),
)


def main() -> None:
    # Time runs down, so that the figure is narrow enough for a phone.
    panel = Drawing(680, 560, x=(0, 4.4), y=(2025, 1982), margins=(46, 34, 8, 10))
    for year in range(1985, 2026, 5):
        panel.line([(0, year), (4.4, year)], "line", 1)
        panel.text((0, year), str(year), "soft", anchor="end", size=14, dx=-8, dy=5)
    for i, (title, colour, events) in enumerate(LINES):
        x = 0.12 + 1.1 * i
        panel.text((x, 1982), title, colour, anchor="start", size=16, dx=-4, dy=-12, bold=True)
        first = events[0][0]
        panel.line([(x, first), (x, 2023)], colour, 2.4)
        last = -1e9
        for year, words in events:
            shown = max(year, last + 1.25)
            panel.dot((x, year), colour, 5)
            panel.text((x, shown), words, anchor="start", size=15, dx=11, dy=5)
            last = shown
    panel.line([(0.12, 2023), (0.12 + 3.3, 2023)], "red", 3)
    panel.dot((1.77, 2023), "red", 7)
    panel.text((1.77, 2023), "3D Gaussian Splatting [25]", "red", dy=24, size=17, bold=True)
    panel.save("history-timeline", "Four vertical lines of events that meet in 2023")


if __name__ == "__main__":
    main()
