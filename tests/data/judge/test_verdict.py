"""`judge`: right cameras pass in every frame and unit; the usual mistakes are found and named."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from snowsplat.data import Dataset, ImageSource, Points, View, load_dataset
from snowsplat.data.colmap.model import posed_camera, read_model
from snowsplat.data.dataset import Tracks
from snowsplat.data.judge import match_evidence
from snowsplat.data.judge.rig import Rig
from snowsplat.data.judge.verdict import judge, tracks_off
from snowsplat.data.readers.colmap import points_with_tracks
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, quat_from_rotation, rotation_from_quat
from snowsplat.synthetic.toy_dataset import write_toy_dataset

OPENGL = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module", autouse=True)
def remembered_matches():
    """The photos are the same in each test, so their features and matches are computed once."""
    known: dict[tuple, tuple] = {}

    def remembered(function, key):
        def call(*arguments):
            values = key(*arguments)
            if values not in known:  # with the arguments, whose numbers thus remain theirs
                known[values] = function(*arguments), arguments
            return known[values][0]

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name, key in {
            "_features": lambda photo: (photo.tobytes(),),
            "_pair_matches": lambda a, b, _: (id(a), id(b)),
        }.items():
            patch.setattr(match_evidence, name, remembered(getattr(match_evidence, name), key))
        yield


@pytest.fixture(scope="module")
def coloured(tmp_path_factory) -> Dataset:
    """Smooth balls with coloured points: no features to match, so only colours can tell."""
    folder = tmp_path_factory.mktemp("toy") / "toy"
    return load_dataset(write_toy_dataset(folder, "colmap-bin", 12, 96, 72, n_points=3000))


@pytest.fixture(scope="module")
def matched(tmp_path_factory) -> Dataset:
    """A textured corner of a room without points: only matches can tell."""
    folder = tmp_path_factory.mktemp("corner")
    random = np.random.default_rng(0)
    textures = [
        cv2.GaussianBlur(random.integers(0, 256, (400, 400), np.uint8), (0, 0), 2) * 3
        for _ in range(3)
    ]
    views = []
    for i in range(10):
        camera = camera_at(i)
        path = folder / f"{i:02d}.png"
        Image.fromarray(corner(camera, textures)).save(path)
        views.append(View(path.name, camera, ImageSource(path, 320, 240)))
    return Dataset(views, [], None, 4.0, "corner")


def camera_at(i: int, step: float = 0.0) -> Camera:
    """The camera of the view ``i``, moved by ``step`` radians along the arc."""
    angle = 0.25 + 0.11 * i + step
    position = torch.tensor([4 * np.cos(angle), 4 * np.sin(angle), 1.6 + 0.6 * np.sin(2.0 * i)])
    pose = look_at(
        position, torch.tensor([0.6, 0.6, 0.6]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
    )
    return Camera(320, 240, 300.0, 300.0, 160.0, 120.0, pose[:3].double())


def corner(camera: Camera, textures: list[np.ndarray]) -> np.ndarray:
    """(240, 320) uint8: three squares with a side of 2, in the planes x = 0, y = 0 and z = 0."""
    picture = np.zeros((camera.height, camera.width), np.uint8)
    pose = camera.intrinsics.numpy() @ camera.cam_from_world.numpy()
    for plane, texture in enumerate(textures):
        first, second = (axis for axis in range(3) if axis != plane)
        scale = np.diag([2 / 400, 2 / 400, 1.0])  # from pixels of the texture
        homography = pose[:, [first, second, 3]] @ scale
        size = camera.width, camera.height
        inside = cv2.warpPerspective(np.full_like(texture, 255), homography, size)
        warped = cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_AREA)
        picture = np.where(inside > 0, warped, picture)
    return picture


def rig_of(dataset: Dataset) -> Rig:
    return Rig.of([view.camera for view in dataset.train + dataset.test])


def with_rig(dataset: Dataset, rig: Rig, points: Points | None = None) -> Dataset:
    """The photos of a dataset with other cameras; and with other points, if there are any."""
    views = []
    for i, view in enumerate(dataset.train + dataset.test):
        pose = np.concatenate([rig.rotation[i], rig.translation[i][:, None]], axis=1)
        camera = dataclasses.replace(
            view.camera,
            fx=float(rig.focal[i, 0] * view.camera.width),
            fy=float(rig.focal[i, 1] * view.camera.height),
            cam_from_world=torch.from_numpy(pose),
        )
        views.append(dataclasses.replace(view, camera=camera))
    return Dataset(views, [], points or dataset.points, dataset.extent, "corrupted")


def inverted(rig: Rig) -> Rig:
    return rig.moved(rig.rotation.transpose(0, 2, 1), rig.translation)


def quaternions_xyzw(rig: Rig) -> Rig:
    quats = quat_from_rotation(torch.from_numpy(rig.rotation))[:, (1, 2, 3, 0)]
    return dataclasses.replace(rig, rotation=rotation_from_quat(quats).numpy())


CORRUPTIONS = {
    "opengl axes": (lambda rig: rig.moved(OPENGL @ rig.rotation, rig.positions), "axes"),
    "inverted": (inverted, "direction"),
    "transposed": (
        lambda rig: dataclasses.replace(rig, rotation=rig.rotation.transpose(0, 2, 1)),
        "direction",
    ),
    "position as translation": (
        lambda rig: dataclasses.replace(rig, translation=rig.positions),
        "positions",
    ),
    "quaternions": (quaternions_xyzw, "quaternions"),
    "mirrored": (
        lambda rig: rig.moved(
            np.diag([-1.0, 1, 1]) @ rig.rotation @ np.diag([1.0, 1, -1]),
            rig.positions * [1, 1, -1],
        ),
        "axes",
    ),
    "long focal length": (lambda rig: rig.zoomed(5.0), "focal length"),
}


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_right_cameras(coloured: Dataset, matched: Dataset, scale: float) -> None:
    turn = rotation_from_quat(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64)).numpy()
    for dataset in (coloured, matched):
        rig, points = rig_of(dataset), dataset.points
        moved = rig.moved(rig.rotation @ turn.T, scale * rig.positions @ turn.T)
        if points is not None:
            xyz = scale * points.xyz.double() @ torch.from_numpy(turn.T)
            points = Points(xyz.float(), points.rgb)
        assert judge(with_rig(dataset, moved, points)) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CORRUPTIONS)
def test_matches_find(matched: Dataset, name: str) -> None:
    corrupt, about = CORRUPTIONS[name]
    findings = judge(with_rig(matched, corrupt(rig_of(matched))))
    assert about in [finding.about for finding in findings]


# A camera at another place sees nearly the same colours of the large sphere around the balls.
@pytest.mark.parametrize("name", [n for n in CORRUPTIONS if n != "position as translation"])
def test_colours_find(coloured: Dataset, name: str) -> None:
    corrupt, _ = CORRUPTIONS[name]
    assert judge(with_rig(coloured, corrupt(rig_of(coloured))))


@pytest.mark.slow
def test_shuffled_names(coloured: Dataset, matched: Dataset) -> None:
    for dataset in (coloured, matched):
        rig = rig_of(dataset)
        order = np.random.default_rng(1).permutation(len(rig))
        assert judge(with_rig(dataset, rig.select(order)))


def test_units_of_the_points(coloured: Dataset) -> None:
    rig = rig_of(coloured)
    findings = judge(with_rig(coloured, rig.moved(rig.rotation, 100 * rig.positions)))
    assert [(f.about, f.impossible) for f in findings] == [("units", True)]
    assert "the unit of the poses is 93 times" in str(findings[0].text)  # in steps of 12%


@pytest.mark.slow
def test_random_points_say_nothing(coloured: Dataset, matched: Dataset) -> None:
    """Some exporters write points at random, as a start for the training."""
    generator = torch.Generator().manual_seed(0)
    xyz = torch.rand(3000, 3, generator=generator) * 4 - 2
    rgb = torch.randint(0, 256, (3000, 3), generator=generator, dtype=torch.uint8)
    for dataset in (coloured, matched):
        assert judge(with_rig(dataset, rig_of(dataset), Points(xyz, rgb))) == []
    grey = Points(xyz, torch.full_like(rgb, 128))
    assert judge(with_rig(matched, rig_of(matched), grey)) == []


def test_a_damaged_photo_is_left_out(coloured: Dataset, tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"not a photo")
    first, *rest = coloured.train
    view = dataclasses.replace(first, image=dataclasses.replace(first.image, path=broken))
    assert judge(dataclasses.replace(coloured, train=[view, *rest])) == []


@pytest.mark.slow
def test_far_from_the_origin(matched: Dataset) -> None:
    rig = rig_of(matched)
    moved = rig.moved(rig.rotation, rig.positions + np.array([500_000, 4_500_000, 120]))
    (finding,) = judge(with_rig(matched, moved))
    assert (finding.about, finding.impossible) == ("origin", True)
    assert "subtract (50000" in str(finding.advice)
    moved = rig.moved(rig.rotation, rig.positions + np.array([10_000, 0, 0]))
    assert [(f.about, f.impossible) for f in judge(with_rig(matched, moved))] == [("origin", False)]


def test_one_place(coloured: Dataset) -> None:
    rig = rig_of(coloured)
    still = dataclasses.replace(rig, translation=np.zeros_like(rig.translation))
    assert judge(with_rig(coloured, still))


def test_impossible_lens(matched: Dataset) -> None:
    rig = rig_of(matched)
    (finding,) = judge(with_rig(matched, rig.zoomed(0.02)))
    assert (finding.about, finding.impossible) == ("field of view", True)
    few = dataclasses.replace(
        rig, focal=rig.focal * np.where(np.arange(len(rig)) < 3, 0.02, 1)[:, None]
    )
    (finding,) = judge(with_rig(matched, few))
    assert str(finding.text).startswith("3 photos: ")


@pytest.mark.slow
def test_poses_of_some_photos(matched: Dataset) -> None:
    """The photos are named whose own matches contradict their poses. Far from the origin, they have
    lost digits: no training."""
    rig = rig_of(matched)
    positions = rig.positions.copy()
    positions[[0, 4], 2] += 0.5
    some = with_rig(matched, rig.moved(rig.rotation, positions))
    (finding,) = judge(some)
    assert str(finding.text).startswith("the poses of 00.png, 04.png contradict their matches")
    assert finding.photos == ("00.png", "04.png")
    assert not finding.impossible
    positions[[2, 6, 8], 2] += 0.5
    many = with_rig(matched, rig.moved(rig.rotation, positions))
    (finding,) = judge(dataclasses.replace(many, origin=(1e6, 0.0, 0.0)))
    assert finding.impossible
    assert "lost digits" in str(finding.text)


@pytest.mark.slow
@pytest.mark.parametrize("moved", [(2, 7), (1, 4, 7)])
def test_poses_that_are_off_by_little(matched: Dataset, moved: tuple[int, ...]) -> None:
    """Their matches are a few pixels away from where the poses say: several times as far as those
    of the others, which must not make it usual."""
    views = [*matched.train]
    for i in moved:
        views[i] = dataclasses.replace(views[i], camera=camera_at(i, 0.06))
    (finding,) = judge(dataclasses.replace(matched, train=views))
    assert finding.photos == tuple(views[i].name for i in moved)
    assert not finding.impossible


@pytest.mark.slow
def test_a_pose_that_is_repeated(matched: Dataset) -> None:
    """A tracker that was lost keeps its pose: the photo that shows another place is named. Photos
    of one place, as brackets, are not."""
    views = [*matched.train]
    frozen = dataclasses.replace(views[6], camera=views[5].camera)
    (finding,) = judge(dataclasses.replace(matched, train=[*views[:6], frozen, *views[7:]]))
    assert finding.photos == (views[6].name,)
    again = dataclasses.replace(views[5], name=f"{views[5].name}b")
    assert judge(dataclasses.replace(matched, train=[*views[:6], again, *views[6:]])) == []


@pytest.fixture(scope="module")
def reconstruction(tmp_path_factory) -> Path:
    """The binary model of a lens with distortion, with half a pixel of noise."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 200
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, model)
    folder = tmp_path_factory.mktemp("model")
    model.write_binary(str(folder))
    return folder


def read(folder: Path) -> tuple[list[View], Rig, Points | None]:
    model = read_model(folder)
    cameras = [posed_camera(model, image) for image in model.images]
    source = ImageSource(folder, 1, 1)
    views = [
        View(image.name, camera, source)
        for image, camera in zip(model.images, cameras, strict=True)
    ]
    names = {image.number: image.name for image in model.images}
    return views, Rig.of(cameras), points_with_tracks(model, names)


@pytest.mark.parametrize("text", [False, True])
def test_observations_of_a_reconstruction(reconstruction, tmp_path, text):
    """Binary and text, and of a lens with distortion, whose positions are off by 1% without it."""
    folder = reconstruction
    if text:
        pycolmap.Reconstruction(str(folder)).write_text(str(tmp_path))
        folder = tmp_path
    views, rig, points = read(folder)
    assert points is not None
    tracks = points.tracks
    assert isinstance(tracks, Tracks)
    assert len(tracks.ray) > 800
    for photo, name in enumerate(tracks.photos):
        (view,) = (i for i, view in enumerate(views) if view.name == name)
        chosen = tracks.photo == photo
        where, _ = rig.project(view, points.xyz.numpy()[tracks.point[chosen]])
        ray = (where - rig.centre[view]) / rig.focal[view]
        pixels = views[view].camera.fx * np.linalg.norm(ray - tracks.ray[chosen], axis=1)
        assert 0.2 < np.median(pixels) < 1.5
    count, off = tracks_off(views, rig, points)
    assert (count, off) == (8, [])


def test_points_with_other_ids_have_no_tracks(reconstruction, tmp_path):
    """As if the points had been replaced, without the images."""
    pycolmap.Reconstruction(str(reconstruction)).write_text(str(tmp_path))
    path = tmp_path / "points3D.txt"
    lines = [line for line in path.read_text().splitlines() if line[0] != "#"]
    numbered = (f"{i} {line.partition(' ')[2]}\n" for i, line in enumerate(lines, 500))
    path.write_text("".join(numbered))
    _, _, points = read(tmp_path)
    assert points is not None
    assert points.tracks is None


def test_lost_digits_and_moved_points(reconstruction):
    views, rig, points = read(reconstruction)
    assert points is not None
    extent = np.abs(rig.positions - rig.positions.mean(0)).max()
    random = np.random.default_rng(0)
    rounded = rig.moved(rig.rotation, rig.positions + random.normal(0, 0.05 * extent, (8, 3)))
    count, off = tracks_off(views, rounded, points)
    assert count == 8
    assert len(off) >= 6
    assert 0.01 < np.median(off) < 0.2
    moved = dataclasses.replace(points, xyz=points.xyz + 0.2 * torch.tensor([extent, 0.0, 0.0]))
    assert len(tracks_off(views, rig, moved)[1]) >= 6
    behind = rig.moved(np.diag([1.0, -1.0, -1.0]) @ rig.rotation, rig.positions)
    assert np.isinf(tracks_off(views, behind, points)[1]).all()


def test_one_photo_that_is_off(reconstruction):
    views, rig, points = read(reconstruction)
    one = rig.positions + np.eye(8)[:, :1] * [1.0, 0.0, 0.0]
    assert len(tracks_off(views, rig.moved(rig.rotation, one), points)[1]) == 1


def test_without_tracks(reconstruction):
    views, rig, points = read(reconstruction)
    assert points is not None
    assert tracks_off(views, rig, dataclasses.replace(points, tracks=None)) == (0, [])
    assert tracks_off(views, rig, None) == (0, [])
