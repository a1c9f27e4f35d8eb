"""PSNR of a scene with fewer Gaussians: dropped, merged, by PlayCanvas' converter, trained.

"merged, no cameras" is what `convert --decimate` does with a scene file alone. With the cameras of
OUT, Gaussians are merged, and then trained on renderings of the whole scene ("merged, distilled",
which is `convert OUT`) or on the photos ("merged, refined", `--refine`).

    python benchmarks/decimate.py out/fox out/fern --images pictures

Each OUT is the output folder of a training with --eval, whose held-out photos are compared. The
converter of PlayCanvas is a program for Node: `npm ci --prefix tests/node` installs it.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.convert import Decimation, refine
from snowsplat.pipeline.output.image_files import write_png
from snowsplat.pipeline.output.scene_source import cameras_of, photos_of
from snowsplat.project.project import Project
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


@dataclass
class Scene:
    """A trained scene, and the photos that measure what becomes of it."""

    folder: Path
    images: Path | None  # Where a held-out view of each row is written.

    def __post_init__(self) -> None:
        self.file = Project.open(self.folder).scene_file()
        training = Project.open(self.file).training
        assert training is not None
        self.whole = read_gaussians(self.file)
        self.cameras = cameras_of(training)[1]
        photos = Path(training.settings()[0].path)
        self.dataset, self.background = photos_of(training, photos)

    def ways(self, count: int) -> dict[str, Callable[[], Gaussians | None]]:
        """The name and the function of each way to ``count`` Gaussians."""
        return {
            "dropped": lambda: dropped(self.whole, count),
            "PlayCanvas": lambda: by_playcanvas(self.file, count),
            "merged, no cameras": lambda: simplify(self.whole, count),
            "merged": lambda: simplify(self.whole, count, self.cameras),
            "merged, distilled": lambda: self.decimated(count, None),
            "merged, refined": lambda: self.decimated(
                count, partial(refine, dataset=self.dataset, background=self.background)
            ),
        }

    def decimated(self, count: int, refined: Callable[[Gaussians], Gaussians] | None) -> Gaussians:
        """What `convert --decimate` writes for the output folder."""
        white = float(self.background == "white")
        decimation = Decimation(self.cameras, (white, white, white), refined)
        return decimation.fitted(decimation.merged(self.whole, count), self.whole)

    def print_row(self, name: str, gaussians: Gaussians, seconds: float = 0.0) -> None:
        color = torch.full((3,), float(self.background == "white"))
        result = evaluate_views(gaussians, self.dataset.test, background=color.tolist())
        taken = f"{seconds:.1f}" if seconds else ""
        row = (self.folder.name, f"{len(gaussians):,}", name)
        print(
            "|",
            " | ".join((*row, f"{result.psnr:.2f}", f"{result.ssim:.3f}", taken)),
            "|",
            flush=True,
        )
        if self.images:
            image = render(gaussians, self.dataset.test[0].camera, color).image
            self.images.mkdir(parents=True, exist_ok=True)
            pixels = (image.clamp(0.0, 1.0) * 255.0).round().byte().numpy()
            write_png(self.images / f"{self.folder.name}_{len(gaussians)}_{name}.png", pixels)


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
        scene = Scene(folder, arguments.images)
        scene.print_row("whole", scene.whole)
        for share in arguments.shares:
            for name, way in scene.ways(round(share * len(scene.whole))).items():
                started = time.perf_counter()
                smaller = way()
                if smaller is not None:
                    scene.print_row(name, smaller, time.perf_counter() - started)


if __name__ == "__main__":
    main()
