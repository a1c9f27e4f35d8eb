"""Sends random messages to the live page of a training, from several connections at once.

The messages are those of the page with random values, missing and unknown fields, cut and joined
pieces, random bytes, and random frames. Many more are sent than a page can send, so connections
are closed, and made again. Meanwhile the training makes steps, and a well-behaved client looks.
At the end,

- the training must have the same bits as one without a page;
- memory must have grown by less than BOUND;
- the well-behaved client must have received images all the time.

    python tests/nightly/fuzz_live_page.py --messages 650000
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.viewer.clients import (  # noqa: E402
    WRONG,
    Visitor,
    display,
    frame,
    reset,
    upgrade,
    view,
    wrong_messages,
)

from snowsplat.data import load_dataset  # noqa: E402
from snowsplat.synthetic.toy_dataset import write_toy_dataset  # noqa: E402
from snowsplat.training.core.trainer import Trainer  # noqa: E402
from snowsplat.training.settings.config import TrainConfig  # noqa: E402
from snowsplat.viewer.live import browser as live_browser  # noqa: E402
from snowsplat.viewer.live.browser import parse  # noqa: E402
from snowsplat.viewer.live.training import SampledPsnr, TrainingViewer  # noqa: E402
from snowsplat.viewer.live.viewer import NetworkViewer  # noqa: E402

BOUND = 48.0  # MiB
STEPS = 1_000_000


def megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def value(rng: random.Random, depth: int = 0) -> object:
    """A random JSON value."""
    kind = rng.randrange(8 if depth < 3 else 5)
    if kind == 0:
        return rng.choice(WRONG)
    if kind == 1:
        return rng.uniform(-1, 1) * 10.0 ** rng.randrange(-320, 308)
    if kind == 2:
        return rng.randrange(-(2**70), 2**70)
    if kind == 3:
        return rng.choice(["", "view", "color", "pause", "x" * rng.randrange(3000), "\0\ud800"])
    if kind == 4:
        return rng.choice([True, False, None])
    if kind in (5, 6):
        return [value(rng, depth + 1) for _ in range(rng.randrange(6))]
    return {str(value(rng, 3))[:9]: value(rng, depth + 1) for _ in range(rng.randrange(4))}


def message(rng: random.Random) -> str | bytes:
    kind = rng.randrange(8)
    if kind == 0:
        return rng.randbytes(rng.randrange(200))
    if kind == 1:
        return rng.choice(wrong)
    if kind == 2:
        both = view() + display()
        return both[rng.randrange(len(both)) :][: rng.randrange(300)]
    if kind == 3:
        return json.dumps(value(rng))
    known = json.loads(rng.choice([view(), display(), '{"type": "shown", "number": 1}']))
    if kind == 4:
        known = {"type": rng.choice(["training", "share", "key", "x"]), "do": "resume"}
    for _ in range(rng.randrange(3)):
        known[rng.choice([*known, "do", "share", "number", "more"])] = value(rng)
    return json.dumps(known)


def fuzz(url: str, count: int, seed: int) -> None:
    """Send so many messages; a connection that is closed is made again."""
    rng = random.Random(seed)
    while count > 0:
        with contextlib.suppress(OSError):
            client = upgrade(url)
            for _ in range(rng.randrange(1, 2000)):
                count -= 1
                content = message(rng)
                opcode = 1 if isinstance(content, str) else 2
                if rng.random() < 0.002:  # most of these close the connection
                    opcode = rng.randrange(16)
                whole = frame(content, opcode, fin=rng.random() > 0.001)
                client.sendall(whole if rng.random() > 0.001 else whole[: len(whole) // 2])
                sent[seed] += 1
            reset(client)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--messages", type=int, default=650_000)
    parser.add_argument("--connections", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = write_toy_dataset(Path(folder, "toy"), "colmap-bin", 6, 96, 72, n_points=500)
        dataset = load_dataset(root)
        trainer = Trainer(dataset, TrainConfig(iterations=STEPS))
        viewer = NetworkViewer(dataset)
        hook = TrainingViewer(viewer, SampledPsnr(dataset.train, viewer.background))
        each = arguments.messages // arguments.connections
        threads = []
        for number in range(arguments.connections):
            seed = arguments.seed + number
            sent[seed] = 0
            threads.append(threading.Thread(target=fuzz, args=(viewer.url, each, seed)))
        read = [0]

        def counted(text: str) -> object:
            read[0] += 1
            return parse(text)

        live_browser.parse = counted
        seen: list[float] = []
        over = threading.Event()

        def look() -> None:
            turn = 0
            while not over.is_set():
                with contextlib.suppress(OSError, TimeoutError), Visitor(viewer.url) as visitor:
                    while not over.is_set():
                        turn += 1
                        visitor.view(position=[0.0, 0.001 * turn, -3.0])
                        if visitor.pictures(1.0, most=1):
                            seen.append(time.monotonic())

        threads.append(threading.Thread(target=look))
        began, before = time.monotonic(), megabytes()
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads[:-1]):
            loss = trainer.step_once()
            viewer.session.resume()  # one of the messages pauses the training
            hook.after_step(trainer.step, STEPS, loss, trainer.gaussians)
        over.set()
        threads[-1].join()
        grown, seconds = megabytes() - before, time.monotonic() - began
        viewer.close()
        plain = Trainer(dataset, TrainConfig(iterations=STEPS))
        while plain.step < trainer.step:
            plain.step_once()
        ours, theirs = plain.state_tensors(), trainer.state_tensors()
        same = all(torch.equal(ours[name], theirs[name]) for name in ours)
    gaps = [b - a for a, b in zip([began, *seen], [*seen, began + seconds], strict=True)]
    print(
        f"{sum(sent.values()):,} messages, {read[0]:,} read, in {seconds:.0f} s; "
        f"{trainer.step} steps, {'the same bits' if same else 'OTHER BITS'}; {len(seen)} images, "
        f"at most {max(gaps):.1f} s apart; memory {grown:+.1f} MiB"
    )
    return int(not same or grown > BOUND or max(gaps) > 10.0)


wrong = wrong_messages()
sent: dict[int, int] = {}

if __name__ == "__main__":
    sys.exit(main())
