"""A process of a training run of several processes, for the tests: trains and saves the result.

    torchrun … shards_worker.py DATASET OUTPUT SETTINGS

SETTINGS are the arguments of `recipe`, as JSON. Process 0 writes the state, the losses, and the
metrics of the test views.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
import torch.distributed as dist

from snowsplat import ops
from snowsplat.data.load import load_dataset
from snowsplat.training.process_shards import ProcessShards
from snowsplat.training.recipes import recipe
from snowsplat.training.shards import ALONE
from snowsplat.training.trainer import Trainer


def main(dataset: str, output: str, text: str) -> None:
    settings = json.loads(text)
    stops = settings.pop("stops", None)
    name = settings.pop("recipe", "default")
    ops.set_num_threads(1)
    dist.init_process_group("gloo")
    shards = ProcessShards(torch.device("cpu")) if dist.get_world_size() > 1 else ALONE
    config = recipe(name, **settings)
    losses = []
    trainer = Trainer(load_dataset(dataset, hold_out=4), config, shards=shards)
    trainer.run(lambda progress: losses.append(progress.loss), until=stops)
    state = trainer.state_tensors()
    metrics = trainer.evaluate()
    if shards.rank == 0:
        torch.save({"state": state, "losses": losses, "psnr": metrics.psnr}, Path(output))
    dist.destroy_process_group()


if __name__ == "__main__":
    main(*sys.argv[1:])
