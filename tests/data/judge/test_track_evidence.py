"""`track_fit`: points that are not where they were observed are found; other photos are right."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from snowsplat.data.colmap.model import posed_camera, read_model
from snowsplat.data.colmap.tracks import points_with_tracks
from snowsplat.data.dataset import Points, Tracks, View
from snowsplat.data.judge.rig import Rig
from snowsplat.data.judge.track_evidence import track_fit
from snowsplat.data.photos.decode import ImageSource


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


def changed(points: Points | None, change: Callable[[np.ndarray], np.ndarray]) -> Points:
    """Points with other observations."""
    assert points is not None
    assert points.tracks is not None
    ray = change(points.tracks.ray)
    return dataclasses.replace(points, tracks=dataclasses.replace(points.tracks, ray=ray))


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
    assert track_fit(views, rig, points) is None


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
    fit = track_fit(views, rounded, points)
    assert fit is not None
    assert fit.photos == 8
    assert fit.off >= 6
    assert 0.01 < fit.distance < 0.2
    assert fit.focal is None
    assert fit.finding(impossible=True).impossible
    moved = dataclasses.replace(points, xyz=points.xyz + 0.2 * torch.tensor([extent, 0.0, 0.0]))
    fit = track_fit(views, rig, moved)
    assert fit is not None
    assert fit.focal is None
    behind = rig.moved(np.diag([1.0, -1.0, -1.0]) @ rig.rotation, rig.positions)
    fit = track_fit(views, behind, points)
    assert fit is not None
    assert "behind" in fit.finding(impossible=True).text


def test_a_few_photos_that_are_off_are_no_finding(reconstruction):
    views, rig, points = read(reconstruction)
    one = rig.positions + np.eye(8)[:, :1] * [1.0, 0.0, 0.0]
    assert track_fit(views, rig.moved(rig.rotation, one), points) is not None
    many = [dataclasses.replace(view, name=f"{k}/{view.name}") for k in range(2) for view in views]
    assert points is not None
    tracks = points.tracks
    assert tracks is not None
    photos = [f"{k}/{name}" for k in range(2) for name in tracks.photos]
    twice = Tracks(
        photos,
        np.concatenate([tracks.photo, tracks.photo + len(tracks.photos)]),
        np.tile(tracks.point, 2),
        np.tile(tracks.ray, (2, 1)),
    )
    both = rig.select([*range(8), *range(8)])
    moved = both.moved(both.rotation, both.positions + np.eye(16)[:, :1] * [1.0, 0.0, 0.0])
    assert track_fit(many, moved, dataclasses.replace(points, tracks=twice)) is None


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.5])
def test_a_wrong_focal_length(reconstruction, factor):
    views, rig, points = read(reconstruction)
    fit = track_fit(views, rig, changed(points, lambda ray: ray / factor))
    assert fit is not None
    assert fit.focal == pytest.approx(factor, rel=0.01)
    assert not fit.finding(impossible=True).impossible


def scaled(ray: np.ndarray) -> np.ndarray:
    """The photos are half as large as those of the observations."""
    corner = np.array([0.5, 0.375]) / 1.25  # from the principal point to the right and below
    return 2 * (ray + corner) - corner


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(scaled, id="scaled"),
        pytest.param(lambda ray: ray + np.array([0.3, 0.2]), id="cropped"),
        pytest.param(
            lambda ray: ray * (1 - 0.2 * (ray**2).sum(1, keepdims=True)), id="undistorted"
        ),
        pytest.param(lambda ray: ray + np.array([0.003, 0.0]), id="small"),
    ],
)
def test_observations_of_other_pictures_are_no_finding(reconstruction, change):
    views, rig, points = read(reconstruction)
    assert track_fit(views, rig, changed(points, change)) is None


def test_without_tracks(reconstruction):
    views, rig, points = read(reconstruction)
    assert points is not None
    assert track_fit(views, rig, dataclasses.replace(points, tracks=None)) is None
    assert track_fit(views, rig, None) is None
