"""Camera poses and Gaussians together, without structure from motion.

    python experiments/without_sfm/run.py DATASET -r 4 --photos 16 -o OUT

takes the first photos of a dataset in the order of their names, and the intrinsics of its camera,
but neither its poses nor its points:

1. The depths of the first photo and the poses of the next ones are found together, by photometric
   alignment from coarse to fine.
2. Each further photo is aligned with the Gaussians so far. The Gaussians are extended where nothing
   covers the photo, and refined together with the poses of the last photos.
3. All Gaussians and poses are refined.
4. With these poses, a scene is trained as usual, and so is one with the poses and points of the
   dataset. Every 8th photo is held out from 2, 3 and 4; only its pose is estimated.

The poses of the dataset are used only to measure errors and for the comparison in step 4. Writes
OUT/result.json and OUT/held_out.png: for each held-out photo, the photo, the scene with the poses
found here, and the scene with the poses of the dataset.

    python experiments/without_sfm/run.py PHOTOS -o OUT && snowsplat train OUT -o OUT/scene

takes a folder of photos without poses, in the order of their names: steps 1 to 3. The focal length
is that of the EXIF data, or that of phones. OUT is then a dataset: photos, poses and points.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from growing_map import GrowingMap, first_depths, photo_gaussians
from PIL import Image
from poses import Poses
from torch import Tensor

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.lens.models import pinhole_of
from snowsplat.data.load import load_dataset
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.lift.lift_photo import read_photo
from snowsplat.pipeline.output.image_files import write_png
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import invert_rigid
from snowsplat.scene.render import render, to_8bit
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe

SUFFIXES = (".jpg", ".jpeg", ".png")
#: Number of photos whose poses are found together with the first depths.
START = 5
#: (factor of the photos, cells along the longer side of the depths, steps)
FIRST = [(8, 3, 200), (4, 4, 200), (4, 8, 200), (2, 14, 300), (1, 30, 300)]
#: (factor of the photos, steps)
TRACK = [(4, 60), (2, 60), (1, 60)]
#: Number of last photos whose poses are refined, and steps.
WINDOW, REFINE_STEPS = 8, 200
#: Steps per photo at the end.
LAST_STEPS = 30
TRAIN_STEPS = 1000


@dataclass(frozen=True)
class Found:
    """What the photos alone gave; ``errors``: after each photo, see `errors_of`."""

    scene: GrowingMap
    errors: list[tuple[float, float]]


def held_out(i: int) -> bool:
    return i >= START and i % 8 == 7


def find(
    camera: Camera, photos: list[Tensor], generator: torch.Generator, views: list[View] | None
) -> Found:
    """Steps 1 to 3. ``views``: the same photos with known poses, for `Found.errors`."""
    poses = Poses(camera, len(photos))
    first = poses.part(START)
    inverse = first_depths(photos[:START], first, FIRST)
    start = photo_gaussians(photos[0], poses.camera_of(0, 1), inverse).detach()
    scene = GrowingMap(poses, photos, start)
    used: list[int] = []
    errors = []
    for i in range(len(photos)):
        if i >= START:
            scene.track(i, TRACK)
        if views is None or not held_out(i):
            used.append(i)
            if i > 0:
                scene.extend(i)
            scene.refine(used[-WINDOW:], REFINE_STEPS, generator)
        if views is None:
            print(f"photo {i}: {len(scene.gaussians):,} Gaussians", flush=True)
        elif i >= 2:
            errors.append(errors_of(views[: i + 1], poses.base[: i + 1]))
            print(
                f"photo {i}: rotations {errors[-1][0]:.2f}°, centres {errors[-1][1]:.1%}",
                flush=True,
            )
    scene.refine(used, LAST_STEPS * len(used), generator)
    if views is not None:
        errors.append(errors_of(views, poses.base))
    return Found(scene, errors)


def errors_of(views: list[View], found: Tensor) -> tuple[float, float]:
    """The mean errors of the rotations (degrees) and of the camera centres (fraction of their
    extent), after a similarity transform that fits rotations and centres.
    """
    true = torch.stack([view.camera.cam_from_world.double() for view in views])
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


def trained(views: list[View], points: Points, seed: int) -> Gaussians:
    """A scene of the photos that are not held out."""
    used = [view for i, view in enumerate(views) if not held_out(i)]
    centres = torch.stack([view.camera.position for view in used]).float()
    extent = 1.1 * float((centres - centres.mean(0)).norm(dim=1).max())
    config = recipe("default", iterations=TRAIN_STEPS, init="points", seed=seed)
    trainer = Trainer(Dataset(used, [], points, extent), config)
    trainer.run()
    return trainer.gaussians


def aligned(gaussians: Gaussians, views: list[View], photos: list[Tensor]) -> list[Tensor]:
    """The renders of the held-out photos. First, each pose is aligned with the scene, with the
    photo as the only target: otherwise, an error of the pose would count as one of the scene.
    """
    poses = Poses(views[0].camera, len(views))
    poses.base = torch.stack([view.camera.cam_from_world.double() for view in views])
    scene = GrowingMap(poses, photos, gaussians)
    renders = []
    for i in (i for i in range(len(views)) if held_out(i)):
        scene.align(i, 2, 60)
        scene.align(i, 1, 100)
        with torch.no_grad():
            renders.append(render(gaussians, poses.camera_of(i, 1)).image.clamp(0.0, 1.0))
    return renders


def without_poses(folder: Path, most: int, side: int, seed: int, out: Path) -> None:
    """Find the poses of a folder of photos, and write the dataset."""
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)[:most]
    if len(files) < START:
        raise SystemExit(f"{folder}: needs at least {START} photos")
    read = [read_photo(file, side, None) for file in files]
    if len({image.shape for image, _, _ in read}) > 1:
        raise SystemExit(f"{folder}: the photos have different sizes")
    camera, photos = read[0][1], [image.contiguous() for image, _, _ in read]
    print(f"{len(photos)} photos of {camera.width}x{camera.height}; focal length {read[0][2]}")
    scene = find(camera, photos, torch.Generator().manual_seed(seed), None).scene
    (out / "images").mkdir(parents=True, exist_ok=True)
    for file, image in zip(files, photos, strict=True):
        write_png(out / "images" / f"{file.stem}.png", to_8bit(image))
    names = [f"{file.stem}.png" for file in files]
    posed = zip(names, [pinhole_of(camera)] * len(names), scene.poses.base, strict=True)
    xyz, rgb = scene.gaussians.means, to_8bit(scene.gaussians.base_colors[None])[0]
    write_posed(out / "sparse" / "0", posed, xyz.double().numpy(), rgb)
    print(f"{out}: poses and {len(xyz):,} points; next: snowsplat train {out} -o {out / 'scene'}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="a dataset, or a folder of photos without poses")
    parser.add_argument("--photos", type=int, default=16, help="number of photos, at least 8")
    parser.add_argument("-r", "--resolution", type=int, default=4, help="reduce those of a dataset")
    parser.add_argument("--side", type=int, default=160, help="pixels of photos without poses")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if not any((options.dataset / name).exists() for name in ("sparse", "transforms.json")):
        without_poses(options.dataset, options.photos, options.side, options.seed, options.out)
        return
    dataset = load_dataset(options.dataset, resolution=options.resolution)
    views = dataset.train[: options.photos]
    if len(views) < 8 or dataset.points is None:
        parser.error(f"{options.dataset}: needs at least 8 photos and the points to compare with")
    loader = ImageLoader(views)
    photos = [loader.get(view).over(torch.zeros(3)).contiguous() for view in views]

    started = time.process_time()
    generator = torch.Generator().manual_seed(options.seed)
    found = find(views[0].camera, photos, generator, views)
    seconds = time.process_time() - started
    own = [
        replace(view, camera=replace(view.camera, cam_from_world=found.scene.poses.base[i].clone()))
        for i, view in enumerate(views)
    ]
    gaussians = found.scene.gaussians
    colors = (255.0 * gaussians.base_colors.clamp(0.0, 1.0)).to(torch.uint8)
    renders = {
        "found": aligned(trained(own, Points(gaussians.means, colors), options.seed), own, photos),
        "dataset": aligned(trained(views, dataset.points, options.seed), views, photos),
    }
    tested = [i for i in range(len(views)) if held_out(i)]
    values = {
        arm: [psnr(image, photos[i]) for image, i in zip(images, tested, strict=True)]
        for arm, images in renders.items()
    }
    result = {
        "dataset": options.dataset.name,
        "photos": len(views),
        "width": views[0].camera.width,
        "height": views[0].camera.height,
        "seed": options.seed,
        "seconds": round(seconds, 1),
        "rotation_degrees": found.errors[-1][0],
        "centre_fraction": found.errors[-1][1],
        "after_each_photo": found.errors,
        "psnr": values,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    rows = [
        torch.cat([photos[i], a, b], dim=1)
        for i, a, b in zip(tested, *renders.values(), strict=True)
    ]
    picture = (255.0 * torch.cat(rows)).round().to(torch.uint8).numpy()
    Image.fromarray(np.ascontiguousarray(picture)).save(options.out / "held_out.png")
    means = {arm: round(sum(each) / len(each), 2) for arm, each in values.items()}
    print(
        f"{len(views)} photos, {seconds:.0f} s: rotations {found.errors[-1][0]:.2f}°, centres "
        f"{found.errors[-1][1]:.1%} of the extent; PSNR {means}"
    )


if __name__ == "__main__":
    main()
