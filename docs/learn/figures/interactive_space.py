"""The object of the interactive 3D figures: a glossy snowman, trained with few Gaussians.

Its photos are ray-traced here. The file has the Gaussians before the training, before and after
each densification with what became of them, and at the end with colours of degree 3.
"""

import base64
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import scene
from snowsplat import Camera, Gaussians
from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import pinhole_of
from snowsplat.data.load import load_dataset
from snowsplat.scene.geometry import look_at
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.densification import Densification
from snowsplat.training.settings.recipes import recipe

FILE = Path(__file__).resolve().parents[2] / "static" / "interactive" / "space-data.js"
SIZE, VIEWS, POINTS, MOST, STEPS = 96, 48, 90, 500, 1500
#: Centre, radius and colour of each ball. y is down.
BALLS = [
    ((0, 0.5, 0), 0.55, (0.6, 0.68, 0.8)),
    ((0, -0.28, 0), 0.38, (0.6, 0.68, 0.8)),
    ((0, -0.78, 0), 0.26, (0.6, 0.68, 0.8)),
    ((0.02, -0.76, -0.3), 0.08, (0.95, 0.45, 0.1)),
    ((-0.1, -0.86, -0.23), 0.05, (0.1, 0.1, 0.15)),
    ((0.1, -0.86, -0.23), 0.05, (0.1, 0.1, 0.15)),
    ((0, -0.3, -0.36), 0.06, (0.75, 0.1, 0.15)),
    ((0, -0.1, -0.33), 0.06, (0.75, 0.1, 0.15)),
    ((0.02, -1.08, 0), 0.17, (0.15, 0.3, 0.75)),
]
LIGHT = np.array([-0.5, -0.7, -0.5]) / np.linalg.norm([0.5, 0.7, 0.5])


def camera(number: int) -> Camera:
    height = 1 - 1.5 * (number + 0.5) / VIEWS
    azimuth, level = number * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - height**2)
    place = [level * math.cos(azimuth), -height, level * math.sin(azimuth)]
    position = 4 * torch.tensor(place, dtype=torch.float64)
    pose = look_at(position, torch.zeros_like(position), torch.tensor([0.0, -1.0, 0.0]).double())
    return Camera(SIZE, SIZE, 1.45 * SIZE, 1.45 * SIZE, SIZE / 2, SIZE / 2, pose)


def shaded(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (R, 3) over white, and distances (R,): diffuse light, and a highlight."""
    nearest, colours = np.full(len(rays), np.inf), np.ones((len(rays), 3))
    for centre, radius, colour in BALLS:
        b, c = rays @ (np.array(centre) - origin), ((origin - centre) ** 2).sum() - radius**2
        with np.errstate(invalid="ignore"):
            distance = b - np.sqrt(b * b - c)
        hit = distance < nearest
        normal = (origin + distance[hit, None] * rays[hit] - centre) / radius
        mirrored = rays[hit] - 2 * (rays[hit] * normal).sum(1)[:, None] * normal
        diffuse = 0.35 + 0.55 * np.clip(normal @ LIGHT, 0, 1)
        highlight = 0.8 * np.exp((mirrored @ LIGHT - 1) / 0.12)
        colours[hit] = diffuse[:, None] * colour + highlight[:, None]
        nearest[hit] = distance[hit]
    return colours.clip(0, 1), nearest


def write_photos(folder: Path) -> None:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    random, posed, points = np.random.default_rng(0), [], []
    corner = (np.arange(3 * SIZE) + 0.5) / 3 - SIZE / 2
    x, y = np.meshgrid(corner, corner)
    for i in range(VIEWS):
        view = camera(i)
        pose = view.world_from_cam.numpy()
        rays = np.stack([x / view.fx, y / view.fy, np.ones_like(x)], -1).reshape(-1, 3)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ pose[:, :3].T
        colours, distance = shaded(pose[:, 3], rays)
        pixels = colours.reshape(SIZE, 3, SIZE, 3, 3).mean((1, 3))
        name = f"{i:02d}.png"
        Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(folder / "images" / name)
        posed.append((name, pinhole_of(view), view.cam_from_world))
        seen = random.permutation(np.isfinite(distance).nonzero()[0])[: -(-POINTS // VIEWS)]
        where = pose[:, 3] + distance[seen, None] * rays[seen]
        points.append(np.concatenate([where, 255 * colours[seen]], 1))
    rows = np.concatenate(points)[:POINTS]
    write_posed(folder / "sparse" / "0", posed, rows[:, :3], np.rint(rows[:, 3:]).astype(np.uint8))


def trained() -> list[tuple[int, Gaussians, torch.Tensor]]:
    """Steps, Gaussians, and what became of each: 0 kept, 1 cloned, 2 split."""
    folder = scene.BUILD / "space"
    write_photos(folder)
    config = recipe(
        "classic",
        iterations=STEPS,
        background="white",
        coarse_to_fine=(0.0, 0.0),
        max_gaussians=MOST,
        densify_from=100,
        densify_until=300,
        densify_interval=100,
        percent_dense=0.03,
        test_iterations=(),
    )
    trainer = Trainer(load_dataset(folder, hold_out=None), config)
    stages = [(0, trainer.gaussians.map(torch.clone), torch.zeros(len(trainer.gaussians)))]
    part: Any = trainer.part(Densification)
    refine = type(part.control)._refine

    def recorded(control: Any, step: int, gaussians: Gaussians, optimizer: Any) -> Gaussians:
        stages.append((step, gaussians.map(torch.clone), torch.zeros(len(gaussians))))
        select = optimizer.select
        found: list[torch.Tensor] = []

        def chosen(index: torch.Tensor, fresh: torch.Tensor) -> None:
            found.extend((index, fresh))
            select(index, fresh)

        optimizer.select = chosen
        result: Gaussians = refine(control, step, gaussians, optimizer)
        optimizer.select = select
        index, fresh = found
        twice = torch.bincount(index, minlength=int(index.max()) + 1)[index] == 2
        kept = torch.zeros(int(index.max()) + 1, dtype=torch.bool)
        kept[index[~fresh]] = True
        born = torch.where(twice, torch.where(kept[index], 1, 2), 0)
        stages.append((step, result.map(torch.clone), born))
        return result

    type(part.control)._refine = recorded  # type: ignore[method-assign]
    trainer.run()
    type(part.control)._refine = refine  # type: ignore[method-assign]
    end = trainer.gaussians
    return [*stages, (STEPS, end, torch.zeros(len(end)))]


def packed(values: torch.Tensor, low: float, high: float, kind: str = "u1") -> bytes:
    top = {"u1": 255, "<u2": 65535}[kind]
    scaled = ((values.detach().double() - low) / (high - low)).clamp(0, 1) * top
    return scaled.round().numpy().astype(kind).tobytes()


def main() -> None:
    stages: list[list[int]] = []
    data = b""
    for step, gaussians, born in trained():
        stages.append([step, len(gaussians)])
        data += packed(gaussians.means, -2, 2, "<u2") + packed(gaussians.log_scales, -7, 1)
        data += packed(gaussians.rotations, -1, 1) + packed(gaussians.opacities, 0, 1)
        data += packed(gaussians.sh_dc, -2.5, 2.5) + born.numpy().astype("u1").tobytes()
    data += packed(gaussians.sh_rest.mT, -1, 1)
    text = base64.b64encode(data).decode()
    FILE.write_text(
        "// Made by docs/learn/figures/interactive_space.py: a training of a few Gaussians.\n"
        f'interactive.space = {{ stages: {stages}, data: "{text}" }};\n'
    )
    print(stages, len(text))


if __name__ == "__main__":
    main()
