"""A process of a training run of several processes, for the tests: trains and saves the results.

    python shards_worker.py DATASET OUTPUT RUNS

RUNS is a list of keyword arguments of `recipe`, as JSON. For each of them, process 0 writes the
state, the losses, the PSNR of the test views, and the number of bytes that each process has sent.
"""

import json
import sys
from pathlib import Path

import torch

from snowsplat import ops
from snowsplat.data.load import load_dataset
from snowsplat.pipeline.run.processes import joined
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.processes.process_shards import ProcessShards
from snowsplat.training.settings.recipes import recipe


def main(dataset: str, output: str, runs: str) -> None:
    ops.set_num_threads(1)
    results = []
    with joined(torch.device("cpu")) as shards:
        for settings in json.loads(runs):
            losses: list[float] = []
            trainer = Trainer(load_dataset(dataset, hold_out=4), recipe(**settings), shards=shards)
            trainer.run(lambda progress, losses=losses: losses.append(progress.loss))
            sent = shards.sent_bytes if isinstance(shards, ProcessShards) else 0
            results.append(
                {
                    "state": trainer.state_tensors(),
                    "losses": losses,
                    "psnr": trainer.evaluate().psnr,
                    "left_out": trainer.excluded,
                    "sent": shards.table(torch.tensor([sent])).flatten().tolist(),
                }
            )
        if shards.rank == 0:
            torch.save(results, Path(output))


if __name__ == "__main__":
    main(*sys.argv[1:])
