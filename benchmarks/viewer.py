"""Times of the live viewer: rendering, response to a moving camera, and slowdown of training.

    python benchmarks/viewer.py                      200k Gaussians at 960×540
    python benchmarks/viewer.py --dataset DIR        also a training run: alone, watched, and
                                                     watched with a camera that always moves

The browser is replaced by a client that receives the images but does not draw them, since a real
browser may run on another machine.
"""

import argparse
import io
import json
import math
import statistics
import struct
import threading
import time
from pathlib import Path
from socket import socket

import torch
from PIL import Image
from websockets.sync.client import connect
from workloads import SIZES, workload

from snowsplat import Trainer, load_dataset, ops, recipe
from snowsplat.data import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.util.process import single_threaded
from snowsplat.viewer.live.pictures import Display, draw
from snowsplat.viewer.live.training import SampledPsnr, TrainingViewer
from snowsplat.viewer.live.viewer import NetworkViewer

MODES = ("color", "depth", "alpha", "normals", "points", "ellipsoids", "cost")


class Client:
    """The protocol of a browser, without a display."""

    def __init__(
        self, viewer: NetworkViewer, width: int, height: int, through: socket | None = None
    ) -> None:
        """``through``: a connection to the viewer; default: a direct one."""
        address = viewer.url.replace("http", "ws") + "live"
        self._socket = connect(address, sock=through, max_size=None, compression=None)
        self._size = width, height
        self._moves = self.images = 0

    def move(self, cam_from_world: torch.Tensor, fov: float, shift: float) -> None:
        """Set the camera, shifted by ``shift`` to the right."""
        rotation = cam_from_world[:, :3]
        self.move_to(rotation, fov, -rotation.T @ cam_from_world[:, 3] + shift * rotation[0])

    def move_to(self, rotation: torch.Tensor, fov: float, position: torch.Tensor) -> None:
        """Set the camera at a position (3,)."""
        width, height = self._size
        self._moves += 1
        self._send(
            type="view",
            number=self._moves,
            quat=quat_from_rotation(rotation.T).tolist(),
            position=position.tolist(),
            fov=fov,
            width=width,
            height=height,
        )

    def _send(self, **message: object) -> None:
        self._socket.send(json.dumps(message))

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for an image; False if none arrived in time."""
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            left = None if end is None else max(0.0, end - time.monotonic())
            try:
                data = self._socket.recv(timeout=left)
            except TimeoutError:
                return False
            if isinstance(data, bytes):
                kind, number, _ = struct.unpack_from("<BxxxII", data)
                if kind == 0:
                    self._send(type="shown", number=number)
                    self.images += 1
                    self.bytes = len(data)
                    self.newest = Image.open(io.BytesIO(data[12:]))
                    return True

    def close(self) -> None:
        self._socket.close()


def milliseconds(times: list[float]) -> str:
    return f"{1000 * min(times):8.1f} {1000 * statistics.median(times):8.1f}"


def images(name: str, repeats: int) -> None:
    """Render all display modes, without a server."""
    scene = workload(name)
    print(
        f"{len(scene.gaussians):,} Gaussians of {scene.source}, ops on "
        f"{ops.get_num_threads()} threads\n\nms {'':12} {'min':>8} {'median':>8}"
    )
    for mode in MODES:
        times = []
        for _ in range(repeats):
            started = time.perf_counter()
            draw(scene.gaussians, scene.camera, Display(mode))
            times.append(time.perf_counter() - started)
        print(f"{mode:15} {milliseconds(times)}")


def answers(name: str, repeats: int) -> None:
    """Time from a camera message to the image at the client."""
    scene = workload(name)
    camera = scene.camera
    nowhere = ImageSource(Path("nowhere.jpg"), camera.width, camera.height)
    points = Points(scene.gaussians.means, torch.zeros(len(scene.gaussians), 3, dtype=torch.uint8))
    dataset = Dataset([View("view", camera, nowhere)], [], points, 1.0)
    viewer = NetworkViewer(dataset)
    stop = threading.Event()
    times: dict[str, list[float]] = {"answer": [], "full": []}
    sizes: list[int] = []

    def ask() -> None:
        client = Client(viewer, camera.width, camera.height)
        fov = 2 * math.atan(0.5 * camera.height / camera.fy)
        for i in range(repeats + 5):
            started = time.perf_counter()
            client.move(camera.cam_from_world, fov, 0.001 * i)
            client.wait()
            first = time.perf_counter() - started
            sizes.append(client.newest.width)
            client.wait()
            if i >= 5:  # before that, the viewer adapts the image size
                times["answer"].append(first)
                times["full"].append(time.perf_counter() - started)
        client.close()
        stop.set()

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    while not stop.is_set() and thread.is_alive():
        if not viewer.serve(scene.gaussians, 0, training=False):
            viewer.wait()
    thread.join()
    viewer.close()
    for row, values in times.items():
        print(f"{row:15} {milliseconds(values)}")
    print(f"answers are {statistics.median(sizes):.0f} pixels wide, full images {camera.width}")


def training(path: Path, seconds: float, rounds: int) -> None:
    """Steps per second of one training run, measured alternately with and without viewers."""
    dataset = load_dataset(path)
    # With these settings, the speed of training is constant after the first steps.
    config = recipe("default", iterations=1_000_000, coarse_to_fine=(1, 2), densify_until=900)
    trainer = Trainer(dataset, config)
    trainer.run(until=1000)
    viewer = NetworkViewer(dataset)
    hook = TrainingViewer(viewer, SampledPsnr(dataset.train, viewer.background))
    camera = dataset.train[0].camera
    found: dict[str, list[float]] = {}

    def measure(name: str, call: bool) -> None:
        first, started = trainer.step, time.perf_counter()
        while (elapsed := time.perf_counter() - started) < seconds:
            loss = trainer.step_once()
            if call:
                hook.after_step(trainer.step, 1_000_000, loss, trainer.gaussians)
        found.setdefault(name, []).append((trainer.step - first) / elapsed)

    def watch(moving: bool) -> None:
        client, shift = Client(viewer, 960, 540), 0.0
        client.move(camera.cam_from_world, 1.0, 0.0)
        while not stop.is_set():
            if (client.wait(0.05) and moving) or shift == 0.0:
                shift += 0.001
                client.move(camera.cam_from_world, 1.0, shift)
        shown.append(client.images)
        client.close()

    shown: list[int] = []
    with single_threaded():
        for _ in range(rounds):
            measure("no viewer", False)
            measure("no browser", True)
            for name, moving in (("watched", False), ("moving", True)):
                stop = threading.Event()
                thread = threading.Thread(target=watch, args=(moving,))
                thread.start()
                time.sleep(0.5)
                measure(name, True)
                stop.set()
                thread.join()
                time.sleep(0.5)
    viewer.close()
    print(
        f"\n{len(trainer.gaussians):,} Gaussians, {camera.width}x{camera.height}, steps per second"
    )
    alone = found["no viewer"]
    for name, rates in found.items():
        shares = [rate / base for rate, base in zip(rates, alone, strict=True)]
        print(f"{name:15} {statistics.median(rates):8.1f}  {statistics.median(shares):6.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="200k", choices=SIZES)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--dataset", "--capture", type=Path, help="also measure training on it")
    parser.add_argument(
        "--seconds", type=float, default=8.0, help="of each measurement of the training"
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    if arguments.threads:
        ops.set_num_threads(arguments.threads)
    images(arguments.size, arguments.repeats)
    answers(arguments.size, arguments.repeats)
    if arguments.dataset:
        training(arguments.dataset, arguments.seconds, arguments.rounds)


if __name__ == "__main__":
    main()
