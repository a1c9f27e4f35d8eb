"""`track_fit`: points that are not where they were observed are found; other photos are right."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from snowsplat.data.colmap.model import posed_camera, read_model
from snowsplat.data.colmap.tracks import points_with_tracks
from snowsplat.data.dataset import Points, Tracks, View
from snowsplat.data.judge.rig import Rig
from snowsplat.data.judge.track_evidence import tracks_off
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
