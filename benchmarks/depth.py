"""PSNR and depth error of a room, with and without depth and normal maps in the loss.

    python benchmarks/depth.py -o out/depth --maps none true scaled wrong
    python benchmarks/depth.py -o out/depth --maps none --normals none true noisy wrong \\
        --set depth_weight=0.2
    python benchmarks/depth.py -o out/depth --maps none --set depth_weight=0.2 surfaces=True

Ray-traced photos of a still life in a room, with the true poses and noisy points as structure from
motion finds them. The true depth of the held-out photos is compared with the rendered one.
"""

import argparse
import itertools
import json
import resource
import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.nn.functional import interpolate, normalize
from traced import depth_map, write_traced
from train import setting

from snowsplat import Trainer, load_dataset, recipe
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import render
from snowsplat.scene.surface_normals import normals_of_depth
from snowsplat.synthetic.photographer import phone_lens, walk
from snowsplat.synthetic.still_life import still_life
from snowsplat.training.parts.normal_supervision import NormalSupervision

#: Points per photo, and their error in metres.
POINTS, POINT_ERROR = 60, 0.006
KINDS = ("none", "true", "scaled", "wrong")
NORMALS = ("none", "true", "noisy", "wrong", "axes")


def write_room(folder: Path, views: int, width: int, height: int) -> None:
    """Photos, true depths ``truth/IMG.npy``, and a COLMAP model of the room."""
    if (folder / "sparse").exists():
        return
    lens = phone_lens(width, height, (0.0, 0.0, 0.0, 0.0))
    scene = still_life(0)
    poses = walk(views, 0)
    write_traced(folder, lambda: scene, lens, poses, points=POINTS, error=POINT_ERROR)
    (folder / "truth").mkdir(exist_ok=True)
    for i, pose in enumerate(poses, 1):
        np.save(folder / "truth" / f"IMG_{i:04d}.npy", depth_map(scene, lens, pose))


def write_maps(folder: Path, kind: str) -> None:
    """``depths/`` from the truth: as it is; as a network estimates it (another scale and shift of
    the disparity for each photo, blurred noise of 5%); or half of them those of other photos.
    """
    shutil.rmtree(folder / "depths", ignore_errors=True)
    if kind == "none":
        return
    (folder / "depths").mkdir()
    files = sorted((folder / "truth").iterdir())
    random = np.random.default_rng(1)
    for i, file in enumerate(files):
        z = np.load(file)
        if kind == "scaled":
            coarse = random.standard_normal((z.shape[0] // 8 + 1, z.shape[1] // 8 + 1))
            noise = np.kron(coarse, np.ones((8, 8)))[: z.shape[0], : z.shape[1]]
            disparity = (1.0 + 0.05 * noise) / z
            z = random.uniform(20, 60) * disparity + random.uniform(0, 10)
        elif kind == "wrong" and i % 2:
            z = np.load(files[(i + len(files) // 2) % len(files)])[::-1, ::-1]
        np.save(folder / "depths" / file.name, z.astype(np.float32))


def write_normals(folder: Path, kind: str, lens: float) -> set[str]:
    """``normals/`` of the true depths, with y up and z towards the camera, as PNG of 8 bits.

    As they are; as a network estimates them (blurred noise of 15 degrees); half of them those of
    other photos; or all of them with y and z exchanged. Returns the names of the wrong ones.
    """
    shutil.rmtree(folder / "normals", ignore_errors=True)
    wrong: set[str] = set()
    if kind == "none":
        return wrong
    (folder / "normals").mkdir()
    files = sorted((folder / "truth").iterdir())
    random = torch.Generator().manual_seed(1)
    pose = torch.eye(4, dtype=torch.float64)[:3]
    for i, file in enumerate(files):
        other = kind == "wrong" and i % 2
        z = torch.from_numpy(np.load(files[(i + len(files) // 2) % len(files)] if other else file))
        height, width = z.shape
        camera = Camera(width, height, lens, lens, width / 2, height / 2, pose)
        normals = normals_of_depth(z, camera).nan_to_num(nan=0.0)
        if kind == "noisy":
            coarse = torch.randn(1, 3, height // 16, width // 16, generator=random)
            noise = interpolate(coarse, (height, width), mode="bicubic")[0]
            shown = normals.any(0)
            normals = normalize(normals + 0.26 * noise, dim=0) * shown
        if kind == "axes":
            normals = normals[[0, 2, 1]]
        if other or kind == "axes":
            wrong.add(file.stem)
        colors = 0.5 + 0.5 * normals * torch.tensor([1.0, -1.0, -1.0])[:, None, None]
        pixels = (255.0 * colors).round().to(torch.uint8).permute(1, 2, 0).contiguous()
        Image.fromarray(pixels.numpy()).save(folder / "normals" / f"{file.stem}.png")
    return wrong


def errors(trainer: Trainer, folder: Path) -> dict[str, float]:
    """Median and mean relative depth error, and angles in degrees, of the held-out views."""
    depth, angle = [], []
    for view in trainer.dataset.test:
        truth = torch.from_numpy(np.load(folder / "truth" / f"{Path(view.name).stem}.npy"))
        camera: Camera = view.camera.to(trainer.device)
        shown = render(trainer.gaussians, camera, with_depth=True)
        assert shown.depth is not None
        z = shown.depth / shown.alpha.clamp_min(1e-6)
        known = truth.isfinite() & (shown.alpha > 0.5)
        depth.append((z / truth - 1.0).abs()[known])
        normals = [normals_of_depth(d, camera) for d in (z, truth.where(known, 0.0))]
        cosine = (normals[0] * normals[1]).sum(0)[known].clamp(-1, 1)
        angle.append(torch.rad2deg(cosine.acos()))
    d, a = torch.cat(depth), torch.cat(angle)
    figures = {"depth": d.median(), "depth_mean": d.mean(), "normal": a.median()}
    figures |= {"normal_mean": a.mean()}
    return {name: float(value) for name, value in figures.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    parser.add_argument("--maps", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--normals", nargs="+", choices=NORMALS, default=("none",))
    parser.add_argument("--iterations", type=int, default=800)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    args = parser.parse_args()
    settings = dict(setting(text) for text in args.set)
    room = args.output / "room"
    write_room(room, args.views, *args.size)
    for kind, normals in itertools.product(args.maps, args.normals):
        write_maps(room, kind)
        wrong = write_normals(room, normals, phone_lens(*args.size, (0.0, 0.0, 0.0, 0.0)).focal)
        config = recipe("default", iterations=args.iterations, few_passes=0.0, **settings)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        trainer = Trainer(load_dataset(room), config, note=lambda line: print("  ", line))
        trainer.run()
        seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - before
        found = {"maps": kind, "normals": normals, **settings}
        if normals != "none":
            rows = zip(trainer.dataset.train, trainer.part(NormalSupervision).used, strict=True)
            used = [Path(view.name).stem in wrong for view, taken in rows if taken]
            found |= {"used": f"{used.count(False)} right, {used.count(True)} wrong"}
        found |= {"psnr": trainer.evaluate().psnr, "cpu_s": seconds}
        found |= errors(trainer, room)
        print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in found.items()}))


if __name__ == "__main__":
    main()
