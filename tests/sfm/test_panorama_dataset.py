"""Placed panoramas become pinhole views in a rig: pixels, poses, masks, and what is held out."""

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from snowsplat.data import load_dataset
from snowsplat.data.photos.decode import load_image
from snowsplat.scene.geometry import Similarity
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.progress import silent
from snowsplat.sfm.report.coverage import measure_coverage
from snowsplat.sfm.undistort import undistort
from snowsplat.util.errors import UserError

from ..scenes.lenses import Equirectangular

WIDTH, COUNT = 128, 10
FACES = ("front", "back", "left", "right", "up", "down")
SCENE = Similarity(2.0, torch.eye(3, dtype=torch.float64), torch.tensor([0.5, 0.0, 1.0]).double())


def rotation(i: int) -> np.ndarray:
    """cam_from_world of panorama i: turned about the vertical axis."""
    cos, sin = np.cos(0.7 * i), np.sin(0.7 * i)
    return np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])


def colour_of(world: np.ndarray) -> np.ndarray:
    """(N, 3) in 0..255 of unit directions (N, 3) in the world."""
    return 127.5 + 110 * world


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Ten panoramas of what is infinitely far away, and points around them."""
    folder = tmp_path_factory.mktemp("panoramas")
    (folder / "input").mkdir()
    (folder / "distorted" / "masks").mkdir(parents=True)
    y, x = np.mgrid[0 : WIDTH // 2, 0:WIDTH] + 0.5
    rays = Equirectangular(WIDTH, WIDTH // 2).directions(np.stack([x.ravel(), y.ravel()])).T
    used = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    used[-10:] = 0  # what is below the camera
    names = [f"pano_{i:02d}.png" for i in range(COUNT)]
    poses = []
    for i, name in enumerate(names):
        pixels = colour_of(rays @ rotation(i)).reshape(WIDTH // 2, WIDTH, 3)
        Image.fromarray(np.rint(pixels).astype(np.uint8)).save(folder / "input" / name)
        Image.fromarray(used).save(folder / "distorted" / "masks" / f"{name}.png")
        centre = np.array([0.1 * i, 0.02 * i, 0.0])
        poses.append(np.column_stack([rotation(i), -rotation(i) @ centre]))
    random = torch.Generator().manual_seed(2)
    points = torch.nn.functional.normalize(torch.randn(300, 3, generator=random), dim=1) * 4
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=WIDTH, height=WIDTH // 2)
    camera.params = [WIDTH, WIDTH // 2]
    model = pycolmap.Reconstruction()
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for i, pose in enumerate(poses):
        seen = camera.img_from_cam(points.double().numpy() @ pose[:, :3].T + pose[:, 3])
        image = pycolmap.Image(names[i], seen, 1, i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for k, track in enumerate(tracks):
            track.add_element(i + 1, k)
    for xyz, track in zip(points.double().numpy(), tracks, strict=True):
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    (folder / "distorted" / "sparse" / "0").mkdir(parents=True)
    model.write(folder / "distorted" / "sparse" / "0")
    photos = [
        Photo(name, name, WIDTH, WIDTH // 2, "p", None, None, None, True, False, panorama=True)
        for name in names
    ]
    made = undistort(folder, photos, SCENE, False, silent)
    assert made.images == 6 * COUNT
    assert made.masks == COUNT  # only the views down show masked pixels
    assert made.resampled
    return folder


def test_each_pixel_shows_its_direction(dataset):
    for view in load_dataset(dataset, hold_out=None).train:
        camera = view.camera
        pixels = load_image(view.image).permute(1, 2, 0).numpy().astype(float)
        y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 0 * x + 1], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        world = rays @ camera.cam_from_world[:, :3].numpy()
        assert np.abs(pixels - colour_of(world)).max() < 8, view.name
        assert 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)) > 90
        # At its centre, a view has the resolution of the horizon.
        assert camera.fx == pytest.approx(WIDTH / (2 * np.pi), rel=0.01)


def test_the_views_are_one_frame_of_a_rig(dataset):
    model = pycolmap.Reconstruction(dataset / "sparse" / "0")
    assert (model.num_rigs(), model.num_frames(), model.num_images()) == (1, COUNT, 6 * COUNT)
    assert model.num_points3D() == 300
    assert model.compute_mean_reprojection_error() < 1e-6
    for frame in model.frames.values():
        images = [model.image(data.id) for data in frame.image_ids]
        assert len({image.name.split("_")[1] for image in images}) == 1
        centres = np.array([image.projection_center() for image in images])
        assert np.ptp(centres, axis=0).max() < 1e-9


def test_the_views_of_a_panorama_are_held_out_together(dataset):
    loaded = load_dataset(dataset)
    held_out = {view.name for view in loaded.test}
    assert held_out == {f"pano_{i:02d}_{face}.png" for i in (0, 8) for face in FACES}
    assert len(loaded.train) == 6 * (COUNT - 2)
    listed = load_dataset(dataset, test_list=["pano_03_left.png"])
    assert {view.name for view in listed.test} == {f"pano_03_{face}.png" for face in FACES}


def test_a_frames_file_that_is_damaged_is_not_used(dataset, tmp_path, caplog):
    for part in ("images", "sparse"):
        (tmp_path / part).symlink_to(dataset / part)
    (tmp_path / "sparse").unlink()
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for file in (dataset / "sparse" / "0").iterdir():
        content = file.read_bytes()
        short = content[:-5] if file.name == "frames.bin" else content
        (tmp_path / "sparse" / "0" / file.name).write_bytes(short)
    assert len(load_dataset(tmp_path).test) == -(-6 * COUNT // 8)
    assert "frames.bin: damaged" in caplog.text


def test_text_files_have_the_frames_too(dataset, tmp_path):
    (tmp_path / "images").symlink_to(dataset / "images")
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    pycolmap.Reconstruction(dataset / "sparse" / "0").write_text(tmp_path / "sparse" / "0")
    assert len(load_dataset(tmp_path).test) == 12


def test_a_panorama_counts_as_one_photo(dataset):
    coverage = measure_coverage(dataset / "sparse" / "0")
    assert coverage.names == [f"pano_{i:02d}.png" for i in range(COUNT)]
    assert (coverage.confirmed == 1).all()
    # 0.1 to the side and 0.02 down, at the distance 4; the frame of the scene is twice as large.
    np.testing.assert_allclose(coverage.step, np.hypot(0.1, 0.02) / 4, rtol=0.1)


def test_a_photo_named_like_a_view_is_refused(dataset, tmp_path):
    for part in ("input", "distorted"):
        (tmp_path / part).symlink_to(dataset / part)
    (tmp_path / "distorted").unlink()
    (tmp_path / "distorted" / "sparse" / "0").mkdir(parents=True)
    model = pycolmap.Reconstruction(dataset / "distorted" / "sparse" / "0")
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=2, model="PINHOLE", width=64, height=64, params=[60, 60, 32, 32])
    )
    image = pycolmap.Image("pano_03_left.png", np.zeros((0, 2)), 2, 99)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write(tmp_path / "distorted" / "sparse" / "0")
    with pytest.raises(UserError, match="pano_03_left.png: is the name of a photo and of a part"):
        undistort(tmp_path, [], SCENE, False, silent)
