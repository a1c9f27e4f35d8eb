"""A model of training in N processes: seconds, bytes sent and memory per update.

    python benchmarks/scale.py --size 1m                    the model, and a table up to 1000 nodes
    python benchmarks/scale.py --size 1m --check 1 2        compared with measured updates

The costs of one process are measured: the stages of an iteration with the threads that each process
has, and the backward pass of the projection. So is the rate at which two processes of this computer
exchange data. See docs/what-was-tried.md.
"""

import argparse
import math
import os
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from iteration import Iteration
from processes import GRADIENT, SPLAT, measure, ranks, write_photos
from workloads import SIZES, workload

from snowsplat import ops
from snowsplat.ops.splats import Splats2D
from snowsplat.pipeline.run import processes
from snowsplat.scene.render import view_of
from snowsplat.training.processes.process_shards import ProcessShards
from snowsplat.util.process import single_threaded

#: Bytes of a Gaussian: its parameters, their two moments, and the statistics of density control.
STATE = 4 * (59 * 3 + 3)
#: Seconds for a message to another computer: an assumption, for Ethernet with TCP.
LATENCY = 50e-6
#: Bytes per second, of one direction of a link. The names say which figures are data sheets.
LINKS = {
    "10 Gbit/s network (data sheet)": 1.25e9,
    "InfiniBand NDR, 400 Gbit/s (data sheet)": 50e9,
    "NVLink 4, 900 GB/s for both directions (data sheet)": 450e9,
}


@dataclass(frozen=True)
class Costs:
    """What one process needs for the workload.

    Attributes:
        cull: seconds per Gaussian.
        splat: seconds per visible Gaussian of a photo: projection, and its backward pass.
        adam: seconds per Gaussian that at least one photo of the batch shows.
        photo: seconds per photo: everything between the splats and their gradients.
        visible: number of splats of a photo.
    """

    cull: float
    splat: float
    adam: float
    photo: float
    visible: int


@dataclass(frozen=True)
class Update:
    """The model of an update in one of N processes."""

    seconds: float
    sent: float  # bytes
    exchange: float  # seconds of `seconds`
    state: float  # bytes


def model(
    costs: Costs,
    gaussians: int,
    processes: int,
    batch: int,
    rate: float,
    latency: float = 0.0,
) -> Update:
    """An update with ``batch`` photos that each show ``costs.visible`` Gaussians.

    Args:
        rate: bytes per second that a process sends.
        latency: seconds for a message.
    """
    rounds = math.ceil(batch / processes)
    own = batch * (costs.cull * gaussians + costs.splat * costs.visible)
    own += costs.adam * min(gaussians, batch * costs.visible)
    others = (processes - 1) / processes
    sent = batch / processes * others * costs.visible * (SPLAT + GRADIENT)
    messages = 2 * rounds * (processes - 1)  # splats and gradients, to every other process
    exchange = sent / rate + messages * latency
    seconds = own / processes + rounds * costs.photo + exchange
    return Update(seconds, sent, exchange, STATE * gaussians / processes)


def measured_costs(size: str, threads: int, repeats: int) -> Costs:
    """The costs on this computer."""
    scene = workload(size)
    iteration = Iteration(scene, visible_only=True)
    iteration.measure(2, threads)
    laps = iteration.measure(repeats, threads)["wall"]
    stages = {name: statistics.median(times) for name, times in laps.items()}
    gaussians, view = scene.gaussians, view_of(scene.gaussians, scene.camera, 3)
    with single_threaded():
        ops.set_num_threads(threads)
        splats = ops.project(gaussians, view)
        assert splats.ids is not None
        sums = {name: torch.zeros_like(p) for name, p in gaussians.parameters().items()}
        gradient = ops.SplatGradient(splats.ids, torch.ones_like(splats.packed))
        times = []
        for _ in range(repeats + 2):
            begin = time.perf_counter()
            ops.add_project_gradients(gaussians, sums, gradient, view)
            times.append(time.perf_counter() - begin)
        backward = statistics.median(times)
    cull, forward, adam = (
        stages[name] for name in ("project: cull", "project: forward", "adam step")
    )
    visible = len(splats)
    return Costs(
        cull / len(scene.gaussians),
        (forward + backward) / visible,
        adam / visible,
        stages["total"] - cull - forward - adam,
        visible,
    )


def measured_rate() -> float:
    """Bytes per second that each of two processes of this computer sends to the other.

    The time includes packing and unpacking.
    """
    return min(float(line) for line in ranks([sys.executable, __file__, "--rate"], 2))


def print_rate() -> None:
    """One of the two processes: exchanges 250,000 splats of each of two views, and gradients."""
    ops.set_num_threads(1)
    with processes.joined(torch.device("cpu")) as shards, torch.no_grad():
        assert isinstance(shards, ProcessShards)
        views = [Splats2D(torch.zeros(250_000, 16), None, 3) for _ in range(2)]
        times = []
        for _ in range(8):
            shards.any(False)  # both begin at the same time
            before, begin = shards.sent_bytes, time.perf_counter()
            blended = shards.exchange(views)
            assert blended is not None
            blended.packed.grad = torch.zeros_like(blended.packed)
            blended.abs_grad = torch.zeros(len(blended), 2)
            shards.return_gradients(blended, views, absolute=True)
            times.append(time.perf_counter() - begin)
            sent = shards.sent_bytes - before
    print(sent / statistics.median(times[2:]), flush=True)


def check(size: str, counts: list[int], batch: int, repeats: int) -> None:
    """Print the model beside measured updates."""
    rate = measured_rate()
    print(f"two processes exchange {rate / 1e9:.2f} GB/s\n")
    print("processes  threads of each  model s  measured s  of it exchange s")
    gaussians = SIZES[size][0]
    with TemporaryDirectory() as temporary:
        write_photos(Path(temporary), size, batch)
        for count in counts:
            threads = max(1, (os.cpu_count() or 1) // count)
            costs = measured_costs(size, threads, repeats)
            expected = model(costs, gaussians, count, batch, rate)
            results = measure(size, batch, count, Path(temporary))
            seconds = max(result["seconds"] for result in results)
            print(
                f"{count:9}  {threads:15}  {expected.seconds:7.2f}  {seconds:10.2f}  "
                f"{expected.exchange:16.3f}",
                flush=True,
            )


def table(size: str, repeats: int) -> None:
    """Print the model for larger scenes and more processes."""
    costs = measured_costs(size, os.cpu_count() or 1, repeats)
    _, width, height = SIZES[size]
    print(f"photos of {width}×{height}, each shows {costs.visible:,} Gaussians")
    print(
        f"one process: {costs.cull * 1e9:.1f} ns per Gaussian, {costs.splat * 1e9:.0f} ns per "
        f"splat, {costs.adam * 1e9:.0f} ns per update of a Gaussian, {costs.photo:.3f} s per photo"
    )
    network = LINKS["10 Gbit/s network (data sheet)"]
    packing = measured_rate()
    rate = 1 / (1 / network + 1 / packing)
    print(f"packing, sending and unpacking on this computer: {packing / 1e9:.2f} GB/s")
    print("\nnodes like this computer, one photo per node and update, 10 Gbit/s network:")
    print("Gaussians    nodes  s/update  of it exchange  photos/s  state of a node GB")
    for gaussians in (1_000_000, 10_000_000, 100_000_000):
        for nodes in (1, 8, 64, 1000):
            update = model(costs, gaussians, nodes, nodes, rate, LATENCY)
            print(
                f"{gaussians:11,}  {nodes:5}  {update.seconds:8.2f}  {update.exchange:14.2f}  "
                f"{nodes / update.seconds:8.1f}  {update.state / 1e9:18.3f}"
            )
    print("\nthe exchange alone, one photo per GPU and update, seconds; and the state of a GPU:")
    for name, rate in LINKS.items():
        exchange = ", ".join(
            f"{gpus} GPUs: {model(costs, 0, gpus, gpus, rate).exchange:.5f}" for gpus in (8, 64)
        )
        print(f"  {name}: {exchange}")
    for gpus in (8, 64):
        state = model(costs, 100_000_000, gpus, gpus, network).state
        print(f"  100 million Gaussians on {gpus} GPUs: {state / 1e9:.2f} GB each")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--size", default="1m", choices=SIZES)
    parser.add_argument("--check", type=int, nargs="+", help="measure these numbers of processes")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--rate", action="store_true", help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.rate:
        print_rate()
    elif flags.check:
        check(flags.size, flags.check, flags.batch, flags.repeats)
    else:
        table(flags.size, flags.repeats)


if __name__ == "__main__":
    main()
