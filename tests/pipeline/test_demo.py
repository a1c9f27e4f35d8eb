"""The check of the poses in the demo; tests/cli/test_demo.py runs the demo itself."""

import pytest

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.pipeline.demo import compare_with_truth, is_accurate
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.synthetic import Truth
from snowsplat.synthetic.photographer import Lens, walk

TRUTH = Truth(
    Lens(64, 48, 50.0, (0.0, 0.0, 0.0, 0.0)),
    {f"IMG_{i:04d}.jpg": pose for i, pose in enumerate(walk(20, seed=0), 1)},
)


@pytest.mark.parametrize(
    ("moved", "count", "near"), [(0.0, 20, True), (0.02, 20, False), (0.0, 19, False)]
)
def test_wrong_or_missing_poses_fail(tmp_path, moved, count, near):
    camera = lens_of("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
    posed = [(name, camera, pose.clone()) for name, pose in list(TRUTH.poses.items())[:count]]
    posed[0][2][0, 3] += moved
    write_posed(tmp_path / "sparse" / "0", posed)
    errors = compare_with_truth(DatasetFolder(tmp_path), TRUTH.poses)
    assert is_accurate(errors) is near
    assert len(errors.missing) == 20 - count
