"""Things that are in only one photo are masked there, and a static scene is trained as before."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat import Dataset, TrainConfig, Trainer, load_dataset, recipe
from snowsplat.data.photos.decode import LoadedImage, load_image
from snowsplat.evaluation.metrics import Rendering
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import render
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.parts.densification import delay_growth
from snowsplat.training.parts.transients import MOMENTS, Transients, cells_that_move
from snowsplat.training.parts.view_residuals import CELL, CellMap, Witnesses, cell_map, witnesses
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.starts.depth_map import DepthMap
from snowsplat.util.errors import UserError

from ..gaussians import assert_identical

COUNT, WIDTH, HEIGHT = 36, 128, 96
#: The photos with something in front of the camera, and where: left, upper, right, lower edge.
BOXES = {3: (32, 24, 72, 72), 9: (8, 40, 56, 88), 14: (64, 16, 112, 56), 20: (40, 8, 88, 56)}
CONFIG = recipe("default", iterations=250, transients="auto")
EARLY = CONFIG.iterations // 2


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("still")
    return write_toy_dataset(folder, "colmap-bin", COUNT, WIDTH, HEIGHT, n_points=800)


@pytest.fixture(scope="module")
def still(photos) -> Dataset:
    return load_dataset(photos)


def painted(path: Path, box: tuple[int, int, int, int]) -> None:
    pixels = np.asarray(Image.open(path)).copy()
    left, upper, right, lower = box
    pixels[upper:lower, left:right] = (250, 20, 240)
    Image.fromarray(pixels).save(path)


@pytest.fixture(scope="module")
def busy(photos, tmp_path_factory) -> Dataset:
    dataset = load_dataset(shutil.copytree(photos, tmp_path_factory.mktemp("busy") / "photos"))
    for i, box in BOXES.items():
        painted(dataset.train[i].image.path, box)
    return dataset


def indexed(trainer: Trainer) -> dict[int, float]:
    """The masked share of each photo in which something moves."""
    shares = trainer.part(Transients).shares()
    return {i: shares[v.name] for i, v in enumerate(trainer.dataset.train) if v.name in shares}


def run(dataset: Dataset, config: TrainConfig, until: int | None = None) -> Trainer:
    trainer = Trainer(dataset, config)
    trainer.run(until=until)
    return trainer


@pytest.fixture(scope="module")
def both(busy) -> tuple[Trainer, dict[str, torch.Tensor]]:
    """A whole training, and its state after all moments at which photos are compared."""
    trainer = run(busy, CONFIG, EARLY)
    early = {name: tensor.clone() for name, tensor in trainer.state_tensors().items()}
    trainer.run()
    return trainer, early


@pytest.fixture(scope="module")
def trained(both) -> Trainer:
    return both[0]


# The rule


CAMERA = Camera(16, 12, 12.0, 12.0, 8.0, 6.0, torch.eye(3, 4, dtype=torch.float64))
#: Where something is in the photo.
THING = slice(4, 8), slice(5, 9)


def cells(value: float) -> torch.Tensor:
    return torch.full((12, 16), value)


def view(
    residual: torch.Tensor,
    correlation: float = 0.0,
    colors: torch.Tensor | None = None,
    camera: Camera = CAMERA,
    noise: float = 0.02,
) -> CellMap:
    """The detail of the photo is not that of the rendering, if the correlation is small."""
    colors = torch.zeros(3, 12, 16) if colors is None else colors
    usable, places = torch.ones(12, 16, dtype=torch.bool), DepthMap(camera, cells(0.5))
    return CellMap(residual, noise, cells(correlation), colors, usable, places)


def thing(outside: float, inside: float) -> torch.Tensor:
    values = cells(outside)
    values[THING] = inside
    return values


def said_by_six(**inside: int) -> Witnesses:
    """Six photos show each cell at the same size and explain it; none contradicts outside of the
    thing.
    """
    usual = {"others": 6, "explained": 6, "comparable": 6, "contradicting": 0}
    counts = usual | {"contradicting": 6} | inside
    return Witnesses(*(thing(usual[name], counts[name]).to(torch.int64) for name in usual))


def test_a_photo_that_contradicts_two_others_which_agree():
    found = cells_that_move(view(thing(0.02, 0.3)), said_by_six())
    expected = torch.zeros(12, 16, dtype=torch.bool)
    expected[3:9, 4:10] = True  # and the cells around
    assert torch.equal(found, expected)


@pytest.mark.parametrize(
    ("moves", "counts"),
    [
        (True, {"comparable": 2, "contradicting": 2}),
        (True, {"contradicting": 5}),
        # Gloss, seen by some of the photos.
        (False, {"contradicting": 4}),
        # Two photos, and nobody says which of them is wrong.
        (False, {"others": 1, "explained": 1, "comparable": 1, "contradicting": 1}),
        # Nobody else has seen it.
        (False, {"others": 0, "explained": 0, "comparable": 0, "contradicting": 0}),
        # The scene explains this place in few photos: it is wrong, not this photo.
        (False, {"explained": 4}),
        # Photos from farther away do not show its detail.
        (False, {"comparable": 0, "contradicting": 0}),
    ],
)
def test_who_is_wrong(moves, counts):
    found = cells_that_move(view(thing(0.02, 0.3)), said_by_six(**counts))
    assert bool(found.any()) == moves


@pytest.mark.parametrize("reason", ["noisy photo", "alone", "in another light"])
def test_what_does_not_move(reason):
    residual, noise = thing(0.02, 0.3), 0.02
    if reason == "noisy photo":  # as close to a surface that is not sharp yet
        noise = 0.16
    elif reason == "alone":
        residual = cells(0.02)
        residual[5, 6] = 0.5
    correlation = 0.8 if reason == "in another light" else 0.0
    assert not cells_that_move(view(residual, correlation, noise=noise), said_by_six()).any()


@pytest.mark.parametrize(("others", "continues"), [(6, True), (0, True), (3, False)])
def test_a_thing_continues_where_the_other_photos_do_not_say_otherwise(others, continues):
    """It is as wide as the photo, but only its middle is contradicted: ``others`` of six photos, or
    none, are explained beside it.
    """
    residual = thing(0.02, 0.3)
    residual[4:8] = 0.3
    said = said_by_six()
    beside = torch.zeros(12, 16, dtype=torch.bool)
    beside[4:8] = True
    beside[THING] = False
    said.explained[beside] = others
    said.others[beside] = 6 if others else 0
    said.comparable[beside] = said.contradicting[beside] = 0
    found = cells_that_move(view(residual), said)
    assert found[4:8, 4:10].all()
    assert bool(found[4:8].all()) == continues


def test_the_noise_of_a_photo():
    """That of its residuals, of which a sixth is something else; at least that of its encoding."""
    generator = torch.Generator().manual_seed(0)
    error = 0.05 * torch.randn(12, 16, generator=generator).expand(3, -1, -1)
    error = error.repeat_interleave(CELL, 1).repeat_interleave(CELL, 2)
    error[:, : 2 * CELL] = 0.4

    def noise(error: torch.Tensor, mask: torch.Tensor | None = None) -> float:
        shape = error.shape[1:]
        camera = CAMERA.scaled(shape[1], shape[0])
        picture = torch.linspace(0.3, 0.7, shape[1]).expand(3, *shape)
        planes = torch.ones(shape)
        output = SimpleNamespace(image=picture.permute(1, 2, 0), alpha=planes, depth=2.0 * planes)
        photo = (picture + error).permute(1, 2, 0)
        view = SimpleNamespace(camera=camera)
        return cell_map(Rendering(view, output.image, photo, mask, output)).noise

    assert noise(error) == pytest.approx(0.06, abs=0.02)
    assert noise(torch.zeros_like(error)) == pytest.approx(0.01)
    assert noise(error, torch.zeros(error.shape[1:], dtype=torch.bool)) == math.inf


def moved(cells_right: float) -> Camera:
    """A camera that shows what is at the depth 2 so many cells further to the right."""
    pose = CAMERA.cam_from_world.clone()
    pose[0, 3] = 2.0 * cells_right / 12.0
    return replace(CAMERA, cam_from_world=pose)


def said_of_first(*maps: CellMap, ignored: torch.Tensor | None = None) -> Witnesses:
    there = [torch.zeros(12, 16, dtype=torch.bool) for _ in maps]
    if ignored is not None:
        there[1] = ignored
    return witnesses(maps, there)[0]


def test_what_the_other_photos_say_of_a_place():
    """The second one shows it one column further; one of its colours is not that of the first."""
    colors = torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(1)) * 0.02
    wrong = colors.roll(1, 2)
    wrong[1, 2:9, 3:10] += 0.5
    first = view(cells(0.0), colors=colors)
    second = view(cells(0.0), colors=wrong, camera=moved(1))
    second.places.inverse_depth[3, 5] = 1.0  # something nearer hides this place
    second.usable[10, 2] = False
    second.residual[5, 6] = 0.5  # the scene does not explain it
    ignored = torch.zeros(12, 16, dtype=torch.bool)
    ignored[11, 9] = True
    said = said_of_first(first, second, ignored=ignored)
    shown = torch.ones(12, 16, dtype=torch.int64)
    shown[:, 15] = shown[3, 4] = shown[10, 1] = shown[11, 8] = 0
    assert torch.equal(said.others, shown)
    assert torch.equal(said.comparable, shown)
    explained = shown.clone()
    explained[5, 5] = 0
    assert torch.equal(said.explained, explained)
    # All of the colours around the place there differ.
    contradicting = torch.zeros_like(shown)
    contradicting[3:8, 3:8] = explained[3:8, 3:8]
    assert torch.equal(said.contradicting, contradicting)


def test_an_error_of_a_cell_is_no_contradiction():
    """A checkerboard, whose place the pose of the second photo misses by a cell."""
    colors = ((torch.arange(12)[:, None] + torch.arange(16)) % 2).float().expand(3, -1, -1)
    first = view(cells(0.0), colors=colors.contiguous())
    second = view(cells(0.0), colors=colors.contiguous(), camera=moved(1))
    assert not said_of_first(first, second).contradicting.any()


def test_a_contradiction_is_larger_than_the_usual_difference_of_the_photos():
    """Half of the cells differ by 0.3 between these photos: then it is no evidence."""
    colors = torch.zeros(3, 12, 16)
    colors[:, :, 10:] = 0.3
    first, second = view(cells(0.0)), view(cells(0.0), colors=colors)
    assert said_of_first(first, second).contradicting[:, 11:].all()
    colors[:, :, 4:] = 0.3
    assert not said_of_first(first, second).contradicting.any()


@pytest.mark.parametrize(("depth", "comparable"), [(1.6, True), (3.6, True), (4.4, False)])
def test_photos_of_another_size_of_the_place_do_not_contradict(depth, comparable):
    pose = CAMERA.cam_from_world.clone()
    pose[2, 3] = depth - 2.0
    other = replace(CAMERA, cam_from_world=pose)
    colors = torch.zeros(3, 12, 16)
    colors[:, 5:8, 7:10] = 1.0
    second = view(cells(0.0), colors=colors, camera=other)
    second.places.inverse_depth[:] = 1.0 / depth
    said = said_of_first(view(cells(0.0)), second)
    assert said.others[6, 8] == 1
    assert bool(said.comparable[6, 8]) == bool(said.contradicting[6, 8]) == comparable


# The masks


def test_what_moves_is_found(trained):
    transients = trained.part(Transients)
    found = indexed(trained)
    assert set(found) >= set(BOXES)
    # Small parts of a few others, where at most one other photo shows the place.
    others = [share for i, share in found.items() if i not in BOXES]
    assert len(others) <= 8
    assert max(others, default=0.0) < 0.2
    assert sum(others) < 0.75
    for i, (left, upper, right, lower) in BOXES.items():
        mask = transients.masks[i]
        inside = torch.zeros_like(mask)
        inside[-(-upper // 8) : lower // 8, -(-left // 8) : right // 8] = True
        assert (~mask & inside).sum() >= 0.9 * inside.sum(), i
        assert (~mask).sum() <= 2.0 * inside.sum(), i


@pytest.mark.nightly
def test_the_scene_behind_what_moves(busy, still, trained):
    """Where the boxes are, the rendering is compared with photos without them."""

    def error(trainer: Trainer) -> float:
        total = 0.0
        for i, (left, upper, right, lower) in BOXES.items():
            view = still.train[i]
            with torch.no_grad():
                image = render(trainer.gaussians, view.camera).image[upper:lower, left:right]
            photo = load_image(view.image).permute(1, 2, 0)[upper:lower, left:right] / 255
            total += float((image - photo).square().mean())
        return total

    unmasked = run(busy, replace(CONFIG, transients="off"))
    assert error(trained) < 0.9 * error(unmasked)


@pytest.mark.slow
def test_a_static_scene_changes_no_bit(still):
    masked, unmasked = (run(still, replace(CONFIG, transients=t), EARLY) for t in ("auto", "off"))
    assert masked.part(Transients).shares() == {}
    assert unmasked.part(Transients) is None
    assert_identical(masked.gaussians, unmasked.gaussians)


@pytest.mark.slow
def test_the_mask_of_the_user_remains(trained):
    size = (HEIGHT, WIDTH)

    def masked(index, photo):
        view = SimpleNamespace(index=index)
        return trained.part(Transients).target(trained, view, photo)

    planes = torch.zeros(3, *size, dtype=torch.uint8)
    users = torch.ones(size, dtype=torch.bool)
    users[:, :20] = False
    found = masked(3, LoadedImage(planes)).mask
    both = masked(3, LoadedImage(planes, users)).mask
    assert found is not None
    assert both is not None
    assert torch.equal(both, found & users)
    assert masked(0, LoadedImage(planes, users)).mask is users
    assert masked(0, LoadedImage(planes)).mask is None
    half = masked(3, LoadedImage(planes[:, ::2, ::2])).mask
    assert torch.equal(half, found[::2, ::2])


@pytest.mark.slow
def test_masks_as_pictures(busy, trained):
    pictures = trained.part(Transients).pictures()
    assert set(pictures) == set(trained.part(Transients).shares())
    for i, (left, upper, right, lower) in BOXES.items():
        mask = np.asarray(pictures[busy.train[i].name])
        assert mask.shape == (HEIGHT, WIDTH)
        assert set(np.unique(mask)) == {0, 255}
        assert mask[upper:lower, left:right].mean() < 0.1 * 255


# Resuming, and other settings


@pytest.mark.slow
def test_a_resumed_run_has_the_same_masks(busy, both, tmp_path):
    """It is interrupted between two of the moments."""
    first = run(busy, CONFIG, until=60)
    path = checkpoint.save(tmp_path, 60, first.state_tensors(), {})
    second = Trainer(busy, CONFIG)
    second.load_state(checkpoint.load(path).tensors)
    second.run(until=EARLY)
    assert second.part(Transients).shares()
    for name, tensor in second.state_tensors().items():
        assert torch.equal(tensor, both[1][name]), name


@pytest.mark.slow
def test_masks_are_used_also_if_the_rest_of_the_training_is_shorter(busy, trained):
    """With fewer steps from the beginning, the photos would not have been compared."""
    shorter = Schedule(trained.step + 1, since=trained.step, passed=1.0)
    few = replace(CONFIG, iterations=7 * COUNT)
    resumed = Trainer(busy, few, shorter, state=trained.state_tensors())
    part = resumed.part(Transients)
    assert part.shares() == trained.part(Transients).shares()
    view = SimpleNamespace(index=3)
    photo = LoadedImage(torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8))
    assert part.target(resumed, view, photo).mask is not None


def test_the_masks_of_another_dataset_are_rejected(busy):
    trainer = Trainer(busy, replace(CONFIG, init="points"))
    state = trainer.state_tensors()
    state["transients.masks"] = state["transients.masks"][:-1].clone()
    with pytest.raises(UserError, match="another dataset or recipe"):
        trainer.load_state(state)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "views", "steps"), [("auto", 29, 250), ("auto", 31, 247), ("on", 7, 250)]
)
def test_with_few_photos_or_steps_nothing_is_masked(busy, mode, views, steps):
    few = replace(busy, train=busy.train[:views])
    config = replace(CONFIG, iterations=steps, transients=mode, init="points")
    trainer = Trainer(few, config)
    trainer.part(Transients)._compute = None  # is not called
    trainer.run(until=round(MOMENTS[0] * steps) + 1)
    assert trainer.part(Transients).shares() == {}


def test_growth_waits_for_the_masks():
    for name in ("default", "paper", "mcmc"):
        assert delay_growth(recipe(name).density).densify_from == MOMENTS[1]
    later = replace(recipe("default").density, densify_from=0.4)
    assert delay_growth(later) is later
