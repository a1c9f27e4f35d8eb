"""Models of unknown sources are read in a child process first."""

import pycolmap
import torch

from snowsplat.sfm.colmap.process.check_model import can_be_read

from ...conftest import make_model


def test_a_model_of_panoramas_can_be_read(tmp_path):
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    model = make_model(poses, torch.rand(9, 3) + torch.tensor([0, 0, 4]))
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.EQUIRECTANGULAR
        camera.params = [camera.width, camera.height]
    model.write(tmp_path)
    assert can_be_read(tmp_path)
    (tmp_path / "cameras.bin").write_bytes(b"no cameras")
    assert not can_be_read(tmp_path)
