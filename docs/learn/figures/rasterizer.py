"""Figures of the page "The tile rasterizer"."""

import numpy as np
import torch
from drawing import Drawing

import scene
from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.render import project

TILE = 16
#: Tile of the close-up: column and row.
CLOSE_UP = (13, 6)


def covariances(splats: Splats2D) -> np.ndarray:
    a, b, c = splats.conics.double().unbind(dim=1)
    det = a * c - b * b
    return torch.stack([c / det, -b / det, -b / det, a / det], dim=1).reshape(-1, 2, 2).numpy()


def largest_alpha(d0: np.ndarray, d1: np.ndarray, conic: np.ndarray, opacity: float) -> float:
    """The maximum of α over the rectangle [d0, d1], relative to the mean, by samples."""
    x = np.linspace(d0[0], d1[0], 61)
    y = np.linspace(d0[1], d1[1], 61)
    X, Y = np.meshgrid(
        np.append(x, np.clip(0, d0[0], d1[0])), np.append(y, np.clip(0, d0[1], d1[1]))
    )
    a, b, c = conic
    return float((opacity * np.exp(-0.5 * (a * X * X + c * Y * Y) - b * X * Y)).max())


def one_splat() -> None:
    covariance = np.array([[310.0, 235.0], [235.0, 200.0]])
    mean, opacity = np.array([97.0, 71.0]), 0.7
    inverse = np.linalg.inv(covariance)
    conic = np.array([inverse[0, 0], inverse[0, 1], inverse[1, 1]])
    k = np.sqrt(2 * np.log(255 * opacity))
    half = k * np.sqrt(covariance.diagonal())
    radius = 3 * np.sqrt(np.linalg.eigvalsh(covariance)[1])
    for name, extent in (("tiles", half), ("tiles-square", np.array([radius, radius]))):
        panel = Drawing(328, 248, x=(0, 192), y=(144, 0), margins=(4, 4, 4, 4))
        boxed = exact = 0
        for row in range(9):
            for column in range(12):
                low = TILE * np.array([column, row])
                first, last = low + 0.5, low + TILE - 0.5
                inside = bool(((mean + extent >= first) & (mean - extent <= last)).all())
                touched = (
                    inside and largest_alpha(first - mean, last - mean, conic, opacity) >= 1 / 255
                )
                boxed, exact = boxed + inside, exact + touched
                if name == "tiles":
                    opaque = 0.5 if touched else 0.16 if inside else 0.0
                else:
                    opaque = 0.3 if inside else 0.0
                panel.rectangle(low, low + TILE, "line", fill="blue", fill_opacity=opaque)
        panel.ellipse(mean, covariance, k, "orange", 2.4)
        panel.line(
            [mean - extent, mean + extent * [1, -1], mean + extent, mean + extent * [-1, 1]],
            "ink",
            1.2,
            dash="5 4",
            closed=True,
        )
        panel.dot(mean, "orange")
        print(name, "box", boxed, "exact", exact)
        panel.save(f"rasterizer-{name}", "An ellipse over a grid, with marked squares")


def keys() -> None:
    panel = Drawing(340, 270, x=(0, 340), y=(270, 0), margins=(0, 0, 0, 0))
    depths = {"A": 1.5, "B": 3.0, "C": 2.0, "D": 4.0}
    tiles = {"A": [0, 1], "B": [0, 1, 2, 3], "C": [3], "D": [1, 3]}
    colours = {"A": "blue", "B": "orange", "C": "green", "D": "violet"}
    instances = [(splat, tile) for splat in "ABCD" for tile in tiles[splat]]
    ordered = sorted(instances, key=lambda i: (i[1], depths[i[0]]))

    def chip(x: float, y: float, splat: str, tile: int) -> None:
        colour = colours[splat]
        panel.rectangle((x, y), (x + 92, y + 21), colour, fill=colour, fill_opacity=0.16)
        panel.text((x, y), f"{splat}:  {tile} | {depths[splat]}", dx=46, dy=15)

    panel.text((47, 14), "splat: tile | depth", size=12)
    panel.text((201, 14), "sorted", size=12)
    panel.text((300, 14), "ranges", size=12)
    top, step = 24, 27
    for i, (splat, tile) in enumerate(instances):
        chip(1, top + i * step, splat, tile)
        j = ordered.index((splat, tile))
        ends = [(95, top + i * step + 10.5), (153, top + j * step + 10.5)]
        panel.line(ends, colours[splat], 1.2)
        chip(155, top + j * step, splat, tile)
    for tile in range(4):
        rows = [j for j, instance in enumerate(ordered) if instance[1] == tile]
        low, high = top + rows[0] * step, top + rows[-1] * step + 21
        panel.line([(251, low), (258, low), (258, high), (251, high)], "ink", 1.4)
        words = f"tile {tile}: {rows[0]} to {rows[-1]}"
        panel.text((263, (low + high) / 2), words, anchor="start", dy=4, size=12)
    panel.save("rasterizer-keys", "A list of nine instances, connected with the sorted list")


def real() -> None:
    view = scene.camera(480)
    gaussians = scene.trained()
    splats = project(gaussians, view)
    full = scene.rendering(gaussians, view)
    covariance = covariances(splats)
    means = splats.means2d.numpy()
    opacity = splats.opacities.numpy()
    panel = Drawing(320, 240, margins=(0, 1, 0, 1))
    panel.picture(full, (0, 0), (1, 1))
    panel.save("rasterizer-image", "The scene")

    solid = gaussians.clone()
    solid.log_scales -= np.log(2)
    solid.opacity_logits[:] = 6.0
    panel = Drawing(320, 240, margins=(0, 1, 0, 1))
    panel.picture(scene.rendering(solid, view), (0, 0), (1, 1))
    panel.save("rasterizer-ellipses", "The Gaussians of the scene as solid ellipsoids")

    # Instances: the bounding box of {α ≥ 1/255}, and the exact test of the kernels by samples.
    k = np.sqrt(2 * np.log(255 * opacity))
    half = k[:, None] * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    columns, rows = -(-view.width // TILE), -(-view.height // TILE)
    size = np.array([columns, rows])
    low = np.floor((means - half - 0.5) / TILE).astype(int).clip(0, size - 1)
    high = np.floor((means + half - 0.5) / TILE).astype(int).clip(0, size - 1)
    counts = np.zeros((rows + 1, columns + 1), int)
    for (x0, y0), (x1, y1) in zip(low, high, strict=True):
        counts[y0, x0] += 1
        counts[y0, x1 + 1] -= 1
        counts[y1 + 1, x0] -= 1
        counts[y1 + 1, x1 + 1] += 1
    counts = counts.cumsum(axis=0).cumsum(axis=1)[:rows, :columns]
    print(
        f"{len(gaussians)} Gaussians, {len(splats)} visible; {columns} x {rows} tiles; "
        f"{counts.sum()} instances of bounding boxes; "
        f"per tile {counts.mean():.0f}, max {counts.max()}"
    )
    panel = Drawing(400, 300, x=(0, columns), y=(rows, 0), margins=(0, 0, 0, 0))
    share = (counts / counts.max()) ** 0.8
    stops = np.array([[20, 24, 60], [60, 60, 140], [180, 70, 110], [240, 150, 60], [250, 230, 120]])
    heat = np.stack(
        [np.interp(share, np.linspace(0, 1, 5), stops[:, c]) for c in range(3)], axis=-1
    )
    panel.picture(heat.astype(np.uint8), (0, 0), (columns, rows), pixelated=True)
    panel.rectangle(CLOSE_UP, (CLOSE_UP[0] + 1, CLOSE_UP[1] + 1), "page", width=2)
    panel.save("rasterizer-map", "A map of the tiles, coloured by the number of splats")

    # The close-up of a tile.
    pixels = reference._pixel_centres(TILE * CLOSE_UP[0], TILE * CLOSE_UP[1], TILE, TILE)
    in_tile = ((low <= CLOSE_UP) & (high >= CLOSE_UP)).all(axis=1).nonzero()[0]
    in_tile = torch.from_numpy(in_tile[np.argsort(splats.depths.numpy()[in_tile], kind="stable")])
    alpha, T, _ = reference._blend_weights(
        pixels, splats.means2d[in_tile], splats.conics[in_tile], opacities=splats.opacities[in_tile]
    )
    weights, values = alpha * T, splats.colors[in_tile]
    blended = (alpha > 0).any(dim=0)
    print(f"tile {CLOSE_UP}: {len(in_tile)} instances, {int(blended.sum())} blended")
    last = int(blended.nonzero()[-1, 0]) + 1
    for i, stop in enumerate((last // 8, last // 4, last // 2, last), 1):
        image = (weights[:, :stop] @ values[:stop]).reshape(TILE, TILE, 3)
        panel = Drawing(160, 184, margins=(0, 24, 0, 0))
        panel.title(f"{stop} splats")
        panel.picture(scene.pixels(image), (0, 0), (1, 1), pixelated=True)
        panel.save(f"rasterizer-blend-{i}", f"A tile after {stop} splats")


def main() -> None:
    one_splat()
    keys()
    real()


if __name__ == "__main__":
    main()
