"""Photo, rendering and error of a view."""

import numpy as np
import torch
from PIL import Image

from snowsplat.data import View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.report.pictures import compared


def test_the_error_is_zero_where_the_mask_is_false(tmp_path):
    """An empty scene is black: the error is where the photo is white and not masked."""
    photo = np.zeros((40, 60, 3), np.uint8)
    photo[:, 20:] = 255
    Image.fromarray(photo).save(tmp_path / "a.png")
    mask = np.full((40, 60), 255, np.uint8)
    mask[:, 40:] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    pose = torch.eye(4, dtype=torch.float64)[:3]
    view = View(
        "a <b>.png",
        Camera(60, 40, 50.0, 50.0, 30.0, 20.0, pose),
        ImageSource(tmp_path / "a.png", 60, 40),
        ImageSource(tmp_path / "mask.png", 60, 40),
    )
    shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, 0, 3))
    nothing = Gaussians(*(torch.zeros(shape) for shape in shapes))
    evaluation = evaluate_views(nothing, [view])
    ((title, (only,)),) = compared(nothing, [view], evaluation, (0.0, 0.0, 0.0))
    assert (str(title), only.name) == ("Photo, rendering, error", "a <b>.png")
    assert list(only.images) == ["photo", "rendering", "error"]
    shown = [np.asarray(image) for image in only.images.values()]
    assert [image.shape for image in shown] == [(40, 60, 3)] * 3
    means = [
        [image[5:35, start + 4 : start + 16].mean() for start in (0, 20, 40)] for image in shown
    ]
    expected = [[0, 255, 255], [0, 0, 0], [0, 255, 0]]
    np.testing.assert_allclose(means, expected, atol=6)
