"""Training in several processes: memory of each process, bytes exchanged, seconds per update.

    python benchmarks/processes.py --size 1m --processes 1 2 4

The workload is that of `workloads.py`, seen by a batch of views beside one another. The first
updates are not measured. The memory is that without Python and its libraries. The number of bytes
sent is compared with the model of `sent_bytes`.
"""

import argparse
import gc
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from workloads import SIZES, workload

from snowsplat import ops
from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.pipeline.run import processes
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import project
from snowsplat.training.core.run_state import row_tensors
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.processes.process_shards import ProcessShards
from snowsplat.training.processes.shards import Shards
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.machine import peak_bytes, reset_peak, resident_bytes

#: Number of updates before the measurement, and of measured ones.
WARM_UP, MEASURED = 2, 6
#: Bytes of a splat on its way to the process that blends it, and of its gradient on the way back,
#: with the absolute gradients.
SPLAT, GRADIENT = 4 * 11, 4 * (11 + 2)


def sent_bytes(rows: np.ndarray, rank: int) -> int:
    """The model: bytes that a process sends to others in an update.

    Args:
        rows: (N, V) number of splats of the shard of each process in each view.
    """
    size, views = rows.shape
    blends = np.arange(views) % size == rank
    others = np.arange(size) != rank
    forward = SPLAT * rows[rank, ~blends].sum()
    return int(forward + GRADIENT * rows[others][:, blends].sum())


def beside(camera: Camera, number: int) -> Camera:
    """The camera, moved to the right by a small distance."""
    pose = camera.cam_from_world.clone()
    pose[0, 3] -= 0.02 * number
    return replace(camera, cam_from_world=pose)


def work(size: str, batch: int, folder: Path) -> None:
    """One process: prints its result as a line of JSON."""
    ops.set_num_threads(max(1, (os.cpu_count() or 1) // processes.local_count()))
    with processes.joined(torch.device("cpu")) as shards:
        _trainer("tiny", batch, folder / "tiny", shards).run(until=WARM_UP * batch)
        reset_peak()
        base = resident_bytes()  # Python and its libraries, which are loaded now
        trainer = _trainer(size, batch, folder, shards)
        gc.collect()
        trainer.run(until=WARM_UP * batch)
        reset_peak()
        seconds, sent, expected = [], [], []
        for update in range(WARM_UP, WARM_UP + MEASURED):
            rows = _rows(trainer, shards)
            before = _sent(shards)
            start = time.perf_counter()
            trainer.run(until=(update + 1) * batch)
            seconds.append(time.perf_counter() - start)
            sent.append(_sent(shards) - before)
            expected.append(sent_bytes(rows, shards.rank) if shards.size > 1 else 0)
        tensors = sum(t.nbytes for t in row_tensors(trainer).values())
        result = {
            "rank": shards.rank,
            "gaussians": len(trainer.gaussians),
            "state": tensors,
            "peak": peak_bytes() - base,
            "seconds": statistics.median(seconds),
            "sent": sent[0],
            "model": expected[0],
        }
    print(json.dumps(result), flush=True)


def _trainer(size: str, batch: int, folder: Path, shards: Shards) -> Trainer:
    """The training of a workload with the photos of `write_photos`."""
    # Only process 0 creates the workload; this is not part of the measurement.
    scene = workload(size) if shards.rank == 0 else None
    _, width, height = SIZES[size]
    camera = workload("tiny").camera.scaled(width, height)
    views = [
        View(str(i), beside(camera, i), ImageSource(folder / f"{i}.png", width, height))
        for i in range(batch)
    ]
    dataset = Dataset(views, [], Points(torch.zeros(1, 3), torch.zeros(1, 3).byte()), 5.0)
    config = recipe(
        *("default",),
        batch=batch,
        iterations=100 * batch,
        densify_from=1.0,
        max_gaussians=SIZES[size][0],
        coarse_to_fine=(0, 0),
        sh_interval=0,
        leave_out_after=0,
        near_limit=0.0,
    )
    initial = None if scene is None else scene.gaussians
    return Trainer(dataset, config, initial=initial, shards=shards)


def _rows(trainer: Trainer, shards: Shards) -> np.ndarray:
    """(N, V): the number of splats of each process in each view of the next batch."""
    views = trainer.dataset.train
    order = trainer.queue.order[: len(views)] or range(len(views))
    counts = [len(project(trainer.gaussians, trainer.cameras.camera(i))) for i in order]
    return shards.table(torch.tensor(counts)).numpy()


def _sent(shards: Shards) -> int:
    return shards.sent_bytes if isinstance(shards, ProcessShards) else 0


def ranks(command: list[str], count: int) -> list[str]:
    """Run a command in ``count`` processes that are joined; the last line of output of each."""
    shared = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(29500 + os.getpid() % 1000 + count),
        "WORLD_SIZE": str(count),
        "LOCAL_WORLD_SIZE": str(count),
        "GLOO_SOCKET_IFNAME": "lo",
    }
    running = [
        subprocess.Popen(
            command,
            env=os.environ | shared | {"RANK": str(rank)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in range(count)
    ]
    return [process.communicate()[0].splitlines()[-1] for process in running]


def measure(size: str, batch: int, count: int, folder: Path) -> list[dict[str, float]]:
    """The results of all processes, for photos from `write_photos`."""
    write_photos(folder / "tiny", "tiny", batch)
    flags = ["--size", size, "--batch", str(batch), "--worker", str(folder)]
    return [json.loads(line) for line in ranks([sys.executable, __file__, *flags], count)]


def write_photos(folder: Path, size: str, batch: int) -> None:
    """Photos of the size of a workload: smooth noise."""
    folder.mkdir(exist_ok=True)
    _, width, height = SIZES[size]
    random = np.random.default_rng(0)
    for i in range(batch):
        small = random.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
        Image.fromarray(small).resize((width, height)).save(folder / f"{i}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="1m", choices=SIZES)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.worker is not None:
        work(flags.size, flags.batch, flags.worker)
        return
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_photos(folder, flags.size, flags.batch)
        print("processes  Gaussians each  state MB  peak MB  s/update  sent MB  model MB")
        for count in flags.processes:
            for each in measure(flags.size, flags.batch, count, folder):
                print(
                    f"{count:9}  {each['gaussians']:14,}  {each['state'] / 1e6:8.1f}  "
                    f"{each['peak'] / 1e6:7.1f}  {each['seconds']:8.3f}  "
                    f"{each['sent'] / 1e6:7.3f}  {each['model'] / 1e6:8.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
