"""Levels of detail of a large scene: time, memory, PSNR, and the time until a browser shows it.

    python benchmarks/lod.py out/lego --count 5000000 --folder large

OUT is the output folder of a training on photos around an object. Its scene is copied many times,
turned and scaled a little, onto a square of ground. `convert` then writes the levels of detail, in
a process of its own, and `view` shows them in a headless Chromium, which has no GPU here.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import unquote

import torch

from snowsplat.evaluation.metrics import psnr
from snowsplat.formats import GaussianArrays, read_gaussians, write_gaussians
from snowsplat.formats.lod import INDEX, read_index, read_lod
from snowsplat.pipeline.scene_source import load_viewable
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import crop, transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, look_at
from snowsplat.scene.initial_view import InitialView, overview
from snowsplat.scene.render import render
from snowsplat.viewer.web.scene import ready

ROOT = Path(__file__).parents[1]
SNOWSPLAT = [sys.executable, "-m", "snowsplat"]
WIDTH, HEIGHT = 960, 600
#: From the address of the page, the browser reads how many million Gaussians it shows at most.
BUDGETS = (1, 4)


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


def camera_of(start: InitialView, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """The camera of the viewer in a window of this size."""
    position, target = (
        torch.tensor(p, dtype=torch.float64) for p in (start.position, start.target)
    )
    pose = look_at(position, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    focal = 0.5 * width / math.tan(math.radians(start.fov / 2))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def near(scene: Gaussians, start: InitialView) -> InitialView:
    """A view from a corner of the field, low above the ground."""
    low, high = (scene.means[::100].quantile(q, 0).double() for q in (0.02, 0.98))
    height = high[1] - low[1]
    target = low + 0.25 * (high - low)
    position = torch.stack([low[0] - height, low[1] - 1.5 * height, low[2] - height])
    return replace(start, position=tuple(position.tolist()), target=tuple(target.tolist()))


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


def quality(index: Path, view: InitialView) -> None:
    """Print the PSNR of each level against level 0, from the same place and from farther away."""
    levels = read_index(index).levels
    whole = read_gaussians(index)
    print("\nlevel   Gaussians   PSNR in dB at 1, 2, 4, 8 times the distance")
    for level in range(1, levels):
        coarse = GaussianArrays.to_gaussians(read_lod(index, level))
        values = []
        for factor in (1, 2, 4, 8):
            camera = camera_of(view, WIDTH // factor, HEIGHT // factor)
            with torch.no_grad():
                images = [render(each, camera).image.clamp(0, 1) for each in (whole, coarse)]
            values.append(float(psnr(*images)))
        print(f"{level:5}   {len(coarse):9,}   " + "  ".join(f"{value:5.2f}" for value in values))


def browse(index: Path, folder: Path, view: InitialView | None, name: str, budget: int) -> None:
    """Open the levels in Chromium; print when the first picture is there, and the last one."""
    sys.path.insert(0, str(ROOT))
    from tests.browser import Browser

    command = [*SNOWSPLAT, "view", str(index.parent), "--no-browser"]
    started = time.monotonic()
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        lines = iter(server.stdout.readline, "")
        url = next(line.strip() for line in lines if line.startswith("http"))
        ready_after = time.monotonic() - started
        with Browser(WIDTH, HEIGHT, frames=10) as browser:
            began = time.monotonic()
            page = browser.open(f"{url}?webgl&budget={budget}", timeout=120)
            page.wait_for("!!window.app", timeout=300)
            first = time.monotonic() - began
            requests = len(page.requests)
            page.screenshot(folder / f"{name}_first.png")
            shown = "window.app.stats.frame.gsplats"
            before, calm = -1, 0
            while calm < 5 and time.monotonic() - began < 600:
                time.sleep(2)
                now = page.evaluate(shown, timeout=300)
                calm = calm + 1 if now == before else 0
                before = now
            page.screenshot(folder / f"{name}.png")
            last = time.monotonic() - began
            print(
                f"{name}, at most {budget} million Gaussians: server ready in {ready_after:.1f} s, "
                f"first picture in {first:.1f} s ({requests} requests), all {before:,} Gaussians "
                f"in {last - 10:.0f} s ({len(page.requests)} requests); errors: {page.errors}"
            )
            assert all(unquote(r).startswith((url, "data:", "blob:")) for r in page.requests)
    finally:
        server.terminate()
        server.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=5_000_000)
    parser.add_argument("--folder", type=Path, required=True, help="where files are written")
    parser.add_argument("--no-browser", action="store_true")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    source, index = folder / "large.ply", folder / "levels" / INDEX
    given = load_viewable(arguments.out)
    write_gaussians(source, field(ready(given.gaussians, given.cameras).gaussians, arguments.count))
    print(f"{source}: {source.stat().st_size / 1e6:,.0f} MB")
    used = measured([*SNOWSPLAT, "convert", str(source), str(index), "--overwrite"])
    print(
        f"convert: {used.seconds:.0f} s, {used.cpu:.0f} s of processor time, "
        f"at most {used.peak / 1e9:.2f} GB of memory"
    )
    coarsest = GaussianArrays.to_gaussians(read_lod(index, read_index(index).levels - 1))
    start = overview(coarsest)
    quality(index, start)
    if not arguments.no_browser:
        for budget in BUDGETS:
            browse(index, folder, None, f"overview_{budget}", budget)


if __name__ == "__main__":
    main()
