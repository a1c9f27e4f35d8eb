"""The check of the poses in the demo; tests/cli/test_demo.py runs the demo itself."""

import numpy as np
import pytest
import torch

from snowsplat.data.colmap.model import write_model
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.data.lens.models import lens_of
from snowsplat.pipeline.demo import compare_with_truth, is_accurate
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.synthetic import Truth
from snowsplat.synthetic.lens import Lens
from snowsplat.synthetic.photographer import walk

TRUTH = Truth(
    Lens(64, 48, 50.0, (0.0, 0.0, 0.0, 0.0)),
    {f"IMG_{i:04d}.jpg": pose for i, pose in enumerate(walk(20, seed=0), 1)},
)


@pytest.mark.parametrize(
    ("moved", "count", "near"), [(0.0, 20, True), (0.02, 20, False), (0.0, 19, False)]
)
def test_wrong_or_missing_poses_fail(tmp_path, moved, count, near):
    images = []
    for name, pose in list(TRUTH.poses.items())[:count]:
        shift = pose[:, 3] + torch.tensor([moved * (not images), 0, 0])
        quat = quat_from_rotation(pose[:, :3])
        images.append(ColmapImage(name, 1, (*quat.tolist(), *shift.tolist())))
    camera = lens_of("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
    nothing = np.zeros((0, 3))
    write_model(tmp_path / "sparse" / "0", {1: camera}, images, nothing, nothing.astype(np.uint8))
    errors = compare_with_truth(DatasetFolder(tmp_path), TRUTH.poses)
    assert is_accurate(errors) is near
    assert len(errors.missing) == 20 - count
