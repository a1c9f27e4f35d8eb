"""Normal maps in the loss: the term, the axes of a map, maps that are wrong."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat import Trainer, recipe
from snowsplat.data import load_dataset
from snowsplat.data.colmap.model import write_model
from snowsplat.data.colmap.types import ColmapImage
from snowsplat.data.dataset import Dataset
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.training.parts.normal_supervision import (
    NormalSupervision,
    contradicting,
    normal_term,
    surfaces_of,
)

from .sphere import cameras, dataset, rays, resumed_with_the_same_bits, z_of_sphere

CONFIG = replace(
    recipe("default", iterations=60, init="points", max_gaussians=600, transients="off", sky=False),
    exposure="off",
    coarse_to_fine=(0.0, 0.0),
    few_passes=0.0,
    depth_weight=1.0,
)
SMALL = Camera(7, 6, 8.0, 9.0, 3.2, 2.9, torch.eye(4, dtype=torch.float64)[:3])


def random_view() -> tuple[Tensor, Tensor, Tensor]:
    """Depth and alpha (6, 7) of a rendering, and a map with unknown pixels, in float64."""
    generator = torch.Generator().manual_seed(0)
    alpha, z = torch.rand(2, 6, 7, generator=generator, dtype=torch.float64)
    alpha, z = 0.6 + 0.4 * alpha, 3.0 + 0.2 * z
    target = torch.randn(3, 6, 7, generator=generator, dtype=torch.float64)
    target[2] = -target[2].abs()
    target /= target.norm(dim=0)
    target[:, 2, 3] = 0.0
    return alpha * z, alpha, target


def test_the_term_is_its_formula() -> None:
    depth, alpha, target = random_view()
    alpha[4, 5] = 0.3  # no surface: the pixels around it have no normal
    z, ray = depth / alpha, rays(SMALL)
    expected = 0.0
    c = 1 - math.cos(math.radians(15))
    for y in range(1, 5):
        for x in range(1, 6):
            if abs(y - 4) <= 1 and abs(x - 5) <= 1:
                continue
            points = ray * z[..., None]
            normal = torch.linalg.cross(
                points[y + 1, x] - points[y - 1, x], points[y, x + 1] - points[y, x - 1]
            )
            normal /= normal.norm()
            weight = max(0.0, float(-(normal @ ray[y, x]) / ray[y, x].norm()))
            if bool(target[:, y, x].any()):
                a = 1 - normal @ target[:, y, x]
                expected += weight * c * math.log(1 + float(a) / c)
    found = float(normal_term(depth, alpha, target, SMALL))
    assert found == pytest.approx(expected / 42, rel=1e-9)


def test_the_gradient_is_that_of_a_fixed_weight() -> None:
    depth, alpha, target = random_view()
    _, weight = surfaces_of(depth, alpha, SMALL)
    c = 1 - math.cos(math.radians(15))

    def term(depth: Tensor, alpha: Tensor) -> Tensor:
        surfaces, _ = surfaces_of(depth, alpha, SMALL)
        a = 1 - (surfaces * target).sum(0)
        return (weight * target.any(0) * c * (a / c).log1p()).mean()

    leaves = [depth.requires_grad_(), alpha.requires_grad_()]
    assert torch.autograd.gradcheck(term, leaves)
    found = torch.autograd.grad(normal_term(*leaves, target, SMALL), leaves)
    for one, other in zip(found, torch.autograd.grad(term(*leaves), leaves), strict=True):
        torch.testing.assert_close(one, other)


def test_pixels_without_rendering_or_map_have_no_gradient() -> None:
    for value, target in ((0.0, torch.ones(3, 6, 7)), (1.0, torch.zeros(3, 6, 7))):
        leaves = [torch.full((6, 7), value, requires_grad=True) for _ in range(2)]
        grads = torch.autograd.grad(normal_term(*leaves, target, SMALL), leaves)
        assert all(grad.isfinite().all() and not grad.any() for grad in grads)


def rough(surfaces: Tensor, seed: int, by: float = 0.3) -> Tensor:
    noise = torch.randn(surfaces.shape, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(surfaces + by * noise, dim=0)


def test_a_map_of_another_photo_contradicts() -> None:
    """Also if the rendered normals have errors, and the maps have other sizes."""
    true = [rough(torch.zeros(3, 16, 20), seed, 1.0) for seed in range(6)]
    shown = {i: rough(normals, 10 + i) for i, normals in enumerate(true)}
    maps = {i: rough(normals, 20 + i) for i, normals in enumerate(true)}
    assert contradicting(shown, maps) == []
    maps[1], maps[2], maps[4] = maps[2], maps[1], maps[0]
    assert contradicting(shown, maps) == [1, 2, 4]
    for of_photo in (shown, maps):
        of_photo[3] = of_photo[3].repeat_interleave(2, 1).repeat_interleave(2, 2)
    shown[5] = torch.zeros(3, 16, 20)  # nothing is rendered there: nothing is known
    assert contradicting(shown, maps) == [1, 2, 4]


def test_maps_are_compared_where_both_know_the_normal() -> None:
    """One half of a photo has no exact normals yet; the other map ends there."""
    true = rough(torch.zeros(3, 16, 20), 0, 1.0)
    shown = torch.cat([true[:, :10], rough(true, 1, 2.0)[:, 10:]], 1)
    part = true.clone()
    part[:, 11:] = 0.0
    assert contradicting({0: shown, 1: part}, {0: rough(true, 2), 1: part}) == []


def test_a_map_that_fits_worse_than_one_direction_contradicts() -> None:
    wall = torch.tensor([0.0, 0.0, -1.0])[:, None, None].expand(3, 16, 20)
    shown = {i: rough(wall, i) for i in range(3)}
    maps = dict.fromkeys(range(3), wall)
    assert contradicting(shown, maps) == []  # as good as the mean direction
    tilted = torch.tensor([0.8, 0.0, -0.6])[:, None, None].expand(3, 16, 20)
    assert contradicting({0: shown[0]}, {0: tilted}) == [0]
    # Another frame: all of them, also one that fits by chance.
    shown[2] = rough(tilted, 2)
    assert contradicting(shown, dict.fromkeys(range(3), tilted)) == [0, 1, 2]
    assert contradicting(shown, {0: wall, 1: tilted, 2: tilted}) == [1]


def with_normals(data: Dataset, signs: tuple[int, int, int]) -> Dataset:
    """The maps of the sphere, with axes in other directions, in place of its depths."""
    views = []
    for view in data.train:
        pose = view.camera.cam_from_world
        cam = rays(view.camera) * z_of_sphere(view.camera)[..., None]
        normals = cam - pose[:, 3]  # the centre of the unit sphere is the origin
        path = view.image.path.with_name(f"normals{view.name}.npy")
        np.save(path, (normals * torch.tensor(signs)).numpy())
        views.append(replace(view, depth=None, normals=path))
    return replace(data, train=views)


def trained(data: Dataset, **settings) -> tuple[Trainer, list[str]]:
    lines: list[str] = []
    trainer = Trainer(data, replace(CONFIG, **settings), note=lambda line: lines.append(str(line)))
    trainer.run()
    return trainer, lines


def angle(trainer: Trainer) -> float:
    """The median angle between the rendered and the true normals in all views, degrees."""
    angles = []
    for camera in cameras():
        shown = render(trainer.gaussians, camera, with_depth=True)
        surfaces, weight = surfaces_of(shown.depth, shown.alpha, camera)
        true = (rays(camera) * z_of_sphere(camera)[..., None] - camera.cam_from_world[:, 3]).float()
        known = (weight > 0) & true.isfinite().all(2)
        cosine = (surfaces.permute(1, 2, 0) * true).sum(2)[known]
        angles.append(cosine.clamp(-1, 1).acos().rad2deg())
    return float(torch.cat(angles).median())


def test_the_axes_of_the_maps_are_found_and_the_normals_follow(tmp_path) -> None:
    data = dataset(tmp_path)
    without, lines = trained(with_normals(data, (1, 1, 1)), depth_weight=0.0)
    for signs in ((1, 1, 1), (1, -1, -1)):
        trainer, lines = trained(with_normals(data, signs))
        part = trainer.part(NormalSupervision)
        assert part.signs.tolist() == list(signs)
        assert part.used.all()
        assert lines == ["normal maps: 6 of 6 photos"]
        assert angle(trainer) < 0.9 * angle(without)


def test_maps_that_are_damaged_or_of_something_else_are_left_out(tmp_path) -> None:
    data = with_normals(dataset(tmp_path), (1, 1, 1))
    data.train[1].normals.write_bytes(b"no array")
    np.save(data.train[2].normals, np.load(data.train[2].normals)[::-1, ::-1])
    trainer, lines = trained(data, iterations=40)
    assert trainer.part(NormalSupervision).used.tolist() == [True, False, False, True, True, True]
    first, second = lines
    assert "normal maps: 5 of 6 photos" in first
    assert "cannot be read as a normal map" in first
    assert second == "normal maps that contradict the photos are not used: 2"


def inside_of_a_cube() -> Gaussians:
    """Small ones on the faces of the cube -1..1."""
    at = torch.linspace(-0.95, 0.95, 20)
    a, b = torch.meshgrid(at, at, indexing="ij")
    faces = [
        torch.stack([a, b, torch.full_like(a, side)], -1).roll(axis, -1).reshape(-1, 3)
        for axis in range(3)
        for side in (-1.0, 1.0)
    ]
    means = torch.cat(faces)
    rows = len(means)
    return Gaussians(
        means,
        torch.full((rows, 3), math.log(0.06)),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, 1),
        torch.full((rows,), 4.0),
        torch.zeros(rows, 1, 3),
        torch.zeros(rows, 0, 3),
    )


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("OPENCV_FISHEYE", (38.0, 38.0, 48.0, 48.0, 0.01, 0.0, 0.0, 0.0)),
        ("EQUIRECTANGULAR", (160.0, 80.0)),
    ],
)
def test_maps_of_fisheyes_and_panoramas(tmp_path, model: str, params: tuple[float, ...]) -> None:
    """Each becomes several views; the map is in the frame of the whole photo."""
    width, height = (160, 80) if model == "EQUIRECTANGULAR" else (96, 96)
    (tmp_path / "images").mkdir()
    (tmp_path / "normals").mkdir()
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    rays = lens_of(model, width, height, params).directions(pixels.reshape(-1, 2))
    face = np.abs(rays).argmax(1)
    normals = -np.sign(rays[np.arange(len(rays)), face, None]) * np.eye(3)[face]
    normals = normals.reshape(height, width, 3)
    images = []
    for i in range(2):
        Image.fromarray(np.full((height, width, 3), 90, np.uint8)).save(
            tmp_path / f"images/{i}.png"
        )
        np.save(tmp_path / f"normals/{i}.npy", normals * (1, -1, -1))
        images.append(ColmapImage(f"{i}.png", 1, (1.0, 0, 0, 0, 0.1 * i, 0, 0)))
    camera = lens_of(model, width, height, params)
    write_model(tmp_path / "sparse/0", {1: camera}, images, np.eye(3), np.zeros((3, 3), np.uint8))
    data = load_dataset(tmp_path, hold_out=None)
    assert len(data.train) > 4
    config = replace(CONFIG, iterations=4, sh_degree=0)
    trainer = Trainer(data, config, initial=inside_of_a_cube())
    trainer.run()
    part = trainer.part(NormalSupervision)
    assert part.signs.tolist() == [1, -1, -1]
    assert part.used.all()
    for index, view in enumerate(data.train):
        shown = render(inside_of_a_cube(), view.camera, with_depth=True)
        batch_view = SimpleNamespace(index=index, view=view, camera=view.camera)
        assert float(part.loss(trainer, batch_view, shown)) < 0.035


def test_without_maps_nothing_changes(tmp_path) -> None:
    data = dataset(tmp_path)
    data = replace(data, train=[replace(view, depth=None) for view in data.train])
    one, _ = trained(data, iterations=8)
    other, _ = trained(data, iterations=8, depth_weight=0.0)
    part = one.part(NormalSupervision)
    assert part.idle
    assert part.state() == {}
    assert torch.equal(one.gaussians.means, other.gaussians.means)


def test_a_resumed_run_has_the_same_bits(tmp_path) -> None:
    data, config = with_normals(dataset(tmp_path), (1, -1, -1)), replace(CONFIG, iterations=20)
    second = resumed_with_the_same_bits(data, config, 9, 12)
    assert second.part(NormalSupervision).signs.tolist() == [1, -1, -1]
