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
    # Time runs down, so that the panels are narrow enough for a phone.
    for number, pair in enumerate(((0, 3), (1, 2)), 1):
        panel = Drawing(330, 500, x=(0, 2), y=(2027, 1982), margins=(40, 34, 4, 4))
        for year in range(1985, 2026, 5):
            panel.line([(0, year), (2, year)], "line", 1)
            panel.text((0, year), str(year), "soft", anchor="end", size=12, dx=-6, dy=4)
        for i, index in enumerate(pair):
            title, colour, events = LINES[index]
            x = 0.1 + 0.98 * i
            panel.text((x, 1982), title, colour, anchor="start", dx=-4, dy=-12, bold=True)
            panel.line([(x, events[0][0]), (x, 2023)], colour, 2.4)
            last = -1e9
            for year, words in events:
                shown = max(year, last + 1.45)
                panel.dot((x, year), colour, 4.5)
                panel.text((x, shown), words, anchor="start", dx=10, dy=4)
                last = shown
        panel.line([(0.1, 2023), (1.08, 2023)], "red", 3)
        panel.dot((0.59, 2023), "red", 6)
        panel.text((0.75, 2023), "3D Gaussian Splatting [25]", "red", dy=22, bold=True)
        panel.save(f"history-timeline-{number}", "Two lines of events that meet in 2023")


if __name__ == "__main__":
    main()
