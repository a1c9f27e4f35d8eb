"""Writes procedural datasets, without and with something that moves, for `recipes.py`.

    python benchmarks/robust.py out/scenes
    python benchmarks/recipes.py default default:transients=auto --datasets out/scenes \\
        --captures still moving --hold-outs eighth --seeds 5 --out out/moving

    still     the still life of `snowsplat demo`, without lens distortion; exact poses
    moving    the same photos, but a person is in 20% of them, each time at another place. The
              photos that are held out (every 8th) are those of `still`

The points are those of the true surfaces, with an error of about a pixel.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import invert_rigid
from snowsplat.synthetic.photographer import Lens, phone_lens, take_photos, walk
from snowsplat.synthetic.scene import Scene
from snowsplat.synthetic.still_life import still_life

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from passer_by import chosen_photos, passers_by, shooting
from tests.scenes.depth import depth_map

COUNT = 48
SIZE = (400, 300)
#: Share of the photos with the person.
SHARE = 0.2
#: Points of a photo, and the standard deviation of their depths, relative.
POINTS, POINT_ERROR = 120, 0.004


def write_dataset(
    folder: Path,
    scene: Scene,
    lens: Lens,
    poses: Sequence[Tensor],
    seed: int,
    passing: Mapping[int, Scene] | None = None,
) -> None:
    """A dataset of COLMAP with the true poses."""
    images = folder / "images"
    truth = take_photos(
        images, lambda: scene, lens, poses, seed, shoot=shooting(lens, poses, passing or {})
    )
    random = np.random.default_rng(seed)
    found = [
        _points(images / name, scene, lens, pose, random) for name, pose in truth.poses.items()
    ]
    camera = lens_of("PINHOLE", lens.width, lens.height, lens.params[:4])
    xyz, rgb = (np.concatenate(parts) for parts in zip(*found, strict=True))
    posed = [(name, camera, pose) for name, pose in truth.poses.items()]
    write_posed(folder / "sparse" / "0", posed, xyz, rgb)


def _points(
    photo: Path, scene: Scene, lens: Lens, cam_from_world: Tensor, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) float64 in the world frame and their colours (P, 3) uint8."""
    depth = depth_map(scene, lens, cam_from_world)
    y, x = np.nonzero(np.isfinite(depth))
    chosen = random.choice(len(x), min(POINTS, len(x)), replace=False)
    x, y = x[chosen], y[chosen]
    rays = lens.directions(np.stack([x + 0.5, y + 0.5]))
    z = depth[y, x] * (1 + POINT_ERROR * random.standard_normal(len(x)))
    world_from_cam = invert_rigid(cam_from_world).numpy()
    xyz = (world_from_cam[:, :3] @ (rays / rays[2] * z)).T + world_from_cam[:, 3]
    with Image.open(photo) as image:
        return xyz, np.asarray(image)[y, x]


def still_and_moving(out: Path, seed: int) -> None:
    lens = phone_lens(*SIZE, distortion=(0.0, 0.0, 0.0, 0.0))
    poses = walk(COUNT, seed)
    scene = still_life(seed)
    write_dataset(out / "still", scene, lens, poses, seed)
    photos = chosen_photos(COUNT, SHARE, seed)
    passing = passers_by([(i, poses[i]) for i in photos], seed)
    images = out / "moving" / "images"
    images.mkdir(parents=True, exist_ok=True)
    for path in sorted((out / "still" / "images").iterdir()):
        if int(path.stem[-4:]) - 1 not in passing:
            shutil.copyfile(path, images / path.name)
    write_dataset(out / "moving", scene, lens, poses, seed, passing)
    # Points on the surfaces, with the colours of the photos without the person.
    shutil.copytree(out / "still" / "sparse", out / "moving" / "sparse", dirs_exist_ok=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder for the datasets")
    parser.add_argument("--seed", type=int, default=0, help="seed of the scene")
    flags = parser.parse_args(arguments)
    still_and_moving(flags.out, flags.seed)


if __name__ == "__main__":
    main()
