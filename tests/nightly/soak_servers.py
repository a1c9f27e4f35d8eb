"""Runs both servers for an hour, with visitors that connect, look around and disconnect.

`train --view` on a small dataset and `view` of a scene run as separate processes. Some visitors
disconnect abruptly, some are hostile. Memory, threads and file descriptors of the servers are
recorded every few seconds. At the end,

- each server must still be running;
- its memory must be constant: the least-squares slope over the last half must be below BOUND;
- the numbers of threads and descriptors must be within LIMITS;
- the training must have made steps all the time;
- the terminal must have no unexpected output.

Before the visitors start, the script opens a thousand connections. The speed of training must then
be at least RATIO of the speed without connections.

    python tests/nightly/soak_servers.py DATASET --minutes 60
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from websockets.exceptions import InvalidHandshake, WebSocketException

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.viewer.clients import (  # noqa: E402
    HOSTILE,
    HOSTILE_TO_ANY,
    Visitor,
    get,
    hostile,
    open_socket,
    path,
    reset,
    status,
)

BOUND = 0.5  # MiB per minute
RATIO = 0.7  # of the steps per second that a training run makes alone
LIMITS = {"threads": 320, "descriptors": 400}
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "PYTHONUNBUFFERED": "1"}


def _accept_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@dataclass
class Server:
    """A process, and its resource use over time."""

    name: str
    process: subprocess.Popen[str]
    url: str = ""
    output: list[str] = field(default_factory=list)
    samples: list[tuple[float, float, int, int, int]] = field(default_factory=list)

    @classmethod
    def start(cls, name: str, *command: object) -> Server:
        words = [sys.executable, "-m", "snowsplat", *map(str, command)]
        process = subprocess.Popen(
            words,
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            # A shell starts background processes with Ctrl-C ignored, also their children.
            preexec_fn=_accept_ctrl_c,
        )
        server = cls(name, process)
        threading.Thread(target=server._read, daemon=True).start()
        while not (found := re.search(r"http://127\S+", "".join(server.output))):
            assert process.poll() is None, server.output
            time.sleep(0.1)
        server.url = found[0]
        return server

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.output.append(line)

    @property
    def step(self) -> int:
        """The last step that it reported."""
        lines = [line for line in self.output[-50:] if line.startswith("step ")]
        return int(re.findall(r"\d+", lines[-1].replace(",", ""))[0]) if lines else 0

    def sample(self, seconds: float) -> None:
        folder = Path(f"/proc/{self.process.pid}")
        # Without memory-mapped files, which the system loads and evicts.
        kilobytes = re.search(r"RssAnon:\s+(\d+)", (folder / "status").read_text())
        assert kilobytes is not None
        rss = int(kilobytes[1]) / 1024
        threads = len(os.listdir(folder / "task"))
        self.samples.append((seconds, rss, threads, len(os.listdir(folder / "fd")), self.step))

    def end(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.process.wait(120)

    def defects(self) -> list[str]:
        """The violated guarantees."""
        table = np.array(self.samples)
        last = table[len(table) // 2 :]
        slope = 60.0 * np.polyfit(last[:, 0], last[:, 1], 1)[0]
        drift = np.median(last[-len(last) // 4 :, 1]) - np.median(last[: len(last) // 4, 1])
        print(
            f"{self.name}: memory over the last half {slope:+.3f} MiB per minute ({drift:+.1f} MiB"
        )
        print(f"  between its first and last quarters); threads at most {table[:, 2].max():.0f},")
        print(f"  descriptors at most {table[:, 3].max():.0f}")
        found = []
        if slope > BOUND:
            found.append(f"{self.name}: memory grows by {slope:.2f} MiB per minute")
        for column, (what, most) in enumerate(LIMITS.items(), 2):
            if table[:, column].max() > most:
                found.append(f"{self.name}: {table[:, column].max():.0f} {what}")
        if self.process.returncode not in (0, 130):
            found.append(f"{self.name}: ended with {self.process.returncode}")
        strange = re.compile("Traceback|Error|Warning|uvicorn|websockets|asyncio", re.IGNORECASE)
        for line in self.output:
            if strange.search(line) and not line.startswith("step "):
                found.append(f"{self.name}: printed {line.strip()!r}")
        return found


def undisturbed(training: Server) -> float:
    """Steps per second among a thousand connections, idle and active, relative to those without.

    Both are measured alternately, since the load of the machine varies.
    """
    rates: dict[bool, list[float]] = {False: [], True: []}
    clients = ROOT / "tests/viewer/clients.py"
    for _ in range(8):
        for attacked in (False, True):
            command = [sys.executable, clients, training.url, "8", "half open=10", "strangers=2"]
            process = None
            if attacked:
                process = subprocess.Popen(
                    command, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.nice(9)
                )
                assert process.stdout is not None
                process.stdout.readline()
                time.sleep(1.0)
            began, first = time.monotonic(), training.step
            time.sleep(6.0)
            rates[attacked].append((training.step - first) / (time.monotonic() - began))
            if process is not None:
                process.kill()
                process.wait()
    quiet, noisy = (float(np.median(rates[attacked])) for attacked in (False, True))
    print(f"steps per second: {quiet:.1f} alone, {noisy:.1f} with 1000 idle and active")
    print(f"  connections: ratio {noisy / quiet:.2f} (medians of 8 measurements of 6 s)")
    return noisy / quiet


class Crowd:
    """The threads of the visitors."""

    def __init__(self, training: Server, scene: Server, seed: int) -> None:
        self._training, self._scene = training, scene
        self._over = threading.Event()
        self.done: Counter[str] = Counter()
        self.wrong: list[str] = []
        self._threads = [
            threading.Thread(target=self._visit_repeatedly, args=(seed + i, kind), daemon=True)
            for i, kind in enumerate([*"vvvv", *"ss", *"hh"])
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join(30)

    def _visit_repeatedly(self, seed: int, kind: str) -> None:
        rng = random.Random(seed)
        while not self._over.is_set():
            visit = {"v": self._visit, "s": self._load, "h": self._attack}[kind]
            try:
                self.done[visit(rng)] += 1
            except (OSError, TimeoutError, WebSocketException, InvalidHandshake):
                self.done["disconnected by the server"] += 1
            self._over.wait(rng.uniform(0.0, 3.0))

    def _visit(self, rng: random.Random) -> str:
        """Use the page of the training."""
        visitor = Visitor(self._training.url)
        size = rng.choice([(320, 240), (640, 480), (800, 200)])
        pictures = 0
        for _ in range(rng.randrange(1, 12)):
            position = [rng.uniform(-2, 2) for _ in range(3)]
            visitor.view(position=position, width=size[0], height=size[1])
            pictures += visitor.pictures(rng.uniform(0.1, 2.0))
            rng.choice(
                [
                    lambda: visitor.display(mode=rng.choice(["depth", "color", "points"])),
                    lambda: visitor.display(degree=rng.randrange(4), scale=rng.random()),
                    lambda: visitor.view(photo=rng.randrange(3)),
                    lambda: visitor.send("key"),
                ]
            )()
        self.done["pictures"] += pictures
        if rng.random() < 0.5:
            visitor.__exit__()
            return "visits"
        reset(visitor.socket.socket)
        return "visits that end abruptly"

    def _load(self, rng: random.Random) -> str:
        """Load one of the pages, sometimes disconnecting during the download."""
        url = rng.choice([self._scene.url, self._scene.url, self._training.url])
        if rng.random() < 0.3:
            client = open_socket(url)
            client.sendall(f"GET {path(url)} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            client.recv(1000)
            reset(client)
            return "pages left"
        if rng.random() < 0.3:
            wanted, what = 404, "refusals"
            answer = get(url, "/no/such/page")
        else:
            wanted, what = 200, "pages"
            answer = get(url)
        # The server may reject it because of the other connections, but the response must be valid.
        if status(answer) in (0, 503):
            return "rejected"
        if status(answer) != wanted:
            self.wrong.append(f"{url}: {answer[:200]!r}")
        return what

    def _attack(self, rng: random.Random) -> str:
        kind = rng.choice(list(HOSTILE))
        servers = [self._training, self._scene] if kind in HOSTILE_TO_ANY else [self._training]
        hostile(kind, rng.choice(servers).url, rng.uniform(1.0, 8.0))
        return f"hostile: {kind}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="a dataset to train on")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--width", type=int, default=160, help="of the photos, pixels")
    parser.add_argument("--gaussians", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        out, small = Path(folder, "out"), Path(folder, "small")
        flags = ["-r", arguments.width, "--max-gaussians", arguments.gaussians, "--threads", 1]
        short = ["train", arguments.dataset, "-o", small, "--iterations", 50, *flags, "-q"]
        subprocess.run(
            [sys.executable, "-m", "snowsplat", *map(str, short)], env=ENVIRONMENT, check=True
        )
        training = Server.start(
            *("training", "train", arguments.dataset, "-o", out, "--iterations", 50_000_000),
            *(*flags, "--view"),
        )
        stack.callback(training.process.kill)
        scene = Server.start("scene", "view", small, "--no-browser")
        stack.callback(scene.process.kill)
        while not training.step:
            time.sleep(0.2)
        found = []
        if undisturbed(training) < RATIO:
            found.append("a thousand connections disturb the training")
        crowd = Crowd(training, scene, arguments.seed)
        crowd.start()
        began = time.monotonic()
        tell, steps = 0.0, []
        print("minute  training: MiB threads  fds   steps/s   scene: MiB threads fds")
        while (passed := time.monotonic() - began) < 60.0 * arguments.minutes:
            alive = [server for server in (training, scene) if server.process.poll() is None]
            if len(alive) < 2:
                found += [
                    f"{server.name}: ended by itself with {server.process.returncode}; output: "
                    + "".join(server.output[-20:])
                    for server in (training, scene)
                    if server not in alive
                ]
                break
            for server in alive:
                server.sample(passed)
            if passed >= tell:
                a, b = training.samples[-1], scene.samples[-1]
                before = training.samples[max(0, len(training.samples) - 13)]
                rate = (a[4] - before[4]) / max(a[0] - before[0], 1e-9)
                steps.append(rate)
                print(
                    f"{passed / 60:6.1f}  {a[1]:13.1f} {a[2]:7d} {a[3]:4d}  {rate:8.1f}  "
                    f"{b[1]:11.1f} {b[2]:7d} {b[3]:3d}",
                    flush=True,
                )
                tell += max(60.0, 60.0 * arguments.minutes / 30)
            time.sleep(5.0)
        crowd.stop()
        for server in (training, scene):
            server.end()
        found += [*training.defects(), *scene.defects(), *crowd.wrong]
        if min(steps[1:], default=1.0) <= 0.0:
            found.append("the training made no steps")
        for what, times in sorted(crowd.done.items()):
            print(f"{times:7d} {what}")
    print(*found, sep="\n")
    print(f"{len(found)} defects in {arguments.minutes:g} minutes")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
