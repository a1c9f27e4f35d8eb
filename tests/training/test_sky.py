"""The sky: where photos show it, points there, and none before it."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.gaussians import gaussians_in_box
from torch import Tensor
from torch.nn.functional import normalize

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, rotation_from_quat
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts import found_sky
from snowsplat.training.parts.far_regions import (
    ANGLE,
    COUNT,
    cells_of,
    directions_of,
    in_far_regions,
    median_of,
    regions_of,
    spread_of,
)
from snowsplat.training.parts.found_sky import Sky, find_sky, sky_distance
from snowsplat.training.parts.sky import INTERVAL, SkyPart
from snowsplat.training.settings import changed
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.starts.init import initial_count

from .stage import stage

SIZE = 96
GROUND = 1.5  # y of the ground, below the cameras; y points down
EMPTY = torch.tensor([[1.0, -3.0, 9.0], [-9.0, -3.0, 2.0], [7.0, -3.0, -7.0]])  # in the air
PHOTOS = 12


def ring(radius: float = 2.0, size: int = SIZE) -> list[Camera]:
    """Cameras on a circle that look outwards and ahead."""
    cameras = []
    for i in range(36):
        angle = 2.0 * math.pi * i / 36
        out = torch.tensor([math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
        ahead = torch.tensor([-math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
        gaze = out * (1.0 - 2.0 * (i % 2)) + 0.5 * ahead
        up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        pose = look_at(radius * out, radius * out + gaze, up)
        focal = 0.625 * size
        cameras.append(Camera(size, size, focal, focal, size / 2, size / 2, pose))
    return cameras


def sky_color(directions: Tensor) -> Tensor:
    return 0.6 + 0.3 * torch.sin(2.0 * directions + torch.tensor([0.0, 1.0, 2.0]))


def ground_color(xyz: Tensor) -> Tensor:
    """A pattern with details of 0.7 units."""
    x, _, z = xyz.unbind(-1)
    phases = [torch.sin(4.0 * x + i) * torch.cos(3.7 * z + 2 * i) for i in range(3)]
    return 0.5 + 0.45 * torch.stack(phases, dim=-1)


def plaster(xyz: Tensor) -> Tensor:
    """One colour; the light falls off."""
    return (
        (0.85 - 0.012 * xyz[..., ::2].square().sum(-1, keepdim=True)).clamp(0.6).expand(xyz.shape)
    )


Paint = Callable[[Tensor], Tensor]  # positions or directions (..., 3) -> colours in 0..1


def photo(camera: Camera, height: float, above: Paint) -> Tensor:
    """(H, W, 3) in 0..1: the ground, and above it a ceiling at y = ``height``; -inf: the sky."""
    y, x = torch.meshgrid(*(torch.arange(camera.width) + 0.5,) * 2, indexing="ij")
    ones = torch.ones_like(x)
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, ones], -1)
    pose = camera.world_from_cam.float()
    rays = torch.nn.functional.normalize(rays @ pose[:, :3].T, dim=-1)
    down = rays[..., 1:2]
    floor = pose[:, 3] + rays * (GROUND - pose[1, 3]) / down
    ceiling = pose[:, 3] + rays * (height - pose[1, 3]) / down
    upper = above(rays if math.isinf(height) else ceiling)
    return torch.where(down > 0, ground_color(floor), upper)


def dataset(
    folder: Path,
    height: float = -math.inf,
    radius: float = 2.0,
    size: int = SIZE,
    above: Paint = sky_color,
) -> Dataset:
    """Photos, and points on what has details."""
    views = []
    for i, camera in enumerate(ring(radius, size)):
        pixels = (255.0 * photo(camera, height, above)).clamp(0, 255).round()
        file = folder / f"{i}.png"
        Image.fromarray(pixels.numpy().astype(np.uint8)).save(file)
        views.append(View(f"{i}", camera, ImageSource(file, size, size)))
    xyz = 24.0 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 12.0
    xyz[:, 1] = GROUND
    if above is ground_color:
        xyz[::2, 1] = height
    rgb = (255 * ground_color(xyz)).clamp(0, 255).to(torch.uint8)
    return Dataset(views, [], Points(xyz, rgb), 2.2)


@pytest.fixture(scope="module")
def outdoors(tmp_path_factory) -> Dataset:
    return dataset(tmp_path_factory.mktemp("outdoors"))


def images(data: Dataset) -> ImageLoader:
    return ImageLoader(data.train, budget_bytes=1 << 26)


@pytest.fixture(scope="module")
def sky(outdoors) -> Sky | None:
    return find_sky(outdoors, images(outdoors))


def test_the_middle_of_a_cell_is_in_it_and_cells_are_of_similar_size():
    cells = torch.arange(COUNT)
    directions = directions_of(cells)
    assert torch.equal(cells_of(3.0 * directions), cells)
    some = directions[::997]
    to_others = torch.acos((some @ directions.T).clamp(-1, 1))
    to_next = to_others.topk(2, largest=False).values[:, 1]
    assert 0.6 * ANGLE < float(to_next.min()) <= float(to_next.max()) < 1.4 * ANGLE


def test_regions_continue_across_the_edges_of_the_faces():
    directions = directions_of(torch.arange(COUNT))
    corners = normalize(torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 0.0]]), dim=1)
    caps = directions @ corners.T > math.cos(0.4)
    cells = caps.any(1).nonzero()[:, 0]
    region = regions_of(cells)
    assert region.max() == 1
    assert torch.equal(region == region[caps[cells, 0].nonzero()[0]], caps[cells, 0])
    assert torch.equal(regions_of(torch.tensor([5, 6, 8])), torch.tensor([0, 0, 1]))


def test_medians_and_spreads_of_cells():
    cell = torch.tensor([5, 2, 5, 5, 2])
    values = torch.tensor([[1.0], [7.0], [9.0], [3.0], [8.0]])
    medians = median_of(cell, values)
    assert medians.shape == (COUNT, 1)
    assert medians[[5, 2, 3], 0].tolist() == [3.0, 7.0, 0.0]
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [0, 0, 0], [5, 0, 0]])
    spread = spread_of(cell, positions)
    assert spread[2] == pytest.approx(2.0)
    assert spread[5] == pytest.approx(math.sqrt(2.0))


def test_the_sky_is_found_with_its_colours(sky):
    assert sky is not None
    above = sky.directions[:, 1] < ANGLE
    assert float(above.float().mean()) > 0.99
    assert len(sky.colors) > 3000
    error = sky.colors / 255.0 - sky_color(sky.directions)
    wrong = error[above].abs().amax(1) > 0.03
    assert int(wrong.sum()) <= 3  # cells across the horizon
    assert 0.2 < sky.share < 0.5  # half of the photos is above the horizon; points are near it


def test_points_in_the_sky(outdoors, sky):
    points = sky.points(500)
    assert 250 < len(points) <= 500
    distance = points.xyz.norm(dim=1)
    assert torch.allclose(distance, torch.full_like(distance, sky_distance(ring())), rtol=1e-4)
    assert sky_distance(ring()) == pytest.approx(200.0)
    chosen = find_sky(outdoors, images(outdoors), 37.0)
    assert float(chosen.points(500).xyz.norm(dim=1).max()) == pytest.approx(37.0, rel=1e-4)


def test_what_is_before_the_sky_is_known(outdoors, sky):
    assert sky.is_before(EMPTY).all()
    assert not sky.is_before(outdoors.points.xyz).any()
    assert not sky.is_before(sky.points(500).xyz).any()
    assert not sky.is_before(torch.tensor([[0.0, 60.0, 0.0], [0.0, -60.0, 0.0]])).any()  # unseen


def test_a_wire_before_the_sky_is_kept(tmp_path):
    """It is thinner than a cell, so it hardly changes the colour of one."""
    data = dataset(tmp_path, size=256)
    wire = torch.tensor([[1.0, -3.0, 9.0]])
    for view in data.train:
        pixel, depth = view.camera.project(wire.double())
        x, y = pixel[0].long().tolist()
        if depth > 0 and 0 <= x < 256 and 0 <= y < 256:
            with Image.open(view.image.path) as file:
                pixels = np.array(file)
            pixels[:, x] -= np.minimum(pixels[:, x], 150)
            Image.fromarray(pixels).save(view.image.path)
    sky = find_sky(data, images(data))
    assert not sky.is_before(wire).any()
    assert sky.is_before(EMPTY[1:]).all()


def test_the_limit_removes_gaussians_before_the_sky(outdoors, sky):
    means = torch.cat([EMPTY, outdoors.points.xyz[:4], sky.points(5).xyz])
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(bounds, len(means), torch.Generator().manual_seed(5))
    gaussians.means = means
    before = gaussians.opacities.clone()
    limit = SkyPart()
    limit.prepare(stage(dataset=outdoors, photos=images(outdoors)))
    assert limit.sky.share == sky.share
    limit.between(stage(gaussians, INTERVAL - 1))
    assert torch.equal(gaussians.opacities, before)
    limit.between(stage(gaussians, INTERVAL))
    assert float(gaussians.opacities[:3].max()) < 1 / 255
    assert torch.equal(gaussians.opacities[3:], before[3:])


def test_a_sky_of_the_colour_of_the_background_needs_no_points(tmp_path):
    data = dataset(tmp_path)
    for view in data.train:
        with Image.open(view.image.path) as file:
            pixels = np.array(file)
        pixels[: SIZE // 2] = 255
        Image.fromarray(pixels).save(view.image.path)
    sky = find_sky(data, images(data))
    assert len(sky.points(500, background=(1.0, 1.0, 1.0))) <= 3  # cells across the horizon
    assert len(sky.points(500, background=(0.0, 0.0, 0.0))) > 200


def test_a_ceiling_is_not_the_sky(tmp_path):
    data = dataset(tmp_path, height=-2.0, above=ground_color)
    assert find_sky(data, images(data)) is None


def test_a_plain_ceiling_is_not_the_sky(tmp_path, monkeypatch):
    data = dataset(tmp_path, height=-2.0, above=plaster)
    assert find_sky(data, images(data)) is None
    everything = lambda cells, *others: torch.ones_like(cells, dtype=torch.bool)  # noqa: E731
    monkeypatch.setattr(found_sky, "in_far_regions", everything)
    assert find_sky(data, images(data)) is not None  # its colours alone would be those of a sky


def test_an_overcast_sky_is_found_and_a_plain_dark_region_is_in_doubt(tmp_path):
    for light, found in ((0.97, True), (0.3, False)):
        folder = tmp_path / str(light)
        folder.mkdir()
        data = dataset(folder, above=lambda rays, light=light: torch.full_like(rays, light))
        assert (find_sky(data, images(data)) is not None) is found


def test_below_the_horizon_is_no_sky(tmp_path, outdoors):
    """The same photos, whose cameras are turned over: they show the sky below them."""
    over = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    views = []
    for view in outdoors.train:
        camera = view.camera
        file = tmp_path / f"{view.name}.png"
        with Image.open(view.image.path) as upright:
            upright.rotate(180).save(file)
        turned = replace(camera, cam_from_world=over @ camera.cam_from_world)
        views.append(View(view.name, turned, ImageSource(file, SIZE, SIZE)))
    data = replace(outdoors, train=views)
    assert find_sky(data, images(data)) is None


def test_the_sky_does_not_depend_on_the_frame_and_unit_of_the_world(outdoors, sky):
    turn = rotation_from_quat(torch.tensor([0.6, -0.4, 0.5, 0.48], dtype=torch.float64))
    scale = 1000.0
    shift = torch.tensor([3e5, -2e5, 1e4], dtype=torch.float64)
    views = []
    for view in outdoors.train:
        rotation = view.camera.cam_from_world[:, :3] @ turn.T
        position = scale * (turn @ view.camera.position) + shift
        pose = torch.cat([rotation, -(rotation @ position)[:, None]], dim=1)
        views.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
    points = scale * (outdoors.points.xyz.double() @ turn.T) + shift
    moved = replace(
        outdoors, train=views, points=Points(points.float(), outdoors.points.rgb), extent=2200.0
    )
    other = find_sky(moved, images(moved))
    assert other.share == pytest.approx(sky.share, rel=0.05)
    up = turn @ torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    assert float((other.directions.double() @ up > -ANGLE).float().mean()) == 1.0


def test_photos_from_one_place_and_datasets_without_points_show_no_sky(tmp_path, outdoors):
    near = dataset(tmp_path, radius=0.05)
    assert find_sky(near, images(near)) is None
    without = Dataset(outdoors.train, [], None, 2.2)
    assert find_sky(without, images(without)) is None
    behind = Dataset(outdoors.train, [], Points(torch.tensor([[0.0, 90, 0]]), torch.zeros(1, 3)), 2)
    assert find_sky(behind, images(behind)) is None


def test_the_default_recipe_starts_with_the_sky(outdoors):
    config = changed(recipe("default"), max_gaussians=2000, init="points", iterations=2)
    trainer = Trainer(outdoors, config)
    far = trainer.gaussians.means.norm(dim=1) > 100.0
    assert 20 < int(far.sum()) <= 100
    assert len(trainer.gaussians) <= initial_count(outdoors, config) == 2000
    trainer.run()
    resumed = Trainer(outdoors, config, state=trainer.state_tensors())
    resumed.part(SkyPart).between(resumed)
    assert resumed.part(SkyPart).sky.share == trainer.part(SkyPart).sky.share
    refined = Trainer(outdoors, config, initial=trainer.gaussians)
    assert refined.part(SkyPart).sky is None  # other programs may have placed their sky nearer
    without = Trainer(outdoors, changed(config, sky=False))
    assert not (without.gaussians.means.norm(dim=1) > 100.0).any()


def shading(directions: Tensor) -> Tensor:
    """(M, 3) in 0..255: slow gradients."""
    return 128.0 + 60.0 * torch.sin(2.0 * directions + torch.tensor([0.0, 1.0, 2.0]))


def is_far(
    distance: float, contrast: float = 1.0, noise: float = 1.0, overcast: bool = False
) -> bool:
    """Whether a cap of a sphere of this radius is far, seen by photos with different exposures.

    The median depth of the points is 1, and the cameras are up to 0.5 from the middle.
    """
    generator = torch.Generator().manual_seed(7)
    offsets = 0.5 * normalize(torch.randn(PHOTOS, 3, generator=generator), dim=1)
    cap = (directions_of(torch.arange(COUNT))[:, 1] < -0.9).nonzero()[:, 0]
    cells, photos = cap.repeat(PHOTOS), torch.arange(PHOTOS).repeat_interleave(len(cap))
    directions, origins = directions_of(cells), offsets[photos]
    along = (origins * directions).sum(1)
    reach = (along.square() + distance**2 - origins.square().sum(1)).sqrt() - along
    surface = normalize(origins + reach[:, None] * directions, dim=1)
    exposure = 10.0 * torch.randn(PHOTOS, 1, generator=generator)
    errors = noise * torch.randn(len(cells), 3, generator=generator)
    colors = contrast * shading(surface) + exposure[photos] + errors
    light = torch.full((len(cells),), overcast)
    found = in_far_regions(cells, photos, colors, light, offsets, 1.0)
    assert found.all() == found.any()  # one region
    return bool(found.all())


@pytest.mark.parametrize(
    ("distance", "far"), [(1.0, False), (2.0, False), (4.0, False), (1e4, True)]
)
def test_the_distance_decides_for_any_exposure_of_the_photos(distance, far):
    assert is_far(distance) is far


def test_without_gradients_a_region_is_far_if_it_looks_like_an_overcast_sky():
    assert not is_far(1e4, contrast=0.0)
    assert is_far(1e4, contrast=0.0, overcast=True)
    assert not is_far(1.0, overcast=True)  # its gradients say that it is near


def test_colours_that_differ_in_every_photo_show_nothing_far():
    assert not is_far(1e4, noise=12.0, overcast=True)
