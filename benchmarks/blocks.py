"""A street, trained at once and in blocks: PSNR, peak memory, and a film across the seams.

    python benchmarks/blocks.py --out OUT
    python benchmarks/blocks.py --out OUT --photos 96 --blocks 3 --gaussians 40000

The photos are ray traced (`benchmarks/street.py`). Every 8th is held out. Each training is a
process of its own, whose memory is measured. Results are kept in OUT; the same command continues.
"""

import argparse
import json
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from street_dataset import write_street_dataset

from snowsplat.data import ImageLoader, View
from snowsplat.pipeline.blocks.plan import Plan, plan_blocks
from snowsplat.pipeline.blocks.train import merge_blocks, train_blocks
from snowsplat.pipeline.options.benchmark import PlanOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import TrainedScene, load_trained
from snowsplat.pipeline.render import evaluate
from snowsplat.pipeline.train import train
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render, to_8bit
from snowsplat.trajectory.video_file import video_writer
from snowsplat.util.files import write_json
from snowsplat.util.machine import peak_bytes, reset_peak, resident_bytes

WORST = 6


def train_whole(dataset: Path, out: Path, settings: dict[str, Any]) -> None:
    train(dataset, out, TrainOptions(settings=settings, hold_out=8), overwrite=True)


def train_block(folder: Path, number: int) -> None:
    train_blocks(folder, [number])


def measured(function: Callable[..., None], *arguments: Any) -> dict[str, float]:
    """Call a function that trains; returns bytes of memory and seconds of processor time.

    ``before`` is the memory of Python and its libraries.
    """
    import snowsplat.training.core.trainer  # noqa: F401 (before the memory is measured)

    reset_peak()
    before, begin = resident_bytes(), time.process_time()
    function(*arguments)
    return {"before": before, "peak": peak_bytes(), "seconds": time.process_time() - begin}


def in_process(file: Path, function: Callable[..., None], *arguments: Any) -> dict[str, float]:
    """`measured` in a new process; the result is kept in a file, and not measured again."""
    if not file.is_file():
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            write_json(file, pool.submit(measured, function, *arguments).result())
    return json.loads(file.read_text(encoding="utf-8"))


def walk(length: float, camera: Camera, frames: int) -> Iterator[Camera]:
    """A camera that moves along the street and looks ahead, to its left side."""
    yaw = math.radians(35)
    for i in range(frames):
        x = length * (0.03 + 0.94 * i / (frames - 1))
        position = torch.tensor([x, -1.6, -1.0], dtype=torch.float64)
        gaze = torch.tensor([math.cos(yaw), -0.08, math.sin(yaw)], dtype=torch.float64)
        up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        pose = look_at(position, position + gaze, up)
        yield Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose)


def rendered(scene: TrainedScene, camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8."""
    with torch.no_grad():
        return to_8bit(render(scene.gaussians, camera.to(scene.gaussians.means.device)).image)


def write_film(file: Path, whole: TrainedScene, merged: TrainedScene, frames: int) -> None:
    """The whole above, the merged blocks below."""
    camera = whole.dataset.test[0].camera
    length = max(float(view.camera.position[0]) for view in whole.dataset.train)
    with video_writer(file, camera.width, 2 * camera.height, 24) as add:
        for each in walk(length, camera, frames):
            add(np.concatenate([rendered(whole, each), rendered(merged, each)]))


def write_pictures(
    file: Path, views: list[View], whole: TrainedScene, merged: TrainedScene
) -> None:
    """A row for each view: the photo, the whole, the merged blocks."""
    rows = []
    with ImageLoader(views) as loader:
        for view in views:
            drawn = [rendered(scene, view.camera) for scene in (whole, merged)]
            rows.append(np.concatenate([loader.get(view).rgb.numpy(), *drawn], axis=1))
    Image.fromarray(np.concatenate(rows)).save(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for all results")
    parser.add_argument("--dataset", type=Path, help="where the photos are kept (default: in OUT)")
    parser.add_argument("--photos", type=int, default=600)
    parser.add_argument("--size", type=int, nargs=2, default=(240, 160), metavar=("W", "H"))
    parser.add_argument("--blocks", type=int, default=6)
    parser.add_argument("--gaussians", type=int, default=300_000, help="of the whole")
    parser.add_argument(
        "--block-gaussians", type=int, default=300_000, help="of the whole, shared by the blocks"
    )
    parser.add_argument("--iterations", type=int, default=4000, help="of the whole")
    parser.add_argument("--block-iterations", type=int, default=1600, help="of each block")
    parser.add_argument("--frames", type=int, default=240, help="of the film")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    dataset = options.dataset or out / "street"
    if not (dataset / "sparse").is_dir():
        write_street_dataset(dataset, options.photos, *options.size)
    whole_settings = {
        "max_gaussians": options.gaussians,
        "iterations": options.iterations,
        "seed": options.seed,
    }
    cost_of_whole = in_process(
        out / "whole.json", train_whole, dataset, out / "whole", whole_settings
    )
    folder = out / "blocks"
    if not (folder / "plan.json").is_file():
        block_settings = whole_settings | {
            "max_gaussians": options.block_gaussians,
            "iterations": options.block_iterations,
        }
        plan_blocks(
            dataset, folder, PlanOptions(blocks=options.blocks, settings=block_settings, hold_out=8)
        )
    plan = Plan.read(folder)
    costs = [
        in_process(out / f"{block.name}.json", train_block, folder, number)
        for number, block in enumerate(plan.blocks, 1)
    ]
    merged_files = merge_blocks(folder)
    whole, merged = load_trained(out / "whole"), load_trained(folder)
    of_whole = {view.name: view for view in evaluate(whole).views}
    of_merged = {view.name: view for view in evaluate(merged).views}
    tests = {view.name: view for view in whole.dataset.test}
    ground = plan.ground(torch.stack([view.camera.position for view in tests.values()]))

    def row(name: str, photos: int, gaussians: int, cost: dict, names: list[str]) -> None:
        psnrs = [np.mean([of[n].psnr for n in names]) for of in (of_whole, of_merged)]
        net = (cost["peak"] - cost["before"]) / 1e6
        print(
            f"{name:9} {photos:6} {gaussians:9,} {cost['peak'] / 1e6:8.0f} {net:8.0f}"
            f" {cost['seconds']:8.0f} {psnrs[0]:8.2f} {psnrs[1]:8.2f}"
        )

    print("                           peak memory, MB  cpu s    PSNR of the photos held out, dB")
    print("          photos Gaussians    all      net            whole   merged")
    row("whole", len(whole.dataset.train), len(whole.gaussians), cost_of_whole, list(tests))
    for block, cost, kept in zip(plan.blocks, costs, merged_files.gaussians, strict=True):
        inside = block.cell.contains(ground).tolist()
        names = [name for name, is_in in zip(tests, inside, strict=True) if is_in]
        row(block.name, block.views, kept, cost, names)
    largest = max(costs, key=lambda cost: cost["peak"] - cost["before"])
    total = largest | {"seconds": sum(cost["seconds"] for cost in costs)}
    row("merged", len(whole.dataset.train), len(merged.gaussians), total, list(tests))
    ssims = [np.mean([view.ssim for view in of.values()]) for of in (of_whole, of_merged)]
    print(f"SSIM: whole {ssims[0]:.4f}, merged {ssims[1]:.4f}")
    for name, key in (("all", 0.0), ("net", 1.0)):
        ratio = (largest["peak"] - key * largest["before"]) / (
            cost_of_whole["peak"] - key * cost_of_whole["before"]
        )
        print(f"memory of the largest block / of the whole, {name}: {ratio:.2f}")
    worst = sorted(tests, key=lambda name: of_merged[name].psnr - of_whole[name].psnr)[:WORST]
    for name in worst:
        print(f"{name}: {of_merged[name].psnr - of_whole[name].psnr:+.2f} dB")
    write_pictures(out / "worst.png", [tests[name] for name in worst], whole, merged)
    write_film(out / "film.mp4", whole, merged, options.frames)
    print(f"{out / 'worst.png'}: photo, whole, merged; {out / 'film.mp4'}: whole, merged")


if __name__ == "__main__":
    main()
