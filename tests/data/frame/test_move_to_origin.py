"""Datasets that are far from 0: moved in float64 as they are read."""

import numpy as np
import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.scene.origin import HERE

UTM = (500_000.0, 5_400_000.0, 300.0)


def rewritten(folder, shift, rounded):
    """Move a COLMAP text dataset: t' = t − R(q) shift, as scripts do; optionally round q."""
    model = folder / "sparse" / "0"
    lines = []
    for line in (model / "images.txt").read_text().splitlines():
        words = line.split()
        if len(words) == 10 and not line.startswith("#"):
            q = np.array(words[1:5], float) * (1 + 1e-7 if rounded else 1)
            t = np.array(words[5:8], float) - rotation(q) @ shift
            words[1:8] = [repr(float(v)) for v in (*q, *t)]
        lines.append(" ".join(words))
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    lines = []
    for line in (model / "points3D.txt").read_text().splitlines():
        words = line.split()
        if words and not line.startswith("#"):
            words[1:4] = [repr(float(v)) for v in np.array(words[1:4], float) + shift]
        lines.append(" ".join(words))
    (model / "points3D.txt").write_text("\n".join(lines) + "\n")


def rotation(q):
    """The rotation of a quaternion, as COLMAP's scripts compute it: without dividing by |q|."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
            [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
        ]
    )


@pytest.mark.parametrize("rounded", [False, True])
def test_a_georeferenced_dataset_is_the_same_scene(dataset_copy, rounded):
    folder = dataset_copy("colmap-txt")
    before = load_dataset(folder, hold_out=None)
    assert before.origin == HERE
    rewritten(folder, UTM, rounded)
    moved = load_dataset(folder, hold_out=None)
    assert moved.origin != HERE
    shift = torch.tensor(UTM, dtype=torch.float64) - torch.tensor(moved.origin)
    assert float(shift.abs().max()) < 10 * before.extent  # small numbers remain
    assert moved.extent == pytest.approx(before.extent, rel=1e-5)
    for old, new in zip(before.train, moved.train, strict=True):
        torch.testing.assert_close(
            new.camera.position - shift, old.camera.position, atol=1e-5, rtol=0
        )
        assert new.camera.near == old.camera.near
    torch.testing.assert_close(
        moved.points.xyz.double() - shift, before.points.xyz.double(), atol=1e-5, rtol=0
    )
