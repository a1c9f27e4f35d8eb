"""How much of the PSNR that inexact poses cost comes back with `--refine-poses`.

    python benchmarks/refine_poses.py fox_small:2 fern:4 --seeds 3
    python benchmarks/robust.py out/scenes
    python benchmarks/refine_poses.py still:2 --datasets out/scenes --seeds 3

A dataset is NAME:RESOLUTION, as for `snowsplat train -r`. Each seed trains three scenes: with the
poses of the dataset, which are taken as exact, and with training poses that are disturbed as
`degrade.py` does, without and with refinement. The poses of the held-out photos are exact.

The photos cannot determine a similarity transform of the whole scene (docs/cameras.md, "The
gauge"). So the held-out cameras are moved by the one between the exact and the present training
poses, by least squares of the pixels that they differ. The first PSNR of a line is without this
alignment. An error in pixels is the mean over the training photos, after the alignment.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import torch
from degrade import disturbed_pose
from torch import Tensor

from snowsplat import Dataset, Trainer, load_dataset, ops, recipe
from snowsplat.data.dataset import View
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.scene.geometry import compose_rigid, invert_rigid
from snowsplat.training.parts.pose_coordinates import (
    after_motion,
    gauge_motions,
    pixel_hessian,
    whitening,
)

ROOT = Path(__file__).resolve().parents[1]


def disturbed(dataset: Dataset, degrees: float, share: float, seed: int) -> Dataset:
    """The dataset with other training poses, those that `degrade.py` writes with this seed."""
    generator = torch.Generator().manual_seed(seed)
    trained = {view.name for view in dataset.train}
    views = {}
    for view in sorted([*dataset.train, *dataset.test], key=lambda view: view.name):
        pose = view.camera.cam_from_world.double()
        pose = disturbed_pose(pose, generator, degrees, share * dataset.extent)
        if view.name in trained:  # a held-out one uses its random numbers, too
            camera = replace(view.camera, cam_from_world=pose.to(view.camera.cam_from_world.dtype))
            views[view.name] = replace(view, camera=camera)
    return replace(dataset, train=[views[view.name] for view in dataset.train])


def motion_between(first: Tensor, second: Tensor) -> Tensor:
    """(6,): the motion (ω, τ) from a pose to another, to first order; see `pose_coordinates`."""
    pose = compose_rigid(second.double(), invert_rigid(first.double()))
    turn = (pose[:, :3] - pose[:, :3].T) / 2
    return torch.cat([torch.stack([turn[2, 1], turn[0, 2], turn[1, 0]]), pose[:, 3]])


def aligned(exact: Dataset, present: list[View]) -> tuple[list[View], float]:
    """The test views after the similarity transform from the exact training poses to the present
    ones, and the mean error of the latter in pixels."""
    cameras = [view.camera for view in exact.train]
    pixels = torch.stack(
        [torch.linalg.inv(whitening(pixel_hessian(c, exact)[:6, :6])) for c in cameras]
    )
    pairs = zip(cameras, present, strict=True)
    motions = torch.stack(
        [motion_between(c.cam_from_world, view.camera.cam_from_world) for c, view in pairs]
    )
    centre = torch.stack([camera.position.double() for camera in cameras]).mean(0)
    columns = pixels @ gauge_motions(cameras, centre, exact.extent)  # (V, 6, 7)
    errors = torch.einsum("vij,vj->vi", pixels, motions)
    gauge = torch.linalg.lstsq(columns.flatten(0, 1), errors.flatten()[:, None]).solution[:, 0]
    remaining = (errors - columns @ gauge).norm(dim=1).mean()
    held_out = [view.camera for view in exact.test]
    poses = [
        after_motion(camera.cam_from_world.double(), motion).to(camera.cam_from_world.dtype)
        for camera, motion in zip(
            held_out, gauge_motions(held_out, centre, exact.extent) @ gauge, strict=True
        )
    ]
    views = [
        replace(view, camera=replace(view.camera, cam_from_world=pose))
        for view, pose in zip(exact.test, poses, strict=True)
    ]
    return views, float(remaining)


def measure(exact: Dataset, used: Dataset, seed: int, refine: bool, steps: int) -> float:
    """Train; print a line; the aligned PSNR in dB."""
    config = recipe("default", iterations=steps, seed=seed, refine_poses=refine, test_iterations=())
    trainer = Trainer(used, config)
    trainer.run()
    views, error = aligned(exact, trainer.poses.views())
    focal = zip(views, trainer.poses.test_views(), strict=True)
    views = [
        replace(view, camera=replace(view.camera, fx=other.camera.fx, fy=other.camera.fy))
        for view, other in focal
    ]
    found = evaluate_views(trainer.gaussians, views).psnr
    unaligned = trainer.evaluate().psnr
    poses = "exact" if used is exact else "disturbed"
    print(
        f"  seed {seed}, {poses}, {'on' if refine else 'off'}: {unaligned:.2f} dB, "
        f"aligned {found:.2f} dB, {error:.2f} pixels",
        flush=True,
    )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="+", metavar="NAME:RESOLUTION")
    parser.add_argument("--rotation", type=float, default=0.3, metavar="DEGREES")
    parser.add_argument("--translation", type=float, default=0.005, metavar="SHARE")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--datasets", type=Path, default=ROOT.parent / "shared" / "captures")
    flags = parser.parse_args()
    ops.set_num_threads(1)
    for capture in flags.captures:
        name, _, resolution = capture.partition(":")
        dataset = load_dataset(flags.datasets / name, resolution=int(resolution or 1))
        print(f"{name}, {dataset.train[0].camera.width} x {dataset.train[0].camera.height}")
        for seed in range(flags.first_seed, flags.first_seed + flags.seeds):
            wrong = disturbed(dataset, flags.rotation, flags.translation, seed)
            best, off, on = (
                measure(dataset, used, seed, refine, flags.iterations)
                for used, refine in ((dataset, False), (wrong, False), (wrong, True))
            )
            share = (on - off) / (best - off) if best > off else math.nan
            print(f"  seed {seed}: {100 * share:.0f}% of {best - off:.2f} dB back", flush=True)


if __name__ == "__main__":
    main()
