"""Models of unknown sources are read in a child process first."""

import pycolmap
import pytest
import torch

from snowsplat.sfm.colmap.result import read_model
from snowsplat.util.errors import UserError
from snowsplat.util.limited_child import check_readable

from ..conftest import make_model


def test_a_model_of_panoramas_can_be_read(tmp_path):
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    model = make_model(poses, torch.rand(9, 3) + torch.tensor([0, 0, 4]))
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.EQUIRECTANGULAR
        camera.params = [camera.width, camera.height]
    model.write(tmp_path)
    check_readable(read_model, tmp_path, ["pycolmap"])
    (tmp_path / "cameras.bin").write_bytes(b"no cameras")
    with pytest.raises(UserError):
        check_readable(read_model, tmp_path, ["pycolmap"])
