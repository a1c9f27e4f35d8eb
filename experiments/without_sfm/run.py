"""Camera poses and Gaussians together, without structure from motion.

    python experiments/without_sfm/run.py DATASET --photos 12 --every 1 -r 4 -o OUT

takes photos of a dataset in the order of their names, and the intrinsics of its camera, but neither
its poses nor its points. The depths of the first photo and the poses of the next ones are found by
photometric alignment. Then each photo is aligned with the Gaussians so far, the Gaussians are
extended where nothing covers it, and all of them are refined. The poses of the dataset are used only
to measure the error. docs/experiments.md has the results.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch
from growing_map import GrowingMap, first_depths, image_loss, photo_gaussians
from poses import Poses

from snowsplat.data.image_loader import ImageLoader
from snowsplat.data.dataset import View
from snowsplat.data.load import load_dataset
from snowsplat.scene.geometry import invert_rigid
from snowsplat.scene.render import render

#: (factor of the photos, cells along the longer side of the depths, steps)
FIRST = [(4, 3, 150), (4, 6, 150), (2, 10, 150), (1, 16, 150), (1, 30, 150)]
TRACK = [(4, 30), (2, 30), (1, 40)]
WINDOW = 5
REFINE_STEPS = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--photos", type=int, default=12, help="number of photos")
    parser.add_argument("--first", type=int, default=0, help="index of the first photo")
    parser.add_argument("--every", type=int, default=1, help="use one photo in N")
    parser.add_argument("-r", "--resolution", type=int, default=4, help="reduce the photos")
    parser.add_argument("--start", type=int, default=3, help="number of photos for the first depths")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    dataset = load_dataset(options.dataset, resolution=options.resolution)
    views = dataset.train[options.first :: options.every][: options.photos]
    loader = ImageLoader(views)
    photos = [loader.get(view).over(torch.zeros(3)).contiguous() for view in views]
    started = time.process_time()
    poses = Poses(views[0].camera, len(views))
    inverse = first_depths(photos[: options.start], _first(poses, options.start), FIRST)
    scene = GrowingMap(poses, photos, photo_gaussians(photos[0], poses.camera_of(0, 1), inverse))
    scene.gaussians = scene.gaussians.detach()
    for i in range(len(views)):
        if i >= options.start:
            scene.track(i, TRACK)
        new = scene.extend(i) if i else len(scene.gaussians)
        near = list(range(max(0, i - WINDOW + 1), i + 1))
        scene.refine(near, REFINE_STEPS, generator)
        with torch.no_grad():
            loss = float(image_loss(render(scene.gaussians, poses.camera_of(i, 1)).image, photos[i]))
        print(f"photo {i}: {new} new Gaussians, {len(scene.gaussians)} in total, loss {loss:.4f}")
        if i >= 2:
            rotation, centre = errors(views[: i + 1], poses)
            print(f"    rotation {rotation:.2f} degrees, centre {100*centre:.1f} %", flush=True)
    scene.refine(list(range(len(views))), 30 * len(views), generator)
    print(errors(views, poses))
    print(f"{time.process_time() - started:.0f} s")


def _first(poses: Poses, count: int) -> Poses:
    """The poses of the first photos; shares memory with ``poses``."""
    part = Poses(poses.camera, count)
    part.base = poses.base[:count]
    return part


def errors(views: list[View], poses: Poses) -> tuple[float, float]:
    """The mean errors of the rotations (degrees) and of the camera centres (fraction of their
    extent), after a similarity transform that fits rotations and centres.
    """
    true = torch.stack([view.camera.cam_from_world.double() for view in views])
    found = poses.base[: len(views)]
    # The rotation of the world. The centres alone would not determine it if they are on a line.
    u, _, vt = torch.linalg.svd((true[:, :, :3].mT @ found[:, :, :3]).sum(0))
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))]).double()) @ vt
    relative = true[:, :, :3] @ turn @ found[:, :, :3].mT
    cosine = 0.5 * (relative.diagonal(dim1=1, dim2=2).sum(1) - 1.0)
    rotations = torch.rad2deg(torch.acos(cosine.clamp(-1.0, 1.0)))
    a, b = invert_rigid(found)[:, :, 3] @ turn.mT, invert_rigid(true)[:, :, 3]
    a, b = a - a.mean(0), b - b.mean(0)
    scale = (a * b).sum() / a.square().sum()
    centres = (scale * a - b).norm(dim=1) / torch.cdist(b, b).max()
    return float(rotations.mean()), float(centres.mean())


if __name__ == "__main__":
    main()
