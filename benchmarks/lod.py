"""Levels of detail of a large scene: time, memory, PSNR, and the time until a browser shows it.

    python benchmarks/lod.py out/lego --count 5000000 --folder large

OUT is the output folder of a training on photos around an object. Its scene is copied many times,
turned and scaled a little, onto a square of ground. `convert` then writes the levels of detail, in
a process of its own, and `view` shows them in a headless Chromium, which has no GPU here.
"""

import argparse
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from snowsplat.evaluation.metrics import psnr
from snowsplat.formats import GaussianArrays, write_gaussians
from snowsplat.formats.lod import INDEX, read_index, read_lod
from snowsplat.formats.lod_writer import LodSizes, write_lod
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import crop, transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.render import render
from snowsplat.viewer.web.scene import ready

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the browser of the tests
SNOWSPLAT = [sys.executable, "-m", "snowsplat"]
WIDTH, HEIGHT = 960, 600
PATIENCE = 400.0  # seconds until the number of Gaussians on the page does not change any more


def field(scene: Gaussians, count: int) -> Gaussians:
    """``count`` Gaussians: copies of ``scene`` on a square, with −y up."""
    low, high = (scene.means.quantile(q, 0) for q in (0.02, 0.98))
    margin = 0.1 * (high - low)
    scene = crop(scene, torch.stack([low - margin, high + margin]))
    side = math.ceil(math.sqrt(count / len(scene)))
    spacing = 1.25 * float((high - low)[[0, 2]].max())
    middle = torch.stack([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2]).double()
    centred = transform(scene, Similarity(1.0, torch.eye(3, dtype=torch.float64), -middle))
    random = torch.Generator().manual_seed(0)
    copies = []
    for place in range(side * side):
        turn, size, *shift = torch.rand(4, generator=random, dtype=torch.float64).tolist()
        at = [(place % side + 0.2 * shift[0]) * spacing, 0.0, (place // side + 0.2 * shift[1])]
        at[2] *= spacing
        angle = 2 * math.pi * turn
        c, s = math.cos(angle), math.sin(angle)
        rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
        change = Similarity(0.8 + 0.4 * size, rotation, torch.tensor(at, dtype=torch.float64))
        copies.append(transform(centred, change))
    return Gaussians.cat(copies).select(torch.arange(count))


@dataclass
class Process:
    """What a finished process has used."""

    seconds: float
    cpu: float
    peak: int  # bytes


def measured(command: list[str]) -> Process:
    """Run a command to its end."""
    start = time.monotonic()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    assert os.waitstatus_to_exitcode(status) == 0, command
    cpu = usage.ru_utime + usage.ru_stime
    return Process(time.monotonic() - start, cpu, usage.ru_maxrss << 10)


def shrunk(image: Tensor, factor: int) -> Tensor:
    """(H, W, 3) the mean colour of each block of pixels."""
    return avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)


def quality(scene: Gaussians, cameras: list[Camera], folder: Path) -> None:
    """Print the PSNR of each level from several distances.

    It is compared with renderings of the scene from its place, reduced in size as by the distance.
    """
    index = folder / INDEX
    coarsest = len(scene) // 64 + 1
    write_lod(index, GaussianArrays.from_gaussians(scene), sizes=LodSizes(coarsest=coarsest))
    print("\nlevel  Gaussians   PSNR in dB at 1, 2, 4, 8 times the distance")
    truths = []
    for camera in cameras:
        camera = camera.downscaled(max(1, camera.width // 600))
        size = {"width": camera.width // 8 * 8, "height": camera.height // 8 * 8}
        camera = replace(camera, **size)
        truths.append((camera, render(scene, camera).image.clamp(0, 1)))
    for level in range(read_index(index).levels):
        gaussians = read_lod(index, level).to_gaussians()
        means = []
        for factor in (1, 2, 4, 8):
            values = [
                psnr(
                    render(gaussians, camera.downscaled(factor)).image.clamp(0, 1),
                    shrunk(truth, factor),
                )
                for camera, truth in truths
            ]
            means.append(sum(map(float, values)) / len(values))
        print(f"{level:5}  {len(gaussians):9,}   " + "  ".join(f"{mean:5.2f}" for mean in means))


def browse(index: Path, folder: Path, budget: int) -> None:
    """Open the levels in Chromium; print when the first picture is there, and the last one.

    Args:
        budget: the page shows at most so many million Gaussians.
    """
    from tests.browser import Browser

    command = [*SNOWSPLAT, "view", str(index.parent), "--no-browser"]
    started = time.monotonic()
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        url = next(line.strip() for line in server.stdout if line.startswith("http"))
        served = time.monotonic() - started
        with Browser(WIDTH, HEIGHT) as browser:
            began = time.monotonic()
            page = browser.open(f"{url}?webgl&budget={budget}", timeout=120)
            page.wait_for("!!window.app", 300)
            first, requests = time.monotonic() - began, len(page.requests)
            page.screenshot(folder / "first.png")
            shown, same = -1, 0
            while same < 4 and time.monotonic() - began < PATIENCE:
                time.sleep(2)
                before, shown = shown, page.evaluate("window.app.stats.frame.gsplats", 300)
                same = same + 1 if shown == before else 0
            last = time.monotonic() - began
            page.screenshot(folder / "last.png")
            print(
                f"\nview: address after {served:.1f} s; first picture {first:.1f} s after the page "
                f"is opened ({requests} requests); {shown:,} Gaussians after {last:.0f} s "
                f"({len(page.requests)} requests); errors: {page.errors}"
            )
    finally:
        server.terminate()
        server.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=5_000_000, help="Gaussians of the large scene")
    parser.add_argument("--sh-degree", type=int, default=3, help="of the large scene")
    parser.add_argument("--folder", type=Path, required=True, help="where files are written")
    parser.add_argument("--budget", type=int, default=1, help="million Gaussians in the browser")
    parser.add_argument("--no-browser", action="store_true")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    given = load_viewable(arguments.out)
    with torch.no_grad():
        step = -(-len(given.cameras) // 3)
        quality(given.gaussians, given.cameras[::step], folder / "one")
    source, index = folder / "large.ply", folder / "levels" / INDEX
    upright = ready(given.gaussians, given.cameras).gaussians
    write_gaussians(source, field(upright, arguments.count))
    print(f"\n{source}: {source.stat().st_size / 1e6:,.0f} MB")
    degree = ["--sh-degree", str(arguments.sh_degree)]
    used = measured([*SNOWSPLAT, "convert", str(source), str(index), "--overwrite", *degree])
    print(
        f"convert: {used.seconds:.0f} s, {used.cpu:.0f} s of processor time, "
        f"at most {used.peak / 1e9:.2f} GB of memory"
    )
    if not arguments.no_browser:
        browse(index, folder, arguments.budget)


if __name__ == "__main__":
    main()
