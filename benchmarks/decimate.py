"""PSNR of a scene with fewer Gaussians: dropped, merged, by PlayCanvas' converter, refined.

    python benchmarks/decimate.py out/fox out/fern --images pictures

Each OUT is the output folder of a training with --eval, whose held-out photos are compared. PlayCanvas'
converter is a program for Node: `npm ci --prefix tests/node` installs it.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from snowsplat.data import Dataset
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.image_files import write_png
from snowsplat.pipeline.refine import photos_of, refine
from snowsplat.pipeline.scene_source import folder_around, scene_file
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.scene.simplify import simplify

CONVERTER = "tests/node/node_modules/@playcanvas/splat-transform/bin/cli.mjs"


def dropped(gaussians: Gaussians, count: int) -> Gaussians:
    """The Gaussians with the largest opacity × largest standard deviation."""
    importance = gaussians.opacities.log() + gaussians.log_scales.amax(1)
    return gaussians.select(importance.argsort(descending=True)[:count])


def by_playcanvas(scene: Path, count: int) -> Gaussians | None:
    """What `splat-transform --decimate` makes of a scene; None if it is not installed."""
    converter, node = Path(__file__).parents[1] / CONVERTER, shutil.which("node")
    if node is None or not converter.is_file():
        return None
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "small.ply"
        command = [node, converter, "-g", "cpu", scene, "--decimate", str(count), target]
        subprocess.run(command, check=True, capture_output=True)
        return read_gaussians(target)


def ways(
    scene: Path, whole: Gaussians, dataset: Dataset, background: str, count: int
) -> Iterator[tuple[str, Callable[[], Gaussians | None]]]:
    """The name and the function of each way to ``count`` Gaussians."""
    yield "dropped", lambda: dropped(whole, count)
    yield "PlayCanvas", lambda: by_playcanvas(scene, count)
    yield "merged", lambda: simplify(whole, count)
    yield "merged, refined", lambda: refine(simplify(whole, count), dataset, background)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT")
    parser.add_argument("--shares", nargs="+", type=float, default=[0.5, 1 / 3, 0.1], metavar="F")
    parser.add_argument("--images", type=Path, metavar="DIR", help="write a held-out view of each")
    arguments = parser.parse_args()
    print("| scene | Gaussians | | PSNR | SSIM | seconds |\n|---|---|---|---|---|---|")
    for folder in arguments.folders:
        scene = scene_file(folder)
        whole = read_gaussians(scene)
        path = Path(folder_around(scene).settings()[0].path)
        dataset, background = photos_of(scene, path)
        color = torch.full((3,), float(background == "white"))

        def show(name: str, gaussians: Gaussians, seconds: float = 0.0) -> None:
            result = evaluate_views(gaussians, dataset.test, background=color.tolist())
            taken = f"{seconds:.1f}" if seconds else ""
            row = (folder.name, f"{len(gaussians):,}", name)
            values = (f"{result.psnr:.2f}", f"{result.ssim:.3f}", taken)
            print("|", " | ".join((*row, *values)), "|", flush=True)
            if arguments.images:
                image = render(gaussians, dataset.test[0].camera, color).image
                arguments.images.mkdir(parents=True, exist_ok=True)
                pixels = (image.clamp(0.0, 1.0) * 255.0).round().byte().numpy()
                write_png(arguments.images / f"{folder.name}_{len(gaussians)}_{name}.png", pixels)

        show("whole", whole)
        for share in arguments.shares:
            for name, way in ways(scene, whole, dataset, background, round(share * len(whole))):
                started = time.perf_counter()
                smaller = way()
                if smaller is not None:
                    show(name, smaller, time.perf_counter() - started)


if __name__ == "__main__":
    main()
