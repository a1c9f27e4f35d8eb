"""Lifts a photo of the synthetic still life, whose depth is known, and measures other viewpoints.

    python experiments/lift_still_life.py -o OUT

Writes lift_still_life.json beside this file, and the pictures of docs/guides/lift.md to OUT.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from snowsplat.data import load_dataset
from snowsplat.data.colmap.model import write_model
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.data.lens.models import lens_of
from snowsplat.evaluation.metrics import psnr
from snowsplat.extras.lift.lift import lift
from snowsplat.extras.lift.options import DepthSource, LiftOptions
from snowsplat.extras.lift.refine_photo import refine_photo
from snowsplat.pipeline.output.image_files import depth_in_color, to_8bit
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import invert_rigid, look_at, quat_from_rotation, transform_points
from snowsplat.scene.render import render
from snowsplat.synthetic.photographer import Lens, depth_map, phone_lens, photograph, walk
from snowsplat.synthetic.scene import Scene
from snowsplat.synthetic.still_life import still_life
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe

RESULTS = Path(__file__).with_suffix(".json")
WIDTH, HEIGHT = 512, 384
DISTANCE = 1.42  # metres, from the camera to the middle of the table
SHIFTS = (0.0, 0.05, 0.1, 0.2, 0.4)  # metres to the right; all cameras look at the middle
COVERED = 0.5  # alpha
NO_EDGES = 1e9
BLUR = 5  # pixels, width of the mean filter
# The dataset for the refinement: photos on an arc around the lifted one, every second held out.
ARC = (-0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45)  # metres
POINTS, POINT_NOISE = 2000, 0.002  # metres
SMALL = (256, 192)
ITERATIONS = 1000


@dataclass(frozen=True)
class Shot:
    """A ray-traced photo (H, W, 3) uint8, its depth (H, W) in metres, and its camera."""

    pixels: np.ndarray
    depth: np.ndarray
    camera: Camera

    @property
    def photo(self) -> Tensor:
        return torch.from_numpy(self.pixels).float() / 255


def shifted(pose: Tensor, metres: float) -> Tensor:
    """The pose of a camera that is moved to the right and looks at the same point."""
    world_from_cam = invert_rigid(pose)
    position, rotation = world_from_cam[:, 3], world_from_cam[:, :3]
    target = position + DISTANCE * rotation[:, 2]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return look_at(position + metres * rotation[:, 0], target, up)


def take(scene: Scene, lens: Lens, pose: Tensor, seed: int) -> Shot:
    """A photo with the noise of a sensor, without lens distortion."""
    camera = Camera(
        *(lens.width, lens.height, lens.focal, lens.focal),
        *(lens.width / 2, lens.height / 2, pose),
    )
    pixels = photograph(scene, lens, pose, np.random.default_rng(seed))
    return Shot(pixels, depth_map(scene, lens, pose), camera)


@torch.no_grad()
def seen_from(gaussians: Gaussians, shot: Shot) -> tuple[Tensor, dict[str, float]]:
    """The image at a pose, its PSNR where it is covered, and the covered share."""
    output = render(gaussians, shot.camera)
    covered = output.alpha > COVERED
    return output.image, {
        "psnr_covered": round(psnr(output.image.clamp(0, 1), shot.photo, covered), 2),
        "covered": round(float(covered.float().mean()), 3),
    }


def measure_viewpoints(shots: list[Shot], out: Path) -> list[dict[str, Any]]:
    """A row per kind of lift; writes pictures."""
    first = shots[0]
    exact = torch.from_numpy(first.depth)
    # Networks blur the discontinuities of their depth maps.
    margin = BLUR // 2
    padded = F.pad(exact[None, None], [margin] * 4, mode="replicate")
    blurred = F.avg_pool2d(padded, BLUR, 1)[0, 0]
    kinds = {
        "a Gaussian per pixel": (exact, LiftOptions()),
        "100,000 Gaussians": (exact, LiftOptions(max_gaussians=100_000)),
        "40,000 Gaussians": (exact, LiftOptions(max_gaussians=40_000)),
        "15,000 Gaussians": (exact, LiftOptions(max_gaussians=15_000)),
        "blurred depth": (blurred, LiftOptions()),
        "blurred depth, not cut": (blurred, LiftOptions(edge=NO_EDGES)),
    }
    rows, pictures = [], {}
    for name, (depth, options) in kinds.items():
        start = time.process_time()
        gaussians = lift(first.photo, depth, first.camera, options)
        seconds = round(time.process_time() - start, 1)
        views = []
        for metres, shot in zip(SHIFTS, shots, strict=True):
            image, measured = seen_from(gaussians, shot)
            views.append({"metres": metres, **measured})
            pictures[name, metres] = to_8bit(image)
        rows.append(
            {"kind": name, "gaussians": len(gaussians), "cpu_seconds": seconds, "views": views}
        )
        print(rows[-1], flush=True)
    colored = depth_in_color(first.depth, *np.percentile(first.depth, [1, 99]))
    pixel = "a Gaussian per pixel"
    save(out / "lift.webp", [[first.pixels, colored], [pictures[pixel, 0.1], pictures[pixel, 0.4]]])
    cut = np.s_[120:312, 256:512]
    sheets = [pictures["blurred depth, not cut", 0.2], pictures["blurred depth", 0.2]]
    save(out / "lift-edges.webp", [[np.repeat(np.repeat(p[cut], 2, 0), 2, 1) for p in sheets]])
    fewer = [pictures["40,000 Gaussians", 0.1], pictures["15,000 Gaussians", 0.1]]
    save(out / "lift-fewer.webp", [fewer])
    return rows


def save(path: Path, rows: list[list[np.ndarray]]) -> None:
    """A WebP picture of images in rows."""
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    Image.fromarray(sheet).save(path, quality=80, method=6)


def write_dataset(folder: Path, shots: list[Shot]) -> None:
    """A COLMAP model with the true poses, and noisy points on the surfaces that are seen."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    random, images, xyz, rgb = np.random.default_rng(0), [], [], []
    for number, shot in enumerate(shots):
        name, camera = f"{number}.png", shot.camera
        Image.fromarray(shot.pixels).save(folder / "images" / name)
        pose = camera.cam_from_world
        quat = quat_from_rotation(pose[:, :3])
        images.append(ColmapImage(name, 1, (*quat.tolist(), *pose[:, 3].tolist())))
        row = random.integers(0, camera.height, POINTS // len(shots))
        column = random.integers(0, camera.width, POINTS // len(shots))
        z = shot.depth[row, column]
        x = (column + 0.5 - camera.cx) / camera.fx * z
        y = (row + 0.5 - camera.cy) / camera.fy * z
        points = transform_points(camera.world_from_cam, torch.from_numpy(np.stack([x, y, z], 1)))
        xyz.append(points.numpy() + random.normal(0, POINT_NOISE, points.shape))
        rgb.append(shot.pixels[row, column])
    camera = shots[0].camera
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    model = {1: lens_of("PINHOLE", camera.width, camera.height, intrinsics)}
    write_model(folder / "sparse" / "0", model, images, np.concatenate(xyz), np.concatenate(rgb))


def measure_refinement(scene: Scene, base: Tensor, out: Path) -> dict[str, Any]:
    """The held-out PSNR with and without a lifted photo at the start."""
    lens = phone_lens(*SMALL, (0.0, 0.0, 0.0, 0.0))
    shots = [take(scene, lens, shifted(base, metres), i) for i, metres in enumerate(ARC)]
    folder = out / "arc"
    write_dataset(folder, shots)
    middle = len(ARC) // 2
    # As the output of a network: inverse depth with an unknown scale and shift.
    np.save(out / "disparity.npy", 3.7 / shots[middle].depth + 0.8)
    source = DepthSource(map=out / "disparity.npy", kind="disparity")
    result = refine_photo(
        folder / "images" / f"{middle}.png",
        *(out / "refined", source, folder),
        iterations=ITERATIONS,
        hold_out=2,
        overwrite=True,
    )
    assert result.evaluation is not None
    assert result.alignment is not None
    psnrs = {}
    for name, settings in {"default": {}, "points only": {"init": "points"}}.items():
        config = recipe("default", iterations=ITERATIONS, **settings)
        trainer = Trainer(load_dataset(folder, hold_out=2), config)
        trainer.run()
        psnrs[name] = round(trainer.evaluate().psnr, 2)
    return {
        "photos": len(ARC),
        "iterations": ITERATIONS,
        "alignment_median_error": result.alignment.error,
        "held_out_psnr": {"lifted photo": round(result.evaluation.psnr, 2), **psnrs},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    out: Path = parser.parse_args().output
    out.mkdir(parents=True, exist_ok=True)
    scene, base = still_life(0), walk(24, 0)[0]
    lens = phone_lens(WIDTH, HEIGHT, (0.0, 0.0, 0.0, 0.0))
    shots = [take(scene, lens, shifted(base, metres), i) for i, metres in enumerate(SHIFTS)]
    viewpoints = measure_viewpoints(shots, out)
    refinement = measure_refinement(scene, base, out)
    results = {"seed": 0, "viewpoints": viewpoints, "refinement": refinement}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
