"""What training shows beside the path of its photos: PSNR, SSIM, fog and depth, with truth.

    python benchmarks/beside.py --out OUT
    python benchmarks/beside.py --out OUT --scenes room street --seeds 0 1 --set decay_opacity=0.0
    python benchmarks/beside.py --out OUT --recipe classic

Every 8th photo is held out, on the path. The other views turn around what a photo shows in its
middle, 25° upwards and 30° aside, or stand at 0.6 and 1.6 times its distance; the truth is ray
traced. A view counts if nothing is between the middle and its camera, nothing is close before the
camera, and at least two photos show most of its pixels; only these pixels are compared. A pixel is
fog if the mean depth of the scene is less than 0.8 of the true one, and the colours differ by 0.1.
The time is that of the training and of the measure. OUT gets the photos and the images.
"""

import argparse
import itertools
import math
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mesh_scenes import SCENES, Procedural, shown_by, write_dataset
from PIL import Image
from torch import Tensor
from traced import DATASET_FROM_SCENE, depth_map, distances, points_of
from train import setting

from snowsplat import Trainer, load_dataset, recipe
from snowsplat.evaluation.metrics import compare
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import compose_rigid, invert_rigid, look_at
from snowsplat.scene.render import render, to_8bit
from snowsplat.synthetic.photographer import photograph
from snowsplat.synthetic.scene import Scene
from snowsplat.training.parts.part import Part
from snowsplat.training.settings.config import TrainConfig

#: Views of each kind and scene.
COUNT = 4
#: The kind of a view -> degrees upwards, degrees aside, and its share of the distance.
KINDS = {
    "above": (25.0, 0.0, 1.0),
    "aside": (0.0, 30.0, 1.0),
    "near": (0.0, 0.0, 0.6),
    "far": (0.0, 0.0, 1.6),
}
#: The least share of the pixels that two photos show, and the least depth of all but 2% of the
#: pixels, in units of the distance to the middle.
SEEN, NEAREST = 0.6, 0.3
#: A photo shows a point if its depth there differs by less than this share.
SAME_DEPTH = 0.03
#: Fog: the depth in units of the true one, and the mean difference of the colours.
BEFORE, DIFFERENT = 0.8, 0.1
#: What is farther away than this, in units of `Procedural.reach`, is the sky.
SKY = 8.0
_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True)
class View:
    """A true view: its photo (H, W, 3) in 0..1, its depth (H, W), and what photos show of it."""

    kind: str
    camera: Camera
    photo: Tensor
    depth: Tensor
    seen: Tensor  # (H, W) bool


def turned(cam_from_world: Tensor, distance: float, kind: str, side: int) -> Tensor:
    """A pose around the point at ``distance`` in the middle of the photo; ``side``: 1 or −1."""
    up, aside, share = KINDS[kind]
    world_from_cam = invert_rigid(cam_from_world)
    middle = world_from_cam[:, 3] + distance * world_from_cam[:, 2]
    away = -distance * world_from_cam[:, 2]
    height, turn = math.asin(float(away[2]) / distance), math.atan2(float(away[1]), float(away[0]))
    height, turn = min(height + math.radians(up), 1.5), turn + side * math.radians(aside)
    flat = math.cos(height)
    away = torch.tensor([flat * math.cos(turn), flat * math.sin(turn), math.sin(height)])
    return look_at(middle + share * distance * away.double(), middle, _UP)


def is_free(built: Scene, pose: Tensor, distance: float, depth: np.ndarray) -> bool:
    """Whether the camera sees the middle, and no wall from behind or object from inside."""
    if np.quantile(depth, 0.02) < NEAREST * distance:
        return False
    away = -pose[2:, :3].T.numpy().astype(np.float32)
    middle = invert_rigid(pose)[:, 3:].numpy().astype(np.float32) - distance * away
    return bool(distances(built, middle + 0.03 * distance * away, away)[0] > 0.97 * distance)


def views_of(folder: Path, scene: Procedural, near: float, width: int) -> list[View]:
    """The views of each kind, of photos that are spread over the path; they are kept in a file."""
    lens, stored = scene.lens(width), folder / "beside.pt"
    if stored.exists():
        return [View(**row) for row in torch.load(stored, weights_only=False)]
    depths = [depth_map(scene.built, lens, pose) for pose in scene.poses]
    views = []
    for kind in KINDS:
        found = 0
        for i in np.random.default_rng(0).permutation(len(scene.poses)):
            middle = depths[i][lens.height // 2, lens.width // 2]
            if found == COUNT or not middle < SKY * scene.reach:
                continue
            pose = turned(scene.poses[i], float(middle), kind, 1 - 2 * (found % 2))
            depth, distance = depth_map(scene.built, lens, pose), KINDS[kind][2] * float(middle)
            if not is_free(scene.built, pose, distance, depth):
                continue
            rows, columns = np.mgrid[: lens.height, : lens.width].reshape(2, -1)
            points = points_of(lens, pose, depth, rows, columns)
            seen = shown_by(points, scene, lens, depths, SAME_DEPTH)[2].reshape(depth.shape) > 1
            if seen.mean() < SEEN:
                continue
            moved = compose_rigid(pose, invert_rigid(DATASET_FROM_SCENE))
            size = lens.width, lens.height, *lens.params[:4]
            photo = photograph(scene.built, lens, pose, np.random.default_rng(i)) / np.float32(255)
            tensors = [torch.from_numpy(each) for each in (photo, depth, seen)]
            views.append(View(kind, Camera(*size, moved, near), *tensors))
            found += 1
    torch.save([vars(view) for view in views], stored)
    return views


def judged(gaussians: Gaussians, view: View, far: float) -> tuple[Any, ...]:
    """The image; PSNR, SSIM, share of fog, and median error of the depths, relative to the truth.

    ``far``: metres; what is beyond has no depth.
    """
    with torch.no_grad():
        shown = render(gaussians, view.camera, with_depth=True)
    assert shown.depth is not None
    figures = compare(shown.image, view.photo, view.seen)
    depth, truth = shown.depth / shown.alpha.clamp_min(1e-6), view.depth.clamp(max=far)
    wrong = (shown.image.clamp(0, 1) - view.photo).abs().mean(2) > DIFFERENT
    fog = (wrong & (depth < BEFORE * truth))[view.seen].float().mean()
    known = view.seen & (view.depth < far) & (shown.alpha > 0.5)
    error = (depth / truth - 1).abs()[known].median()
    return shown.image, figures.psnr, figures.ssim, float(fog), float(error)


def measured(
    out: Path, name: str, config: TrainConfig, width: int, parts: Sequence[Part] | None = None
) -> tuple[Trainer, dict[str, list[tuple[float, ...]]]]:
    """Train a scene of `mesh_scenes.SCENES`; the figures of `judged` by the kind of view."""
    scene, folder = SCENES[name](), out / f"{name}_{width}"
    write_dataset(folder, scene, width)
    dataset = load_dataset(folder, hold_out=8)
    views = views_of(folder, scene, dataset.train[0].camera.near, width)
    trainer = Trainer(dataset, config, parts=parts)
    trainer.run()
    figures = defaultdict(list)
    for i, view in enumerate(views):
        image, *found = judged(trainer.gaussians, view, SKY * scene.reach)
        figures[view.kind].append(tuple(found))
        pair = np.concatenate([to_8bit(view.photo), to_8bit(image)], axis=1)
        Image.fromarray(pair).save(out / f"{name}_{view.kind}{i}.png")
    return trainer, figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--width", type=int, default=200, help="of the photos, pixels")
    parser.add_argument("--iterations", type=int, default=800)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    options = parser.parse_args()
    settings = {"few_passes": 0.0, "iterations": options.iterations}
    settings |= dict(setting(text) for text in options.set)
    print("| scene | seed | CPU s | views | PSNR | SSIM | fog | depth error |")
    print("|---|---|---|---|---|---|---|---|")
    for name, seed in itertools.product(options.scenes, options.seeds):
        begin, config = time.process_time(), recipe(options.recipe, seed=seed, **settings)
        trainer, figures = measured(options.out, name, config, options.width)
        row, path = f"| {name} | {seed} | {time.process_time() - begin:.0f}", trainer.evaluate()
        print(f"{row} | path | {path.psnr:.2f} | {path.ssim:.3f} | | |")
        figures["mean"] = [tuple(np.mean(found, axis=0)) for found in figures.values()]
        for kind, found in figures.items():
            quality, ssim, fog, error = np.mean(found, axis=0)
            more = f"{quality:.2f} | {ssim:.3f} | {100 * fog:.1f}% | {100 * error:.1f}%"
            print(f"{row} | {kind} | {more} |", flush=True)


if __name__ == "__main__":
    main()
