"""Masks that ignore everything, or the wrong side, are named; others are not."""

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data.dataset import Points, View
from snowsplat.data.judge.mask_check import mask_findings
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.camera import Camera

WIDTH, HEIGHT = 90, 60


def views_with(masks, folder):
    """Cameras at one place that look along z, with masks (H, W) bool."""
    views = []
    for number, used in enumerate(masks):
        path = folder / f"{number}.png"
        Image.fromarray(used.astype(np.uint8) * 255).save(path)
        pose = torch.eye(4, dtype=torch.float64)[:3]
        camera = Camera(WIDTH, HEIGHT, 60.0, 60.0, WIDTH / 2, HEIGHT / 2, pose)
        source = ImageSource(path, WIDTH, HEIGHT)
        views.append(View(path.name, camera, source, source))
    return views


def middle(share=1 / 3):
    used = np.zeros((HEIGHT, WIDTH), bool)
    y, x = round(HEIGHT * (1 - share) / 2), round(WIDTH * (1 - share) / 2)
    used[y : HEIGHT - y, x : WIDTH - x] = True
    return used


def points_at(used):
    """Points of all pixels that are ``used``, one unit of length away."""
    row, column = np.nonzero(used)
    xyz = np.stack([(column + 0.5 - WIDTH / 2) / 60, (row + 0.5 - HEIGHT / 2) / 60, 1 + 0 * row], 1)
    return Points(
        torch.from_numpy(xyz.astype(np.float32)), torch.zeros(len(row), 3, dtype=torch.uint8)
    )


everywhere = np.ones((HEIGHT, WIDTH), bool)


@pytest.mark.parametrize(
    ("used", "points", "text"),
    [
        (middle(0.1), None, "ignore 99% of a typical photo"),
        (~middle(0.5), None, "keep the border of most photos and ignore their middle"),
        (middle(0.7), ~middle(0.8), "keep 48% of a typical photo, but only 0% of the points"),
    ],
)
def test_masks_that_may_be_inverted(used, points, text, tmp_path):
    views = views_with([used] * 6, tmp_path)
    (finding,) = mask_findings(views, None if points is None else points_at(points))
    assert text in str(finding.text)
    assert "invert the masks" in str(finding.text)
    assert not finding.impossible


@pytest.mark.parametrize("used", [middle(0.5), everywhere, middle(0.8)])
def test_masks_that_are_right(used, tmp_path):
    assert mask_findings(views_with([used] * 6, tmp_path), points_at(everywhere)) == []


def test_what_is_masked_in_single_photos_is_right(tmp_path):
    masks = [~middle(0.5), *[everywhere] * 5]
    assert mask_findings(views_with(masks, tmp_path), points_at(everywhere)) == []


def test_masks_that_ignore_everything_are_impossible(tmp_path):
    views = views_with([~everywhere] * 6, tmp_path)
    (finding,) = mask_findings(views, None)
    assert finding.impossible
    some = [dataclasses.replace(views[0], mask=None), *views[1:]]
    (finding,) = mask_findings(some, None)
    assert not finding.impossible
    assert mask_findings([dataclasses.replace(view, mask=None) for view in views], None) == []
