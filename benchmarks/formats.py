"""Every scene format: how long it takes, how large it is, what the picture loses.

    python benchmarks/formats.py SCENE
    python benchmarks/formats.py SCENE --capture CAPTURE

SCENE is a trained one, of any format that is read. Times are of a scene of `--gaussians` made of
it, a copy beside the other; bytes a Gaussian are those of SCENE itself. With the dataset that it
was trained on: PSNR of the renderings of what was read back against those of SCENE, and against
the photos, mean over every 8th photo's camera.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from snowsplat import Gaussians, View, load_dataset, read_gaussians
from snowsplat.evaluation.metrics import evaluate_views, psnr
from snowsplat.formats import FORMATS
from snowsplat.formats.spz import read_spz, write_spz
from snowsplat.scene.render import render

Read = Callable[[Path], Gaussians]
Write = Callable[[Path, Gaussians], None]


def rows() -> list[tuple[str, str, Write, Read | None]]:
    """Name, suffix, writer and reader of each format that is written, and of other versions."""
    found: list[tuple[str, str, Write, Read | None]] = []
    for format in FORMATS:
        if format.write is not None:
            found.append((format.name, format.suffixes[0], format.write, format.read))
        if format.name == "SPZ":
            found.append(("SPZ 4", ".spz", lambda p, g: write_spz(p, g, version=4), read_spz))
    return found


def enlarged(gaussians: Gaussians, count: int) -> Gaussians:
    """``count`` Gaussians: as many copies as it takes, each a scene's width beside the last."""
    copies = math.ceil(count / len(gaussians))
    width = gaussians.means.amax(0) - gaussians.means.amin(0)
    parts = []
    for i in range(copies):
        part = gaussians.clone()
        part.means[:, 0] += i * width[0]
        parts.append(part)
    return Gaussians.cat(parts).select(torch.arange(count))


def seconds(function: Callable[[], object], repeats: int) -> float:
    """The least of some wall times."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--capture", type=Path, help="what the scene was trained on")
    parser.add_argument("-r", "--resolution", type=int, default=1, help="1/r of the photos' size")
    parser.add_argument("--gaussians", type=int, default=100_000, help="of the scene that is timed")
    parser.add_argument("--repeats", type=int, default=3, help="of which the fastest is told")
    arguments = parser.parse_args()

    scene = read_gaussians(arguments.scene)
    large = enlarged(scene, arguments.gaussians)
    views: list[View] = []
    if arguments.dataset:
        dataset = load_dataset(arguments.dataset, hold_out=8, resolution=arguments.resolution)
        views = dataset.test
    expected = [render(scene, view.camera).image for view in views]
    print(
        f"{len(scene):,} Gaussians of SH degree {scene.sh_degree}; times of {len(large):,}; "
        f"{len(views)} views"
    )
    print(f"{'format':<16}{'write s':>9}{'read s':>9}{'bytes':>9}{'PSNR dB':>9}{'photos':>9}")
    if views:
        print(f"{'(the scene)':<52}{evaluate_views(scene, views).psnr:>9.2f}")
    with tempfile.TemporaryDirectory() as folder:
        for name, suffix, write, read in rows():
            path = Path(folder) / f"scene{suffix}"
            line = f"{name:<16}{seconds(partial(write, path, large), arguments.repeats):>9.3f}"
            if read is None:
                write(path, scene)
                print(f"{line}{'-':>9}{path.stat().st_size / len(scene):>9.1f}")
                continue
            line += f"{seconds(partial(read, path), arguments.repeats):>9.3f}"
            write(path, scene)
            line += f"{path.stat().st_size / len(scene):>9.1f}"
            if views:
                again = read(path)
                pictures = [render(again, view.camera).image for view in views]
                figures = [psnr(p, e) for p, e in zip(pictures, expected, strict=True)]
                line += (
                    f"{sum(figures) / len(figures):>9.2f}{evaluate_views(again, views).psnr:>9.2f}"
                )
            print(line, flush=True)


if __name__ == "__main__":
    main()
