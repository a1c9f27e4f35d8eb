"""Features of a panorama are at the direction of what they show, wherever it is in the picture."""

import numpy as np
from PIL import Image

from snowsplat.data.lens.models import lens_of
from snowsplat.sfm.colmap.features.extraction import detect_in_panorama
from snowsplat.sfm.colmap.pairs.matching import match_descriptors

from ....scenes.lenses import Equirectangular

WIDTH = 640
LENS = lens_of("EQUIRECTANGULAR", WIDTH, WIDTH // 2, (float(WIDTH), WIDTH / 2))


def turned(rotation: np.ndarray) -> Image.Image:
    """A panorama of a pattern on a sphere, seen by a camera with this world_from_cam (3, 3)."""
    y, x = np.mgrid[0 : WIDTH // 2, 0:WIDTH] + 0.5
    rays = Equirectangular(WIDTH, WIDTH // 2).directions(np.stack([x.ravel(), y.ravel()]))
    world = (rotation @ rays).T
    random = np.random.default_rng(3)
    value = np.zeros(len(world))
    for frequency in (4, 8, 16, 32):
        waves = random.normal(0, frequency, (3, 6))
        value += np.sin(world @ waves + random.uniform(0, 6, 6)).sum(1) / 6
    grey = np.clip(128 + 60 * value, 0, 255).astype(np.uint8)
    return Image.fromarray(grey.reshape(WIDTH // 2, WIDTH))


def test_a_turned_panorama_has_the_same_features(tmp_path):
    """The turn of 100° moves features across the seam, and the tilt moves them between sides."""
    turn, tilt = np.radians(100.0), np.radians(25.0)
    about_y = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    rotation = about_y @ about_x
    turned(np.eye(3)).save(tmp_path / "a.png")
    turned(rotation).save(tmp_path / "b.png")
    one, two = (detect_in_panorama(tmp_path / f"{n}.png", None, WIDTH, 3000) for n in "ab")
    matches = match_descriptors(one.descriptors, two.descriptors)
    assert len(matches) > 150
    rays1 = LENS.directions(one.keypoints[matches[:, 0], :2])
    rays2 = LENS.directions(two.keypoints[matches[:, 1], :2]) @ rotation.T
    angles = np.degrees(np.linalg.norm(rays1 - rays2, axis=1))
    pixel = 360 / WIDTH
    assert np.median(angles) < 0.3 * pixel
    assert (angles < pixel).mean() > 0.9
    # On the sphere, the sizes agree.
    sizes = []
    for keypoints, which in ((one.keypoints, matches[:, 0]), (two.keypoints, matches[:, 1])):
        chosen = keypoints[which]
        area = np.abs(chosen[:, 2] * chosen[:, 5] - chosen[:, 3] * chosen[:, 4])
        sizes.append(area * np.cos((chosen[:, 1] / (WIDTH / 2) - 0.5) * np.pi))
    assert np.median(np.abs(np.log(sizes[0] / sizes[1]))) < 0.2


def test_masked_directions_and_poles_have_no_features(tmp_path):
    turned(np.eye(3)).save(tmp_path / "a.png")
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    Image.fromarray(mask).save(tmp_path / "m.png")
    found = detect_in_panorama(tmp_path / "a.png", tmp_path / "m.png", WIDTH, 3000).keypoints
    assert len(found) > 50
    assert ((found[:, 0] > WIDTH / 2 - 1.5) | (found[:, 0] < 1.5)).all()  # both ends of the half
    latitude = np.abs(found[:, 1] / (WIDTH / 2) - 0.5) * 180
    assert latitude.max() < 77


def test_a_resized_panorama_has_its_features_in_its_own_pixels(tmp_path):
    turned(np.eye(3)).resize((2 * WIDTH, WIDTH)).save(tmp_path / "large.png")
    found = detect_in_panorama(tmp_path / "large.png", None, WIDTH, 200).keypoints
    assert len(found) == 200
    assert found[:, 0].max() > 1.5 * WIDTH
    assert found[:, 0].max() < 2 * WIDTH
