"""The scale from printed markers: rendered into photos with known poses."""

import functools
import math
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from snowsplat.data.frame.placement import Placement
from snowsplat.scene.geometry import look_at
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.orient import orientation
from snowsplat.sfm.orient.marker import MarkerScale, scale_of_markers

WIDTH, HEIGHT = 640, 480
SIDE, SCALE = 0.1, 0.37  # metres; metres per unit of the model
LENS = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[520, 322, 238, -0.08], camera_id=1
)
PLACES = {7: (0.0, 0.0, 0.0, 0.3), 3: (0.25, 0.1, 0.02, 1.2)}  # number -> centre (m), turn


def paper(number: int) -> np.ndarray:
    """A marker with a white margin, 1/4 of its side wide."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    marker = cv2.aruco.generateImageMarker(dictionary, number, 280)
    return cv2.copyMakeBorder(marker, 70, 70, 70, 70, cv2.BORDER_CONSTANT, value=255)


@functools.cache
def rays_of_pixels() -> np.ndarray:
    """(4 H W, 3) in the frame of the camera; four rays for each pixel."""
    x, y = np.meshgrid((np.arange(2 * WIDTH) + 0.5) / 2, (np.arange(2 * HEIGHT) + 0.5) / 2)
    rays = LENS.cam_from_img(np.stack([x.ravel(), y.ravel()], 1))
    return np.column_stack([rays, np.ones(len(rays))])


def photograph(pose: np.ndarray, sizes: dict[int, float], places: dict) -> np.ndarray:
    """A grey photo (H, W) of markers on a grey ground; every pixel is the mean of 4 rays."""
    rays = rays_of_pixels() @ pose[:, :3]
    centre = -pose[:, :3].T @ pose[:, 3]
    light = np.full(len(rays), 0.2)
    for number, (px, py, pz, turn) in places.items():
        hit = centre + (pz - centre[2]) / rays[:, 2:] * rays - (px, py, pz)
        u = (math.cos(turn) * hit[:, 0] + math.sin(turn) * hit[:, 1]) / sizes[number]
        v = (math.sin(turn) * hit[:, 0] - math.cos(turn) * hit[:, 1]) / sizes[number]
        sheet = paper(number)
        inside = (np.abs(u) < 0.749) & (np.abs(v) < 0.749)
        rows, columns = ((np.array([v, u])[:, inside] + 0.75) * 280).astype(int)
        light[inside] = 0.03 + 0.8 * (sheet[rows, columns] > 0)
    noise = np.random.default_rng(0).normal(0, 3, (HEIGHT, WIDTH))
    light = cv2.GaussianBlur(light.reshape(HEIGHT, 2, WIDTH, 2).mean((1, 3)), (0, 0), 0.7)
    return (255 * light ** (1 / 2.2) + noise).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def poses() -> list[np.ndarray]:
    """cam_from_world (3, 4) in metres of seven photos, one of which is from far away."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    found = []
    for i in range(7):
        distance = 0.45 + 0.05 * i
        place = (distance * math.cos(i), distance * math.sin(i), 0.5)
        target = (0.1, 0.05, 0.0)
        eye, to = (torch.tensor(p, dtype=torch.float64) for p in (place, target))
        found.append(look_at(eye, to, up).numpy())
    return found


def dataset(folder: Path, poses: list[np.ndarray], sizes: dict[int, float], places=PLACES):
    """Photos, and a model whose unit is SCALE metres; a photo whose pose is wrong is the last."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(LENS)
    photos = []
    for i, pose in enumerate(poses):
        name = f"{i}.png"
        cv2.imwrite(str(folder / name), photograph(pose, sizes, places))
        own = pose.copy()
        own[:, 3] /= SCALE
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(own))
        photos.append(Photo(name, name, WIDTH, HEIGHT, ""))
    return model, photos


def test_markers_tell_the_scale(tmp_path: Path, poses: list[np.ndarray]) -> None:
    """Within 0.5%, also if one photo has a wrong pose; the frame is then in metres."""
    model, photos = dataset(tmp_path, poses, {7: SIDE, 3: SIDE})
    wrong = model.images[7].cam_from_world()
    model.frames[model.images[7].frame_id].rig_from_world = pycolmap.Rigid3d(
        wrong.rotation, wrong.translation + 0.1
    )
    marker = scale_of_markers(model, photos, tmp_path, SIDE)
    found, doubts = marker
    assert found is not None
    assert not doubts
    assert found.metres_per_unit == pytest.approx(SCALE, rel=0.005)
    assert abs(math.log(found.metres_per_unit / SCALE)) < 3 * found.error < 0.02
    assert str(found.name) == "2 markers of 100 mm in 12 views"
    assert np.degrees(np.arccos(found.normals[:, 2])).max() < 0.5
    assert np.degrees(found.tilts).max() < 1
    oriented = orientation(model, photos, marker)
    assert oriented.placement.is_metric
    assert str(oriented.placement.up_from[-1]) == "2 markers"
    assert oriented.scene_from_sfm.scale == found.metres_per_unit
    line = oriented.placement.lines()[-1]
    assert line.startswith("metric: 1 unit is 1 m, scale from 2 markers of 100 mm in 12 views, to")


def test_what_makes_a_scale_doubtful(tmp_path: Path, poses: list[np.ndarray]) -> None:
    """Markers of two sizes are told; a marker in two photos or in none gives no scale."""
    model, photos = dataset(tmp_path, poses[:4], {7: SIDE, 3: 1.1 * SIDE})
    found, doubts = scale_of_markers(model, photos, tmp_path, SIDE)
    assert found is not None
    assert found.error > 0.04
    assert "the markers disagree about the scale by 10" in str(doubts[0])
    found, doubts = scale_of_markers(model, photos[:2], tmp_path, SIDE)
    assert found is None
    assert "in 2 photos only" in str(doubts[0])
    oriented = orientation(model, photos, (found, doubts))
    assert not oriented.placement.is_metric
    assert doubts[0] in oriented.placement.doubts
    for photo in photos:
        cv2.imwrite(str(tmp_path / photo.name), np.full((HEIGHT, WIDTH), 90, np.uint8))
    assert "no photo shows a marker" in str(scale_of_markers(model, photos, tmp_path, SIDE)[1][0])


def test_a_marker_that_lies_flat_tells_up() -> None:
    """Photos from one side, all held 4 degrees to the right, leave the level open."""
    roll = math.radians(4)
    turned = np.array(
        [[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]]
    )
    target, upwards = torch.zeros(3).double(), torch.tensor([0.0, 0.0, 1.0]).double()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(LENS)
    for i in range(4):
        eye = torch.tensor([0.1 * i - 0.15, -0.5, 0.4]).double()
        pose = pycolmap.Rigid3d(turned @ look_at(eye, target, upwards).numpy())
        image = pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pose)

    def oriented(*normals: tuple[float, float, float]) -> tuple[float, Placement]:
        """The error of the level in degrees."""
        tilts = np.full(len(normals), 0.005)
        marker = MarkerScale(1.0, 0.01, "markers", np.array(normals), tilts) if normals else None
        found = orientation(model, (), (marker, []))
        up = -found.scene_from_sfm.rotation[1]
        return math.degrees(math.acos(float(up[2]))), found.placement

    alone, _ = oriented()
    assert alone > 3
    table, wall, beside = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)
    for normals in ([table], [table, wall]):
        error, placement = oriented(*normals)
        assert error < 0.4 * alone
        assert str(placement.up_from[-1]) == "the marker"
        assert placement.level_error < 2
        assert not placement.doubts
    for normal in (wall, beside):
        error, placement = oriented(normal)
        assert error == alone
        [doubt] = map(str, placement.doubts)
        assert doubt.startswith("the marker does not lie flat (the angle to level is ")
        assert doubt.endswith("°), so the level is that of the way the photos were held alone")
