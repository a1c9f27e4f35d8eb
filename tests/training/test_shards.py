"""Training in several processes: the same bits as in one process, for each density control."""

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.data.load import load_dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.processes.shards import ALONE, share

from .. import fork_server
from ..ports import unused_port

WORKER = Path(__file__).with_name("shards_worker.py")
# All kinds of density control and of hooks between the steps; the last batch has fewer views.
DENSE = {"iterations": 42, "densify_from": 10, "densify_interval": 10, "max_gaussians": 900}
RUNS = [
    {
        **DENSE,
        "batch": 4,
        "leave_out_after": 0.3,
        "exposure": "on",
        "transients": "on",
        "depth_weight": 0.5,
        "surfaces": True,
    },
    {
        **DENSE,
        "batch": 3,
        "name": "mcmc-short",
        "densify_until": 35,
        "test_iterations": (25,),
        "refine_poses": True,
        "antialias": True,
    },
    {
        **DENSE,
        "batch": 2,
        "name": "paper",
        "opacity_reset_interval": 20,
        "background": "random",
        "exposure": "on",
        "visible_only": False,
    },
]


def trained(folder: Path, processes: int) -> list[dict]:
    shared = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(unused_port()),
        "WORLD_SIZE": str(processes),
        "GLOO_SOCKET_IFNAME": "lo",
    }
    output = folder / f"{processes}.pt"
    environment = fork_server.ENVIRONMENT | shared
    running = [
        fork_server.popen(
            *(WORKER, folder / "dataset", output, json.dumps(RUNS)),
            env=environment | {"RANK": str(rank)},
            stdout=sys.__stdout__.fileno(),
            stderr=sys.__stderr__.fileno(),
        )
        for rank in range(processes)
    ]
    try:
        assert [process.wait(300) for process in running] == [0] * processes
    finally:
        for process in running:
            process.kill()
    return torch.load(output)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    write_toy_dataset(folder / "dataset", "colmap-bin", 9, 48, 36, n_points=400)
    (folder / "dataset/depths").mkdir()
    data = load_dataset(folder / "dataset", hold_out=None)
    pixels = torch.stack(torch.meshgrid(torch.arange(48.0), torch.arange(36.0), indexing="xy"), 2)
    for view in data.train[::2]:  # the depth of the nearest point in the photo
        at, z = view.camera.project(data.points.xyz.double())
        nearest = torch.cdist(pixels.double().reshape(-1, 2), at).argmin(1)
        np.save(folder / f"dataset/depths/{Path(view.name).stem}.npy", z[nearest].reshape(36, 48))
    return folder


@pytest.fixture(scope="module")
def alone(folder: Path) -> list[dict]:
    return trained(folder, 1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the network interface has another name")
def test_several_processes_give_the_same_bits(folder: Path, alone: list[dict]) -> None:
    """With an uneven number: the shares of rows and of views are not equal."""
    together = trained(folder, 3)
    for one, several in zip(alone, together, strict=True):
        assert len(one["state"]["gaussians.means"]) > 300
        assert several["losses"] == one["losses"]
        assert several["psnr"] == one["psnr"]
        assert several["left_out"] == one["left_out"]
        assert several["state"].keys() == one["state"].keys()
        for name, tensor in one["state"].items():
            assert torch.equal(several["state"][name], tensor), name
        assert min(several["sent"]) > 0


@pytest.mark.parametrize("rows", [0, 1, 63, 64, 65, 1000, 1_000_000])
@pytest.mark.parametrize("size", [1, 2, 3, 8])
def test_shards_contain_all_rows_and_begin_at_multiples_of_64(rows: int, size: int) -> None:
    shards = [share(rows, rank, size) for rank in range(size)]
    assert shards[0][0] == 0
    assert shards[-1][1] == rows
    assert all(a[1] == b[0] for a, b in pairwise(shards))
    assert all(first % 64 == 0 or first == rows for first, _ in shards)
    sizes = [end - first for first, end in shards]
    assert max(sizes) - min(sizes) <= 128


def test_one_process_has_all_rows() -> None:
    rows = torch.arange(6.0).reshape(3, 2)
    index = torch.tensor([2, 0, 2])
    assert torch.equal(ALONE.selection(index)(rows), rows[index])
    assert ALONE.all_rows(rows) is rows
    assert ALONE.own_rows(rows) is rows
    assert (ALONE.total(3), ALONE.first(3)) == (3, 0)
