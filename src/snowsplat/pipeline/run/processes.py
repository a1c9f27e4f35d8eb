"""Training in several processes: starting them, joining them, and what all but the first one do.

`launch` starts processes on this computer. `torchrun` starts them on one or several computers; it
sets the same environment variables. Process 0 runs a training as a single process does. Before each
operation that needs the others, it tells them (`Collective`). They run `follow`.
"""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any

from snowsplat.util.errors import UserError
from snowsplat.util.interrupts import ended_together, interrupts_between_steps

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from snowsplat.evaluation.metrics import Evaluation
    from snowsplat.project.training_folder import DatasetSettings
    from snowsplat.scene.gaussians import Gaussians
    from snowsplat.training.core.run import Loss
    from snowsplat.training.core.trainer import Trainer
    from snowsplat.training.parts.part import Part
    from snowsplat.training.processes.shards import Shards
    from snowsplat.training.settings.config import TrainConfig
    from snowsplat.training.settings.schedule import Schedule

# Process 0 may compute the first Gaussians for a long time, while the others wait.
_TIMEOUT = timedelta(hours=2)
# After one process has ended, the others have this time to end by themselves.
_GRACE_SECONDS = 5.0
_CONTINUE = "rerun the command with --resume to continue from the last checkpoint"
_LOST = f"lost the connection to another process of the training, which has ended; {_CONTINUE}"
# Processes that `launch` has started end with this exit code when they lose the connection: they
# leave it to `launch` to report the process that was the first to end.
_LAUNCHED = "SNOWSPLAT_LAUNCHED"
_LOST_CODE = 75  # EX_TEMPFAIL of sysexits.h


class ProcessLost(UserError):
    """Another process of the training has ended."""


@dataclass(frozen=True)
class Setup:
    """What the other processes need to create the same trainer as process 0."""

    settings: DatasetSettings
    config: TrainConfig
    schedule: Schedule | None = None
    checkpoint: Path | None = None  # the file of the state to continue from


@dataclass(frozen=True)
class Collective:
    """The operations of a training that all its processes carry out together.

    Process 0 calls the methods. Before each operation, it tells the other processes, which are in
    `follow`, to do the same. A single process has nobody to tell. Each process has its own trainer.
    """

    trainer: Trainer

    def scene(self) -> Gaussians:
        """The Gaussians of all processes; the others than process 0 get no rows."""
        self._tell("scene")
        return self.trainer.shards.collect(self.trainer.gaussians)

    def state(self) -> dict[str, Tensor]:
        """See `Trainer.state_tensors`."""
        self._tell("state")
        return self.trainer.state_tensors()

    def evaluate(self) -> Evaluation:
        """See `Trainer.evaluate`."""
        self._tell("evaluate")
        return self.trainer.evaluate()

    def stretch(self, step: int, iterations: int) -> None:
        """See `Schedule.stretch`."""
        self._tell("stretch", step, iterations)
        self.trainer.schedule.stretch(step, iterations)

    def proceed(self) -> None:
        """Let the other processes go on with the next step, or end."""
        self.trainer.shards.of_first(None)

    def follow(self) -> None:
        """Do what process 0 does, until it calls `proceed`; for the other processes."""
        while (told := self.trainer.shards.of_first(None)) is not None:
            name, *arguments = told
            getattr(self, name)(*arguments)

    def _tell(self, *operation: Any) -> None:
        if self.trainer.shards.rank == 0:
            self.trainer.shards.of_first(operation)


def end_with_launcher() -> None:
    """If `launch` has started this process, end at once when that process has ended.

    Otherwise, the processes of a killed command would go on, and keep the output folder locked.
    """
    if _LAUNCHED in os.environ:

        def watch() -> None:
            while os.read(0, 1):  # nothing is written; the pipe ends with the process
                pass
            os._exit(_LOST_CODE)

        threading.Thread(target=watch, daemon=True).start()


def count() -> int:
    """The number of processes that `launch` or `torchrun` has started together; 1: only this."""
    return int(os.environ.get("WORLD_SIZE", "1")) if "RANK" in os.environ else 1


def is_first() -> bool:
    """Whether this is process 0, or the only one."""
    return count() == 1 or os.environ["RANK"] == "0"


def local_count() -> int:
    """The number of these processes on this computer."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))) if count() > 1 else 1


@contextmanager
def joined(device: torch.device) -> Iterator[Shards]:
    """The processes that train together, as `Shards`.

    Raises: ProcessLost: another process has ended.
    """
    from snowsplat.training.processes.shards import ALONE

    if count() == 1:
        yield ALONE
        return
    import torch.distributed as dist

    from snowsplat.training.processes.process_shards import ProcessShards

    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    try:
        dist.init_process_group(backend, timeout=_TIMEOUT)
        yield ProcessShards(device, local_count() if device.type == "cpu" else 1)
    except RuntimeError as error:
        if isinstance(error, dist.DistError) or "gloo" in str(error) or "onnection" in str(error):
            if _LAUNCHED in os.environ:
                raise SystemExit(_LOST_CODE) from None
            raise ProcessLost(_LOST) from None
        raise
    finally:
        with suppress(Exception):  # the connection may be lost
            dist.destroy_process_group()


def follow(
    shards: Shards, device: torch.device, parts: Sequence[Part] = (), loss: Loss | None = None
) -> None:
    """Take part in the training of process 0, until it ends; ``parts`` and ``loss`` as there."""
    from snowsplat.data import read_dataset
    from snowsplat.training.core.checkpoint import load
    from snowsplat.training.core.trainer import Trainer
    from snowsplat.training.parts.list import all_parts_of
    from snowsplat.training.step.finite import Diverged

    setup = shards.of_first(None)
    assert isinstance(setup, Setup)
    state = None if setup.checkpoint is None else load(setup.checkpoint).tensors
    trainer = Trainer(
        read_dataset(setup.settings),
        setup.config,
        setup.schedule,
        device,
        state,
        shards=shards,
        parts=[*all_parts_of(setup.config), *parts],
        loss=loss,
    )
    together = Collective(trainer)
    with suppress(KeyboardInterrupt, Diverged):  # process 0 has the same one, and reports it
        together.follow()
        trainer.run(lambda progress: together.follow())
    if not trainer.within_step:
        together.follow()


def launch(processes: int, arguments: Sequence[str]) -> int:
    """Run ``snowsplat ARGUMENTS`` in several processes on this computer; returns the exit code.

    The output is that of process 0. If a process ends with an error, the others end, too.
    Raises: UserError: fewer than 1 process.
    """
    if processes < 1:
        raise UserError("{processes} processes are too few; use 1 or more", processes=processes)
    command = [sys.executable, "-m", "snowsplat", *arguments]
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    shared = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": str(processes),
        "LOCAL_WORLD_SIZE": str(processes),
        _LAUNCHED: "1",
    }
    if sys.platform == "linux":
        shared["GLOO_SOCKET_IFNAME"] = "lo"
    with ExitStack() as files:
        running, errors = [], []
        for rank in range(processes):
            environment = os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
            output = None if rank == 0 else subprocess.DEVNULL
            error = None if rank == 0 else files.enter_context(TemporaryFile())
            errors.append(error)
            process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=output, stderr=error
            )
            files.enter_context(ended_together(process))
            running.append(files.enter_context(process))
        try:
            failed = _wait(running)
        finally:
            for process in running:
                process.kill()
                process.wait()
        return _exit_code(running, failed, errors)


def _wait(running: Sequence[subprocess.Popen[bytes]]) -> int | None:
    """Wait until all processes have ended, or a while after one of them has failed.

    Returns the first process that has failed, except for those that lost the connection to it.
    """
    deadline = math.inf
    failed: int | None = None
    with interrupts_between_steps():  # they reach the processes, too, which save the scene and end
        while True:
            codes = [process.poll() for process in running]
            if any(codes):
                deadline = min(deadline, time.monotonic() + _GRACE_SECONDS)
            first = [rank for rank, code in enumerate(codes) if code not in (None, 0, _LOST_CODE)]
            if failed is None and first:
                failed = first[0]
            if None not in codes or time.monotonic() > deadline:
                return failed
            time.sleep(0.05)


def _exit_code(
    running: Sequence[subprocess.Popen[bytes]],
    failed: int | None,
    errors: Sequence[IO[bytes] | None],
) -> int:
    """The exit code of `launch`. Prints one line if process 0 has not reported the failure."""
    lost = any(process.returncode == _LOST_CODE for process in running)
    if failed is None:
        if lost:
            print(f"snowsplat: {_LOST}", file=sys.stderr)
        return 2 if lost else 0
    code = running[failed].returncode
    if failed == 0 and code > 0:
        return code
    what = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
    error = errors[failed]
    if error is not None and code > 0:
        error.seek(0)
        last = error.read().decode(errors="replace").strip().splitlines()[-1:]
        what += f" ({''.join(last)})"
    line = f"process {failed} {what}, so the training has stopped; {_CONTINUE}"
    print(f"snowsplat: {line}", file=sys.stderr)
    return 2
