"""Checkpoints: a bitwise round trip, and no incomplete file after any failure."""

import contextlib
import os
import resource
from unittest import mock

import pytest
import torch

from snowsplat.training.core import checkpoint
from snowsplat.util.errors import UserError


def some_tensors() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    table = torch.randn(50, 16, generator=generator)
    return {
        "means": torch.randn(100, 3, generator=generator),
        "view": table[:, 2:5],  # not contiguous, and shares its storage
        "row": table[7],
        "exact": torch.tensor([3.4e38, -1.2e-38, -0.0, 1e-45]),
        "random_state": generator.get_state(),
        "order": torch.randperm(9),
        "mask": torch.tensor([True, False]),
        "scalar": torch.tensor(2.5, dtype=torch.float64),
        "empty": torch.zeros(0, 3),
    }


def test_bitwise_round_trip(tmp_path):
    tensors = some_tensors()
    meta = {"config": {"iterations": 30_000, "background": "black", "lr": 1.6e-4}, "note": "ä\n"}
    path = checkpoint.save(tmp_path / "checkpoints", 500, tensors, meta)
    assert path == tmp_path / "checkpoints" / "step_000500.safetensors"
    again = checkpoint.load(path)
    assert (again.step, again.meta) == (500, meta)
    assert again.tensors.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert again.tensors[name].dtype == tensor.dtype
        assert again.tensors[name].shape == tensor.shape
        assert again.tensors[name].numpy().tobytes() == tensor.contiguous().numpy().tobytes()


def test_the_newest_by_number_are_kept(tmp_path):
    for step in (500, 999_500, 1_000_000, 1_000_500):
        checkpoint.save(tmp_path, step, {"a": torch.tensor(step)}, {})
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "step_1000000.safetensors",
        "step_1000500.safetensors",
    ]
    newest = checkpoint.latest(tmp_path)
    assert newest is not None
    assert newest.step == newest.tensors["a"] == 1_000_500


def test_newer_checkpoints_are_kept(tmp_path):
    for step in (1, 2, 3, 4):
        checkpoint.save(tmp_path, step, {"a": torch.tensor(step)}, {}, keep=9)
    (tmp_path / ".step_000005.safetensors.tmp").write_bytes(b"of a killed save")
    checkpoint.remove_old(tmp_path, 3, keep=1)
    assert sorted(path.name[:11] for path in tmp_path.iterdir()) == ["step_000003", "step_000004"]


def test_no_checkpoint(tmp_path):
    assert checkpoint.latest(tmp_path / "absent") is None
    (tmp_path / "step_000500.safetensors.bak").write_bytes(b"")
    assert checkpoint.latest(tmp_path) is None
    with pytest.raises(UserError, match="cannot be read"):
        checkpoint.load(tmp_path / "step_000001.safetensors")


def test_truncated_at_any_length_falls_back_with_a_warning(tmp_path):
    checkpoint.save(tmp_path, 500, some_tensors(), {})
    newest = checkpoint.save(tmp_path, 1000, some_tensors(), {})
    content = newest.read_bytes()
    for length in {0, 1, 7, 8, 9, 100, len(content) - 1, *range(0, len(content), 211)}:
        newest.write_bytes(content[:length])
        with pytest.warns(UserWarning, match=r"step_001000.*using the previous one"):
            used = checkpoint.latest(tmp_path)
        assert used is not None
        assert used.step == 500


def test_an_unreadable_file_is_not_treated_as_damaged(tmp_path):
    """Otherwise the run would resume from an older checkpoint and repeat steps without need."""
    checkpoint.save(tmp_path, 500, some_tensors(), {})
    checkpoint.save(tmp_path, 1000, some_tensors(), {})
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken = []
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(512, limits[0]), limits[1]))
    try:
        with contextlib.suppress(OSError):
            while True:
                taken.append(os.open(tmp_path, os.O_RDONLY))
        os.close(taken.pop())  # for listing the folder
        found = checkpoint.files(tmp_path)
        assert len(found) == 2
        taken.append(os.open(tmp_path, os.O_RDONLY))
        with (
            mock.patch.object(checkpoint, "files", return_value=found),
            pytest.raises(UserError, match=r"step_001000.*cannot be read"),
        ):
            checkpoint.latest(tmp_path)
    finally:
        for handle in taken:
            os.close(handle)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_any_damaged_byte_is_detected(tmp_path):
    path = checkpoint.save(tmp_path, 500, some_tensors(), {"seed": 1})
    content = path.read_bytes()
    header = 8 + int.from_bytes(content[:8], "little")
    for position in {*range(0, len(content), 97), header, header + 1, len(content) - 1}:
        damaged = bytearray(content)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        if position >= header:
            with pytest.raises(UserError):
                checkpoint.load(path)
        else:  # a change in the header may have no effect, e.g. in padding
            with contextlib.suppress(UserError):
                checkpoint.load(path)


def test_foreign_files_and_other_versions(tmp_path, monkeypatch):
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(3)}, tmp_path / "step_000001.safetensors")
    with pytest.raises(UserError, match="not a checkpoint"):
        checkpoint.load(tmp_path / "step_000001.safetensors")
    monkeypatch.setattr(checkpoint, "VERSION", 99)
    path = checkpoint.save(tmp_path, 2, {"a": torch.zeros(3)}, {})
    monkeypatch.undo()
    with pytest.raises(UserError, match="version 99"):
        checkpoint.load(path)


def test_a_failed_save_leaves_older_checkpoints(tmp_path, monkeypatch):
    checkpoint.save(tmp_path, 1, {"a": torch.zeros(3)}, {})
    checkpoint.save(tmp_path, 2, {"a": torch.zeros(3)}, {})

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.safetensors.numpy, "save_file", full_disk)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(tmp_path, 3, {"a": torch.zeros(3)}, {})
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "step_000001.safetensors",
        "step_000002.safetensors",
    ]
