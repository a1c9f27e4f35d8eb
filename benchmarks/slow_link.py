"""Delay of the live viewer over a slow link, while a mouse is dragged.

    python benchmarks/slow_link.py                       5 Mbit/s, 50 ms in each direction
    python benchmarks/slow_link.py --rate 2 --delay 100

The training is paused. A client moves its camera 50 times per second, as a browser does. The delay
of a movement is the time until the first image arrives that shows it, or a later one. Each image
contains the number of its movement, in black and white blocks. The link is a proxy in this process,
with a queue of 128 KiB in each direction, as that of a router.
"""

from __future__ import annotations

import argparse
import math
import socket
import statistics
import threading
import time
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import torch
from workloads import SIZES, workload

from snowsplat.data import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.gaussians import Gaussians
from snowsplat.viewer.live.session import RenderRequest
from snowsplat.viewer.live.viewer import NetworkViewer
from viewer import Client

QUEUE = 128 << 10  # bytes
BITS, BLOCK = 12, 8  # of the number in an image
STEP = 0.001  # world units between two movements
PERIOD = 0.02  # seconds between two movements


class SlowLink:
    """Connections to ``port`` of this machine through a link; they are made to `port`."""

    def __init__(self, port: int, rate: float, delay: float) -> None:
        """``rate``: bytes per second; ``delay``: seconds, in each direction."""
        self._target, self._rate, self._delay = port, rate, delay
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            client, _ = self._listener.accept()
            server = socket.socket()
            # The kernel must not hold much more than the link.
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 32 << 10)
            server.connect(("127.0.0.1", self._target))
            for source, target in ((client, server), (server, client)):
                source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=self._carry, args=(source, target), daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket) -> None:
        """Move bytes in one direction, in packets."""
        packets: SimpleQueue[tuple[float, bytes]] = SimpleQueue()  # when it arrives, and its bytes

        def deliver() -> None:
            while True:
                arrives, data = packets.get()
                time.sleep(max(0.0, arrives - time.monotonic()))
                target.sendall(data)

        threading.Thread(target=deliver, daemon=True).start()
        free = time.monotonic()  # when the link has sent all packets so far
        while data := source.recv(1460):
            free = max(free, time.monotonic()) + len(data) / self._rate
            packets.put((free + self._delay, data))
            # The queue is what the link has not sent yet; its sender waits for it.
            time.sleep(max(0.0, free - time.monotonic() - QUEUE / self._rate))


class NumberedViewer(NetworkViewer):
    """Writes the number of the movement into each image; `drawing` are the times of rendering."""

    left: float = 0.0  # x of the camera of movement 0
    drawing: list[float]

    def _draw(self, request: RenderRequest, gaussians: Gaussians) -> np.ndarray:
        started = time.perf_counter()
        image = super()._draw(request, gaussians)
        self.drawing.append(time.perf_counter() - started)
        number = round((float(request.view.position[0]) - self.left) / STEP)
        for bit in range(BITS):
            at = slice(bit * BLOCK, (bit + 1) * BLOCK)
            image[:BLOCK, at] = 255 * (number >> bit & 1)
        return image


def number_of(image: np.ndarray) -> int:
    """The number that `NumberedViewer` has written."""
    middle = image[BLOCK // 2, BLOCK // 2 : BITS * BLOCK : BLOCK, 1]
    return sum(1 << bit for bit in range(BITS) if middle[bit] > 127)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="200k", choices=SIZES)
    parser.add_argument("--rate", type=float, default=5.0, help="Mbit/s; 0: no link")
    parser.add_argument("--delay", type=float, default=50.0, help="ms, in each direction")
    parser.add_argument("--drags", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="of a drag")
    arguments = parser.parse_args()
    scene = workload(arguments.size)
    camera = scene.camera
    nowhere = ImageSource(Path("nowhere.jpg"), camera.width, camera.height)
    points = Points(scene.gaussians.means, torch.zeros(len(scene.gaussians), 3, dtype=torch.uint8))
    viewer = NumberedViewer(Dataset([View("view", camera, nowhere)], [], points, 1.0))
    viewer.drawing = []
    rotation = camera.cam_from_world[:, :3]
    # Movements are along the world's x axis.
    position = -rotation.T @ camera.cam_from_world[:, 3]
    viewer.left = float(position[0])
    viewer.session.pause()
    port = viewer.server.port
    link = SlowLink(port, arguments.rate * 125e3, arguments.delay / 1e3)
    via = link.port if arguments.rate else port
    finished = threading.Event()
    delays: list[list[float]] = []
    rates: list[float] = []
    sizes: list[float] = []
    widths: list[int] = []

    def drag() -> None:
        through = socket.create_connection(("localhost", via))
        client = Client(viewer, camera.width, camera.height, through)
        fov = 2 * math.atan(0.5 * camera.height / camera.fy)
        client.move(camera.cam_from_world, fov, 0.0)
        moved: list[float] = []  # when

        def receive(until: float) -> None:
            while client.wait(until - time.monotonic()):
                now, image = time.monotonic(), np.asarray(client.newest)
                arrived.append((now, number_of(image)))
                sizes.append(client.bytes)
                widths.append(image.shape[1])

        arrived: list[tuple[float, int]] = []
        number = 0
        receive(time.monotonic() + 8.0)  # the page, and the first images
        sizes.clear(), widths.clear(), viewer.drawing.clear()
        for _ in range(arguments.drags):
            arrived = []
            first = number + 1
            started = time.monotonic()
            moved = []
            receiver = threading.Thread(
                target=receive, args=(started + arguments.seconds + 4.0,), daemon=True
            )
            receiver.start()
            while time.monotonic() - started < arguments.seconds:
                number += 1
                moved.append(time.monotonic())
                client.move_to(
                    rotation, fov, position + position.new_tensor([STEP * number, 0.0, 0.0])
                )
                time.sleep(PERIOD)
            receiver.join()
            found = []
            for i, when in enumerate(moved):
                shown = [at for at, which in arrived if which >= first + i]
                found.append(min(shown) - when if shown else math.inf)
            delays.append(found)
            rates.append(sum(at < moved[-1] for at, _ in arrived) / arguments.seconds)
        client.close()
        finished.set()

    thread = threading.Thread(target=drag, daemon=True)
    thread.start()
    while not finished.is_set() and thread.is_alive():
        if not viewer.serve(scene.gaussians, 0, training=False):
            viewer.wait()
    viewer.close()
    print("ms     median    worst  last quarter  images/s")
    for found, rate in zip(delays, rates, strict=True):
        last = found[-len(found) // 4 :]
        print(
            f"drag {1e3 * statistics.median(found):8.0f} {1e3 * max(found):8.0f}"
            f" {1e3 * statistics.median(last):13.0f} {rate:9.1f}"
        )
    every = [each for found in delays for each in found]
    print(
        f"all  {1e3 * statistics.median(every):8.0f} {1e3 * max(every):8.0f}\n"
        f"rendering {1e3 * statistics.median(viewer.drawing):.0f} ms; images of "
        f"{statistics.median(sizes) / 1e3:.0f} kB, {statistics.median(widths):.0f} pixels wide"
    )


if __name__ == "__main__":
    main()
