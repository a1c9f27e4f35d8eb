"""Time, file size and image quality of every scene format.

    python benchmarks/formats.py SCENE
    python benchmarks/formats.py SCENE --dataset DATASET

SCENE is a trained scene of any readable format. Times are measured with copies of it side by side,
`--gaussians` in total; bytes per Gaussian are those of SCENE itself. With the dataset of its
training, two mean PSNRs are computed over the cameras of every 8th photo: renderings of the scene
that was read back compared with renderings of SCENE, and with the photos.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch

from snowsplat import Gaussians, View, load_dataset, read_gaussians
from snowsplat.evaluation.metrics import evaluate_views, psnr
from snowsplat.formats.spz import read_spz, write_spz
from snowsplat.pipeline.output.scene_files import FORMATS, GaussianArrays, format_for_reading
from snowsplat.scene.render import render

Read = Callable[[Path], GaussianArrays]
Write = Callable[[Path, GaussianArrays], None]


def rows() -> list[tuple[str, str, Write, Read | None]]:
    """Name, suffix, writer and reader of each format, and of all versions of SPZ."""
    found: list[tuple[str, str, Write, Read | None]] = []
    for format in FORMATS:
        missing = format.name == "USD" and find_spec("pxr") is None
        if format.write is not None and not missing:
            found.append((format.name, format.suffixes[0], format.write, format.read))
        if format.name == "SPZ":
            for version in (2, 4):
                write = partial(write_spz, version=version)
                found.append((f"SPZ {version}", ".spz", write, read_spz))
    return found


def enlarged(gaussians: Gaussians, count: int) -> Gaussians:
    """``count`` Gaussians: copies of the scene, each next to the previous one along x."""
    copies = math.ceil(count / len(gaussians))
    width = gaussians.means.amax(0) - gaussians.means.amin(0)
    parts = []
    for i in range(copies):
        part = gaussians.clone()
        part.means[:, 0] += i * width[0]
        parts.append(part)
    return Gaussians.cat(parts).select(torch.arange(count))


def seconds(function: Callable[[], object], repeats: int) -> float:
    """The shortest wall time of ``repeats`` calls."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--dataset", "--capture", type=Path, help="dataset of the training")
    parser.add_argument("-r", "--resolution", type=int, default=1, help="1/r of the photos' size")
    parser.add_argument("--gaussians", type=int, default=100_000, help="in the scene that is timed")
    parser.add_argument("--repeats", type=int, default=3, help="the shortest time is printed")
    arguments = parser.parse_args()

    scene = read_gaussians(arguments.scene)
    arrays = GaussianArrays.from_gaussians(scene)
    large = GaussianArrays.from_gaussians(enlarged(scene, arguments.gaussians))
    views: list[View] = []
    if arguments.dataset:
        dataset = load_dataset(arguments.dataset, hold_out=8, resolution=arguments.resolution)
        views = dataset.test
    expected = [render(scene, view.camera).image for view in views]
    print(
        f"{len(scene):,} Gaussians of SH degree {scene.sh_degree}; "
        f"times of {arguments.gaussians:,}; {len(views)} views"
    )
    print(f"{'format':<16}{'write s':>9}{'read s':>9}{'bytes':>9}{'PSNR dB':>9}{'photos':>9}")
    if views:
        print(f"{'(the scene)':<52}{evaluate_views(scene, views).psnr:>9.2f}")
    with tempfile.TemporaryDirectory() as folder:
        for name, suffix, write, read in rows():
            path = Path(folder) / f"scene{suffix}"
            line = f"{name:<16}{seconds(partial(write, path, large), arguments.repeats):>9.3f}"
            if read is None:
                write(path, arrays)
                print(f"{line}{'-':>9}{format_for_reading(path).size(path) / len(scene):>9.1f}")
                continue
            line += f"{seconds(partial(read, path), arguments.repeats):>9.3f}"
            write(path, arrays)
            line += f"{format_for_reading(path).size(path) / len(scene):>9.1f}"
            if views:
                again = read(path).to_gaussians()
                images = [render(again, view.camera).image for view in views]
                values = [psnr(i, e) for i, e in zip(images, expected, strict=True)]
                line += (
                    f"{sum(values) / len(values):>9.2f}{evaluate_views(again, views).psnr:>9.2f}"
                )
            print(line, flush=True)


if __name__ == "__main__":
    main()
