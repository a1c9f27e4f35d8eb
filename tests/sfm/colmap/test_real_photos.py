"""Real photos, stored beside the project: all get poses, as in an earlier run of COLMAP."""

from pathlib import Path

import pycolmap
import pytest
import torch
from PIL import Image

from snowsplat.scene.geometry import similarity_from_points
from snowsplat.sfm.colmap import estimate_poses
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent

CAPTURES = Path(__file__).resolve().parents[4] / "shared" / "captures"

pytestmark = pytest.mark.sfm


def photos_of(images, sequence=None):
    photos = []
    for path in sorted(images.glob("*.jpg")):
        with Image.open(path) as image:
            width, height = image.size
        photos.append(Photo(path.name, path.name, width, height, sequence=sequence))
    return photos


def centres(model):
    images = pycolmap.Reconstruction(model).images.values()
    return {Path(i.name).stem: i.projection_center() for i in images if i.has_pose}


def largest_centre_error(found, given):
    """The largest error, relative to the extent of the given centres, after the best alignment."""
    names = sorted(found.keys() & given.keys())
    a, b = (torch.tensor([c[name].tolist() for name in names]) for c in (found, given))
    error = (similarity_from_points(a, b).apply(a) - b).norm(dim=1).max()
    return float(error / (b - b.mean(0)).norm(dim=1).max())


@pytest.mark.parametrize(
    ("photos", "given", "effort", "sequence", "pixels", "centre_error"),
    [
        ("fox_photos", "fox", "draft", "walk.mp4", 0.9, 0.01),
        ("fern/images", "fern", "draft", None, 1.0, 0.015),
        ("kitchen25/images", "kitchen25", "normal", None, 0.5, 0.01),
    ],
)
def test_all_photos_get_poses(tmp_path, photos, given, effort, sequence, pixels, centre_error):
    images = CAPTURES / photos
    if not images.is_dir():
        pytest.skip(f"no real photos at ../shared/captures/{photos}")
    (tmp_path / "input").symlink_to(images)
    options = SfmOptions(effort=effort)
    chosen = photos_of(images, sequence)
    result = estimate_poses(tmp_path, chosen, options, silent)
    assert result.unregistered == {}
    assert result.reprojection_error <= pixels
    found = centres(tmp_path / "distorted" / "sparse" / "0")
    assert largest_centre_error(found, centres(CAPTURES / given / "sparse" / "0")) < centre_error
