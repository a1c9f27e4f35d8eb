"""The splats of the interactive figure "Tiles, keys and sort", of the scene of `snowsplat demo`.

From a part of a view, those with the largest sum of blending weights are kept.
"""

import json
from pathlib import Path

import torch

import scene
from snowsplat import Gaussians
from snowsplat.ops import reference
from snowsplat.scene.render import project

FILE = Path(__file__).resolve().parents[2] / "static" / "interactive" / "tiles-data.js"
#: The part of an image of WIDTH pixels: x, y of the corner, and 6×4 tiles.
WIDTH, CORNER, SIZE = 640, (280, 195), (96, 64)
COUNT = 64


def splats(gaussians: Gaussians) -> list[list[float]]:
    """x, y, conic (3), opacity, depth, red, green, blue of each splat, in the order of the file."""
    found = project(gaussians, scene.camera(WIDTH))
    corner = torch.tensor(CORNER, dtype=torch.float32)
    high = corner + torch.tensor(SIZE)
    near = ((found.means2d > corner - 40) & (found.means2d < high + 40)).all(1)
    rows = near.nonzero()[:, 0]
    front = rows[torch.argsort(found.depths[rows], stable=True)]
    alpha, T, _ = reference._blend_weights(
        reference._pixel_centres(*CORNER, *SIZE),
        found.means2d[front],
        found.conics[front],
        opacities=found.opacities[front],
    )
    best = front[(alpha * T).sum(0).topk(COUNT).indices].sort().values
    columns = [
        found.means2d[best] - corner,
        found.conics[best],
        found.opacities[best, None],
        found.depths[best, None],
        found.colors[best],
    ]
    return [[float(f"{v:.4g}") for v in row] for row in torch.cat(columns, dim=1).tolist()]


def main() -> None:
    rows = splats(scene.trained())
    lines = ",\n".join(json.dumps(row) for row in rows)
    FILE.write_text(
        "// Made by docs/learn/figures/interactive_tiles.py: splats of a part of a real scene.\n"
        "// x, y, conic (3), opacity, depth, red, green, blue; pixels.\n"
        f"interactive.tiles = [\n{lines},\n];\n"
    )


if __name__ == "__main__":
    main()
