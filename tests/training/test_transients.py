"""Things that are in only one photo are masked there, and a static scene is trained as before."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat import Dataset, Gaussians, TrainConfig, Trainer, load_dataset, ops, recipe
from snowsplat.data.photos.decode import LoadedImage, load_image
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import render
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.parts.densification import delay_growth
from snowsplat.training.parts.transients import (
    MOMENTS,
    Transients,
    cells_that_move,
    large_residual,
)
from snowsplat.training.parts.view_residuals import CellMap, residuals_elsewhere
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.starts.depth_map import DepthMap
from snowsplat.util.errors import UserError

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
def trained(busy) -> Trainer:
    return run(busy, CONFIG)


@pytest.fixture(scope="module")
def early(busy) -> Trainer:
    """After all moments at which photos are compared."""
    return run(busy, CONFIG, EARLY)


def assert_identical(a: Gaussians, b: Gaussians) -> None:
    for name, parameter in a.parameters().items():
        assert torch.equal(parameter, b.parameters()[name]), name


# The rule


#: A large residual in one view, where nothing moved before, judged by the other views only.
RULE = 0.1, torch.zeros(12, 16, dtype=torch.bool), False
CAMERA = Camera(16, 12, 12.0, 12.0, 8.0, 6.0, torch.eye(3, 4, dtype=torch.float64))


def cells(value: float) -> torch.Tensor:
    return torch.full((12, 16), value)


def view(residual: torch.Tensor, correlation: float = 0.0) -> CellMap:
    """The detail of the photo is not that of the rendering, if the correlation is small."""
    return CellMap(residual, cells(correlation), DepthMap(CAMERA, cells(0.5)))


def test_a_large_residual_in_one_view_only():
    residual, elsewhere, others = cells(0.02), cells(0.02), cells(6.0)
    residual[4:8, 5:9] = 0.3
    found = cells_that_move(view(residual), elsewhere, others, *RULE)
    expected = torch.zeros(12, 16, dtype=torch.bool)
    expected[3:9, 4:10] = True  # and the cells around
    assert torch.equal(found, expected)


@pytest.mark.parametrize(
    "reason", ["elsewhere too", "few others", "alone", "small", "in another light"]
)
def test_what_does_not_move(reason):
    residual, elsewhere, others = cells(0.02), cells(0.02), cells(6.0)
    residual[4:8, 5:9] = 0.3
    if reason == "elsewhere too":
        elsewhere[4:8, 5:9] = 0.15
    elif reason == "few others":
        others[4:8, 5:9] = 1.0
    elif reason == "alone":
        residual[:] = 0.02
        residual[5, 6] = 0.5
    elif reason == "small":
        residual[4:8, 5:9] = 0.08
    seen = view(residual, 0.8 if reason == "in another light" else 0.0)
    assert not cells_that_move(seen, elsewhere, others, *RULE).any()


@pytest.mark.parametrize("first", [12, 15])
@pytest.mark.parametrize("reason", ["found", "a single row", "nothing is shown there"])
def test_a_place_in_no_other_view_is_judged_by_its_own(first, reason):
    """What is at the border of the photo, also in one column, continues beyond it."""
    residual, elsewhere, others = cells(0.02), cells(torch.inf), cells(0.0)
    rows = slice(4, 5 if reason == "a single row" else 8)
    residual[rows, first:] = 0.3
    seen = view(residual)
    if reason == "nothing is shown there":
        seen.places.inverse_depth[rows, first:] = 0.0
    found = cells_that_move(seen, elsewhere, others, *RULE[:2], True)
    expected = torch.zeros(12, 16, dtype=torch.bool)
    expected[3:9, first - 1 :] = reason == "found"
    assert torch.equal(found, expected)
    assert not cells_that_move(seen, elsewhere, others, *RULE).any()


@pytest.mark.parametrize(("elsewhere", "alone"), [(0.02, True), (0.02, False), (0.15, True)])
def test_one_other_view_judges_if_something_moves_in_several_photos(elsewhere, alone):
    residual, others = cells(0.02), cells(1.0)
    residual[4:8, 5:9] = 0.3
    found = cells_that_move(view(residual), cells(elsewhere), others, *RULE[:2], alone)
    assert found.any() == (alone and elsewhere == 0.02)


def test_the_edges_of_a_thing_may_have_a_smaller_residual():
    residual, elsewhere, others = cells(0.01), cells(0.01), cells(6.0)
    residual[4:8, 2:12] = 0.07
    residual[4:8, 5:9] = 0.3
    assert cells_that_move(view(residual), elsewhere, others, *RULE)[4:8, 2:12].all()


def test_a_thing_remains_masked_while_its_residual_is_notable():
    residual, elsewhere, others = cells(0.02), cells(0.02), cells(1.0)
    residual[4:8, 5:9] = 0.12
    before = torch.zeros(12, 16, dtype=torch.bool)
    assert not cells_that_move(view(residual), elsewhere, others, 0.1, before, False).any()
    before[5, 6] = True
    assert cells_that_move(view(residual), elsewhere, others, 0.1, before, False)[4:8, 5:9].all()


def test_residuals_of_the_same_places_in_other_views():
    """Two views side by side: the second one shows the first one's cells one column further."""
    pose = CAMERA.cam_from_world.clone()
    pose[0, 3] = 2.0 / 12.0  # one cell at the depth 2
    first, second = (
        CellMap(
            torch.arange(192.0).reshape(12, 16) + offset,
            cells(1.0),
            DepthMap(replace(CAMERA, cam_from_world=p), cells(0.5)),
        )
        for offset, p in ((0.0, CAMERA.cam_from_world), (1000.0, pose))
    )
    second.places.inverse_depth[3, 5] = 1.0  # something nearer hides this place
    ignored = torch.zeros(2, 12, 16, dtype=torch.bool)
    ignored[1, 7, 9] = True
    usual, others = residuals_elsewhere([first, second], list(ignored))[0]
    expected = second.residual.roll(-1, 1)
    expected[:, 15] = expected[3, 4] = expected[7, 8] = torch.inf
    torch.testing.assert_close(usual, expected)
    assert torch.equal(others, expected.isfinite().to(others.dtype))


# The masks


@pytest.mark.slow
@pytest.mark.parametrize("moving", [0.0, 0.05, 0.2, 0.4])
def test_people_in_a_tenth_of_all_cells_do_not_hide_themselves(moving):
    """Static cells have residuals of 0.02 to 0.06, those that show people 0.5."""
    still = torch.linspace(0.02, 0.06, 1000)
    people = torch.full((round(1000 * moving / (1.0 - moving)),), 0.5)
    assert 0.1 <= large_residual([still[:400], torch.cat([still[400:], people])]) <= 0.25


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


@pytest.mark.slow
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
@pytest.mark.parametrize(("moving", "compared"), [(True, 4), (False, 2)])
def test_if_nothing_moves_the_photos_are_not_compared_again(
    busy, still, moving, compared, monkeypatch
):
    trainer = Trainer(busy if moving else still, CONFIG)
    steps = [round(moment * CONFIG.iterations) for moment in MOMENTS]
    part = trainer.part(Transients)
    compute, found = part._compute, []

    def recorded(run):
        found.append(run.step)
        compute(run)

    monkeypatch.setattr(part, "_compute", recorded)
    trainer.run(until=steps[-1] + 1)
    assert found == steps[:compared]


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
@pytest.mark.parametrize("stop", [25, 100])
def test_a_resumed_run_has_the_same_masks(busy, early, tmp_path, stop):
    first = run(busy, CONFIG, until=stop)
    path = checkpoint.save(tmp_path, stop, first.state_tensors(), {})
    second = Trainer(busy, CONFIG)
    second.load_state(checkpoint.load(path).tensors)
    second.run(until=EARLY)
    assert early.part(Transients).shares()
    assert second.part(Transients).shares() == early.part(Transients).shares()
    assert_identical(second.gaussians, early.gaussians)


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


@pytest.mark.slow
def test_the_masks_do_not_depend_on_the_number_of_threads(busy, early):
    before = ops.get_num_threads()
    ops.set_num_threads(1 if before > 1 else 2)
    try:
        again = run(busy, CONFIG, EARLY)
    finally:
        ops.set_num_threads(before)
    assert_identical(again.gaussians, early.gaussians)


def test_the_masks_of_another_dataset_are_rejected(busy):
    trainer = Trainer(busy, CONFIG)
    state = trainer.state_tensors()
    state["transients.masks"] = state["transients.masks"][:-1].clone()
    with pytest.raises(UserError, match="another dataset or recipe"):
        trainer.load_state(state)


def test_a_checkpoint_without_the_setting_is_as_before(busy):
    state = Trainer(busy, replace(CONFIG, transients="off")).state_tensors()
    assert not [name for name in state if name.startswith("transients.")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "views", "steps"), [("auto", 29, 250), ("auto", 31, 247), ("on", 7, 250)]
)
def test_with_few_photos_or_steps_nothing_is_masked(busy, mode, views, steps):
    few = replace(busy, train=busy.train[:views])
    config = replace(CONFIG, iterations=steps, transients=mode)
    trainer = Trainer(few, config)
    trainer.part(Transients)._compute = None  # is not called
    trainer.run(until=steps // 4)
    assert trainer.part(Transients).shares() == {}


def test_growth_waits_for_the_masks():
    for name in ("default", "paper", "mcmc"):
        assert delay_growth(recipe(name).density).densify_from == MOMENTS[1]
    later = replace(recipe("default").density, densify_from=0.4)
    assert delay_growth(later) is later
