"""Depth maps, their fusion, and triangles of a sphere and of flat Gaussians."""

import math
from collections import Counter

import numpy as np
import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.mesh import filled_holes, largest_parts, vertex_normals, y_up
from snowsplat.surface.colors import vertex_colors
from snowsplat.surface.depth import DepthMap, SurfaceRenderer
from snowsplat.surface.volume import (
    Volume,
    block_coordinates,
    block_keys,
    fuse_maps,
    occupied_blocks,
    zero_level,
)

Sphere = tuple[list[DepthMap], Volume]
_UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def _camera(position: tuple[float, float, float], size: int = 64) -> Camera:
    pose = look_at(torch.tensor(position, dtype=torch.float64), 0 * _UP, _UP)
    return Camera(size, size, 0.8 * size, 0.8 * size, size / 2, size / 2, pose)


def _of_sphere(camera: Camera, radius: float) -> DepthMap:
    """The exact depth map of a sphere around 0."""
    y, x = torch.meshgrid(*[torch.arange(camera.width) + 0.5] * 2, indexing="ij")
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 0 * x + 1], 2)
    rays = rays.double() @ camera.world_from_cam[:, :3].T
    a, b = (rays**2).sum(2), rays @ camera.position
    root = (b * b - a * (camera.position.square().sum() - radius**2)).sqrt()
    depth = ((-b - root) / a).nan_to_num(math.inf).float()
    return DepthMap(camera, depth, torch.full(depth.shape, 255, dtype=torch.uint8))


@pytest.fixture(scope="module")
def sphere() -> Sphere:
    directions = [*np.eye(3), *-np.eye(3)]
    maps = [_of_sphere(_camera(tuple(3 * d + 0.01), 128), 0.6) for d in directions]
    keys = occupied_blocks(maps, 0.04)
    return maps, fuse_maps(maps, 0.04, keys, lambda *_: None)


def test_a_sphere_is_accurate_and_nearly_closed(sphere: Sphere) -> None:
    vertices, faces = zero_level(sphere[1], 0.1)
    radius = np.linalg.norm(vertices, axis=1)
    assert np.abs(radius - 0.6).mean() < 0.008  # a fifth of a voxel
    assert np.abs(radius - 0.6).max() < 0.06
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    shared = np.unique(edges, axis=0, return_counts=True)[1]
    # Where all six views are oblique, voxels behind the surface are unknown: small holes.
    assert (shared == 1).mean() < 0.025
    assert shared.max() == 2
    outward = (vertex_normals(vertices, faces) * vertices).sum(1) / radius
    assert outward.min() > 0.8
    assert largest_parts(faces, len(vertices), 0.5).all()


def test_colours_come_from_the_photos_that_show_a_vertex(sphere: Sphere) -> None:
    maps, volume = sphere
    vertices, faces = zero_level(volume, 0.1)
    shades = (0, 50, 100, 150, 200, 250)
    photos = [torch.full((3, 128, 128), v, dtype=torch.uint8) for v in shades]
    views = [(m, photo, None) for m, photo in zip(maps, photos, strict=True)]
    colors = vertex_colors(vertices, faces, views, 0.04)
    for i, d in enumerate([*np.eye(3), *-np.eye(3)]):
        assert np.abs(colors[vertices @ d > 0.59].astype(int) - shades[i]).max() <= 2
    # A photo whose pixels are not usable has no influence; neighbours fill in.
    views[0] = (maps[0], photos[0], torch.zeros(128, 128, dtype=torch.bool))
    assert vertex_colors(vertices, faces, views, 0.04).min() >= 50


def test_block_keys() -> None:
    cells = np.array([[-5, 0, 7], [1, -(1 << 19), 3], [0, 0, 0]])
    assert (block_coordinates(block_keys(cells)) == cells).all()


def _wall(tilt: float) -> Gaussians:
    """Flat, opaque Gaussians in the plane z = tan(tilt) x, larger than their distance."""
    x, y = torch.cartesian_prod(*[torch.linspace(-1.5, 1.5, 13)] * 2).T
    n = len(x)
    half = -tilt / 2  # about y: x turns towards z
    return Gaussians(
        means=torch.stack([x, y, math.tan(tilt) * x], 1),
        log_scales=torch.tensor([0.2, 0.2, 1e-3]).log().expand(n, 3).clone(),
        quats=torch.tensor([math.cos(half), 0.0, math.sin(half), 0.0]).expand(n, 4).clone(),
        opacity_logits=torch.full((n,), 4.0),
        sh_dc=torch.zeros(n, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
    )


@pytest.mark.parametrize("degrees", [0, 30, 60])
def test_depth_of_a_tilted_wall(degrees: int) -> None:
    """The centres of the Gaussians alone would be wrong by up to their size."""
    tilt = math.radians(degrees)
    camera = _camera((0.0, 0.0, -3.0))
    found = SurfaceRenderer(_wall(tilt)).render(camera)
    x = (torch.arange(64) + 0.5 - 32) / camera.fx
    across = camera.world_from_cam[0, 0].item()  # the x axis of the camera in the world: ±1
    expected = 3.0 / (
        1.0 - math.tan(tilt) * across * x
    )  # z = −3 + depth = tan(tilt) across x depth
    inner = slice(24, 40)
    assert float((found.depth[inner, inner] / expected[inner] - 1).abs().max()) < 0.003
    assert float(found.confidence[32, 32]) == pytest.approx(math.cos(tilt), abs=0.1)
    assert not SurfaceRenderer(_wall(tilt)).render(camera, 1.0).depth[inner, inner].isfinite().any()


def test_what_the_photo_says() -> None:
    found = SurfaceRenderer(_wall(0.0)).render(_camera((0.0, 0.0, -3.0), 4))
    left = torch.arange(4).expand(4, 4) < 2
    corrected = found.corrected(empty=left, usable=torch.arange(4)[:, None].expand(4, 4) < 2)
    assert corrected.depth[0, :2].isinf().all()
    assert corrected.depth[0, 2:].isfinite().all()
    assert (corrected.depth[2:] == 0).all()


def test_y_up() -> None:
    assert np.allclose(y_up((0.0, -1.0, 0.0)), np.diag([1, -1, -1]))
    for up in ((0.0, 0.0, 1.0), (0.6, 0.8, 0.0), (0.0, 1.0, 0.0), (0.0, -0.6, 0.8)):
        turn = y_up(up)
        assert np.allclose(turn @ up, [0, 1, 0])
        assert np.allclose(turn @ turn.T, np.eye(3))
        assert np.linalg.det(turn) > 0


def test_holes_are_filled_and_the_outer_border_is_not() -> None:
    """A grid of 7×7 squares without the middle one."""
    at = np.arange(64).reshape(8, 8)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    keep = np.arange(49) != 24
    faces = np.concatenate([np.stack([a, b, c], 1)[keep], np.stack([a, c, d], 1)[keep]])
    vertices = np.stack([*np.divmod(np.arange(64), 8), np.zeros(64)], 1).astype(np.float32)
    filled, triangles = filled_holes(vertices, faces.astype(np.int32))
    assert len(filled) == 65
    assert len(triangles) == len(faces) + 4
    assert (vertex_normals(filled, triangles)[:, 2] == vertex_normals(vertices, faces)[0, 2]).all()


def test_all_holes_of_a_closed_surface_are_filled_also_beside_a_fin() -> None:
    """A cube without two triangles, and a third triangle on one of its edges."""
    vertices = np.float32([*np.ndindex(2, 2, 2), (0, -1, 0)])
    sides = [0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]
    faces = [(a, *rest) for a, b, c, d in sides for rest in ((b, c), (c, d))]
    _, triangles = filled_holes(vertices, np.array([*faces[1:5], *faces[6:], (0, 4, 8)]))
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()
    assert Counter(map(tuple, edges)) == Counter((b, a) for a, b in edges)


def test_small_parts() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [5, 6, 7]], np.int32)
    assert largest_parts(faces, 8, 0.5).tolist() == [True, True, True, False]
    assert largest_parts(faces, 8, 0.3).all()
