"""Plans for a given time, on simulated machines."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data import load_dataset
from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.camera import Camera
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.budgets import time_plan as planning
from snowsplat.training.budgets.time_plan import Plan, make_plan, measure_time_ratio
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings import changed
from snowsplat.training.settings.recipes import recipe

POSE = torch.eye(4, dtype=torch.float64)[:3]


def dataset(width: int, height: int, photos: int = 50) -> Dataset:
    """Cameras without image files: a plan reads none."""
    camera = Camera(width, height, 500.0, 500.0, width / 2, height / 2, POSE)
    views = [
        View(f"{i}.jpg", camera, ImageSource(Path(f"{i}.jpg"), width, height))
        for i in range(photos)
    ]
    points = Points(torch.zeros(10_000, 3), torch.zeros(10_000, 3, dtype=torch.uint8))
    return Dataset(views[1:], views[:1], points, extent=1.0)


def planned(seconds: float, width: int, height: int, time_ratio: float = 1.0, **how: bool) -> Plan:
    return make_plan(dataset(width, height), recipe("default"), seconds, time_ratio, **how)


@pytest.mark.parametrize(("width", "height"), [(552, 986), (4032, 3024), (3024, 4032)])
def test_more_time_never_reduces_size_or_gaussians(width, height):
    plans = [planned(seconds, width, height) for seconds in (5, 20, 60, 180, 600, 3600)]
    pixels = [plan.width * plan.height for plan in plans]
    assert pixels == sorted(pixels)
    caps = [plan.config.density.max_gaussians for plan in plans]
    assert caps == sorted(caps)
    # Where the size or the limit increases, the number of steps may decrease a little.
    assert all(plan.config.iterations >= 1000 for plan in plans[2:])
    assert plans[-1].config.iterations > 10_000


def test_the_size_of_photos():
    assert planned(3600, 4032, 3024).resolution == 1600  # no larger than that
    assert planned(3600, 552, 986).resolution is None  # and never enlarged
    little = planned(1, 552, 986)
    assert (little.resolution, little.height) == (112, 200)  # no smaller
    assert planned(1, 200, 150).resolution is None
    fixed = planned(1, 4032, 3024, resize=False)
    assert (fixed.resolution, fixed.width, fixed.height) == (None, 4032, 3024)
    slow = planned(60, 552, 986, time_ratio=4.0)
    assert slow.width < 552
    assert planned(240, 552, 986, time_ratio=4.0).width > slow.width


def test_no_time_left():
    """Reading the photos on a busy machine may take longer than the whole budget."""
    for seconds in (0.0, -3.0):
        plan = planned(seconds, 552, 986)
        assert (plan.config.iterations, plan.height, plan.config.init) == (100, 200, "points")


def test_the_time_is_used():
    """Steps times seconds per step is the budget, except for the time before and after them."""
    for seconds in (20.0, 300.0):
        config = recipe("default", init="points")  # depth maps take a part of the time
        plan = make_plan(dataset(552, 986), config, seconds, 2.0)
        assert 0.85 * seconds < plan.config.iterations * plan.seconds < seconds


def test_depth_maps_are_as_large_as_there_is_time_for():
    sides = [planned(seconds, 552, 986).config.sweep_side for seconds in (0.5, 1, 10, 120)]
    assert sides == sorted(sides)
    assert sides[0] < 200
    assert sides[-1] == recipe("default").sweep_side
    assert planned(0.2, 552, 986).config.init == "points"  # too short for maps of a useful size
    without_points = replace(dataset(552, 986), points=None)
    short = make_plan(without_points, recipe("default"), 0.2, 1.0).config
    assert (short.init, short.sweep_side) == ("points+sweep", 100)  # random points need many steps
    assert planned(120, 552, 986).config.init == recipe("default").init == "points+sweep"
    without = make_plan(dataset(552, 986), recipe("default", init="points"), 60, 1.0)
    steps = without.config.iterations - planned(60, 552, 986).config.iterations
    assert 0.02 < steps / without.config.iterations < 0.15  # they take some of the time


def test_the_number_of_gaussians():
    assert planned(60, 552, 986).config.density.max_gaussians == 200_000
    assert planned(3600, 552, 986).config.density.max_gaussians == 326_563
    assert planned(3600, 270, 480).config.density.max_gaussians == 77_760  # 0.6 per pixel
    named = changed(recipe("default"), max_gaussians=50_000)
    plan = make_plan(dataset(552, 986), named, 3600, 1.0, more_gaussians=False)
    assert plan.config.density.max_gaussians == 50_000


def test_a_short_run_densifies_more_often():
    for seconds, interval in ((3, 25), (3600, 100)):
        density = planned(seconds, 552, 986).config.density
        assert (density.densify_interval, density.densify_from) == (interval, interval)
    density = planned(3, 552, 986, more_often=False).config.density
    assert (density.densify_interval, density.densify_from) == (100, 100)


def test_a_smaller_size_leaves_enough_steps():
    """A training of 1173 steps at 1600 pixels was far from its end."""
    for seconds in (5, 15, 30, 60, 180, 600):
        for ratio in (1.0, 2.0, 4.0):
            plan = planned(seconds, 4032, 3024, time_ratio=ratio)
            if plan.width > 200:
                assert plan.config.iterations >= 3 * math.sqrt(plan.width * plan.height)


def test_many_photos_are_all_used():
    config = recipe("default")
    few, many = (make_plan(dataset(1000, 750, n), config, 120, 2.0) for n in (40, 400))
    assert many.width < few.width
    assert many.config.iterations >= 10 * 399


def test_other_recipes():
    for name in ("paper", "mcmc"):
        plan = make_plan(dataset(552, 986), recipe(name), 600, 1.0)
        assert plan.config.iterations > 1500
    assert "no limit" in str(make_plan(dataset(552, 986), recipe("paper"), 600, 1.0).summary())


def test_plans_as_text():
    plan = replace(planned(60, 552, 986), config=recipe("default", iterations=8964))
    assert str(plan.summary()) == "552x986, at most 200,000 Gaussians, about 9,000 steps"
    assert str(planned(1, 200, 150).summary()).startswith("200x150, at most 18,000 Gaussians")
    assert str(planned(1, 552, 986).summary()).startswith(
        "photos reduced to 112x200, at most 13,440"
    )


@pytest.mark.slow
def test_the_speed_of_this_machine(tmp_path):
    """The measured speed is positive, and measuring does not change the dataset."""
    for format, points in (("colmap-bin", 300), ("blender", None)):
        folder = tmp_path / format
        write_toy_dataset(folder, format, 9, 48, 36, n_points=300)
        small = load_dataset(folder)
        assert 0.0 < measure_time_ratio(small, recipe("default")) < float("inf")
        assert len(small.train) == 7
        assert (small.points is None) if points is None else (len(small.points) == points)


@pytest.mark.slow
def test_the_speed_is_measured_on_photos_of_at_most_the_largest_size(tmp_path, monkeypatch):
    """Steps on the original photos may take many times the memory of the training."""
    random = np.random.default_rng(0)
    views = []
    for name in ("0.png", "1.png"):
        Image.fromarray(random.integers(0, 255, (64, 4000, 3), np.uint8)).save(tmp_path / name)
        Image.fromarray(np.full((64, 4000), 255, np.uint8)).save(tmp_path / f"mask {name}")
        camera = Camera(4000, 64, 2000.0, 2000.0, 2000.0, 32.0, POSE)
        image, mask = (ImageSource(tmp_path / f, 4000, 64) for f in (name, f"mask {name}"))
        views.append(View(name, camera, image, mask))
    wide = Dataset(views, [], Points(torch.rand(50, 3), torch.zeros(50, 3, dtype=torch.uint8)), 1.0)
    measured = []

    class Watched(Trainer):
        def __init__(self, dataset: Dataset, *rest: object, **more: object) -> None:
            measured.extend((view.camera.width, view.camera.height) for view in dataset.train)
            super().__init__(dataset, *rest, **more)

    monkeypatch.setattr(planning, "Trainer", Watched)
    for resize, size in ((True, (1600, 26)), (False, (4000, 64))):
        measured.clear()
        assert measure_time_ratio(wide, recipe("default"), resize=resize) > 0.0
        assert measured == [size] * 2
    assert views[0].camera.width == views[0].image.width == 4000
