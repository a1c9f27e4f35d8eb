"""Estimates of the memory of a training run, sizes as text, and reductions to fit a budget."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from snowsplat.data import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.data.photos.image_loader import DECODERS
from snowsplat.scene.camera import Camera
from snowsplat.training.budgets.memory_budget import CPU, GPU, _SceneCost, plan_memory
from snowsplat.training.settings import changed
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.byte_size import format_bytes, parse_bytes
from snowsplat.util.errors import SettingError

DEVICE = torch.device("cpu")


def dataset_of(photos: int, width: int, height: int, stored: int = 0) -> Dataset:
    pose = torch.eye(4, dtype=torch.float64)[:3]
    camera = Camera(width, height, width, width, width / 2, height / 2, pose)
    source = ImageSource(Path("photo.jpg"), width, height, stored=stored)
    points = Points(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8))
    return Dataset([View(str(i), camera, source) for i in range(photos)], [], points, 1.0)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("4GB", 4 * 10**9),
        ("800 mb", 800 * 10**6),
        ("1.5g", 1_500_000_000),
        ("2GiB", 2 * 1024**3),
        ("512MiB", 512 * 1024**2),
        ("1000000", 10**6),
        (".5G", 5 * 10**8),
    ],
)
def test_sizes_are_parsed(text: str, count: int) -> None:
    assert parse_bytes(text) == count


@pytest.mark.parametrize("text", ["", "much", "-1GB", "0", "4 GBs", "4ib", "1e9", "nan", "GB"])
def test_other_text_is_rejected(text: str) -> None:
    with pytest.raises(SettingError, match="^memory: .* is not a size; use e.g. 4GB or 800MB"):
        parse_bytes(text)


def test_sizes_are_formatted() -> None:
    assert format_bytes(1_300_000_000) == "1.3 GB"
    assert format_bytes(240_000_000) == "240 MB"
    assert format_bytes(3_440_000) == "3.4 MB"
    assert format_bytes(31_990) == "32 kB"
    assert format_bytes(0) == "0 bytes"


def test_without_a_budget_nothing_is_reduced() -> None:
    config = recipe("default")
    plan = plan_memory(dataset_of(100, 1000, 500), config, DEVICE, available=10**10)
    assert plan.reductions == ()
    assert plan.photos == 100 * 3 * 1000 * 500
    assert plan.config.image_memory == config.image_memory
    assert plan.limit is not None
    decoding = plan.total - plan.photos - CPU.bytes_for(plan.limit, 500_000, 3)
    assert decoding == DECODERS * 18 * 500_000


def test_without_a_limit_a_million_gaussians_are_estimated() -> None:
    config = recipe("paper")
    assert config.density.max_gaussians == 0
    plan = plan_memory(dataset_of(9, 100, 100), config, DEVICE, available=10**10)
    assert plan.limit is None
    assert "for each million Gaussians" in str(plan.summary())


def test_photos_have_half_of_the_available_memory_and_masks_a_byte_per_pixel() -> None:
    dataset, config = dataset_of(10, 1000, 500), recipe("default")
    mask = dataset.train[0].image
    masked = replace(dataset, train=[replace(dataset.train[0], mask=mask), *dataset.train[1:]])
    assert plan_memory(masked, config, DEVICE, 10**10).photos == 10 * 3 * 500_000 + 500_000
    assert plan_memory(masked, config, DEVICE, 10_000_000).photos == 5_000_000
    limited = changed(config, image_memory=3_000_000)
    assert plan_memory(masked, limited, DEVICE, 10_000_000).photos == 3_000_000


def test_the_median_photo_limits_the_gaussians() -> None:
    views = [view for width in (1000, 200, 400) for view in dataset_of(1, width, 100).train]
    config = recipe("default")
    plan = plan_memory(replace(dataset_of(1, 8, 8), train=views), config, DEVICE, 10**10)
    assert plan.limit == round(400 * 100 * config.gaussians_per_pixel)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_the_smallest_possible_budget(device: str) -> None:
    """1000 Gaussians, renderings of the largest photo, and the six largest photos decoded."""
    sides = [300, 100, 200, 500, 400, 350, 250, 450]
    views = [view for side in sides for view in dataset_of(1, side, 100).train]
    dataset = replace(dataset_of(1, 8, 8), train=views)
    cost, threads = (CPU, DECODERS) if device == "cpu" else (GPU, 0)
    parameters = 3 + 3 + 4 + 1 + 3 + 45
    least = cost.fixed + cost.pixel * 50_000 + 18 * threads * 50_000
    least += 3 * 100 * (500 + 450 + 400 + 350 + 300 + 250)
    least += 1000 * (3 * 4 * parameters + cost.gaussian)
    config, where = recipe("default"), torch.device(device)
    plan = plan_memory(dataset, config, where, 10**10, least)
    assert plan.total == least
    assert plan.limit == 1000
    with pytest.raises(SettingError, match="^memory: "):
        plan_memory(dataset, config, where, 10**10, least - 1)


def test_photos_are_reduced_before_gaussians() -> None:
    dataset = dataset_of(200, 1000, 1000)  # 600 MB of photos
    config = recipe("default", max_gaussians=200_000)
    wide = plan_memory(dataset, config, DEVICE, available=10**10, budget=2 * 10**9)
    assert wide.reductions == ()
    narrow = plan_memory(dataset, config, DEVICE, available=10**10, budget=900_000_000)
    assert len(narrow.reductions) == 1
    assert narrow.config.density.max_gaussians == 200_000
    assert narrow.config.image_memory == narrow.photos < 600_000_000
    least = plan_memory(dataset, config, DEVICE, available=10**10, budget=500_000_000)
    assert len(least.reductions) == 2
    assert 1000 <= least.config.density.max_gaussians < 200_000
    for plan, budget in ((wide, 2e9), (narrow, 9e8), (least, 5e8)):
        assert plan.total <= budget


def test_files_are_decoded_at_full_size_for_any_resolution() -> None:
    config, large = recipe("default"), 24_000_000
    wanted = plan_memory(dataset_of(9, 400, 300), config, DEVICE, 10**10)
    plan = plan_memory(dataset_of(9, 400, 300, large), config, DEVICE, 10**10)
    assert plan.images - wanted.images == DECODERS * 18 * (large - 400 * 300)
    with pytest.raises(SettingError, match=r"; use more, or smaller image files$"):
        plan_memory(dataset_of(9, 400, 300, large), config, DEVICE, 10**10, 300_000_000)


def test_too_little_memory_names_the_required_amount() -> None:
    with pytest.raises(
        SettingError,
        match=r"^memory: 50 MB is too little .* need \d+ MB; use more, or a lower resolution$",
    ):
        plan_memory(dataset_of(9, 2000, 1000), recipe("default"), DEVICE, 10**10, 50_000_000)


def test_gaussians_of_a_resumed_training_have_to_fit() -> None:
    dataset, config = dataset_of(9, 100, 100), recipe("default", max_gaussians=50_000)
    unlimited = plan_memory(dataset, config, DEVICE, 10**10)
    plan = plan_memory(dataset, config, DEVICE, 10**10, unlimited.total, present=50_000)
    assert plan.reductions == ()
    with pytest.raises(
        SettingError, match=r"to resume with 50,000 Gaussians, which need \d+ MB; use more$"
    ):
        plan_memory(dataset, config, DEVICE, 10**10, unlimited.total - 1_000_000, present=50_000)


@pytest.mark.parametrize("random", [20_000, 200_000])
def test_random_gaussians_are_larger(random: int) -> None:
    """Random initial Gaussians touch three times as many tiles; Gaussians added later do not."""
    with_points = dataset_of(9, 1000, 500)
    config = recipe("default", max_gaussians=140_000, initial_points=random)
    budget = 450_000_000
    plans = [
        plan_memory(dataset, config, DEVICE, 10**10, budget)
        for dataset in (with_points, replace(with_points, points=None))
    ]
    assert plans[0].limit == 140_000
    assert plans[1].limit is not None
    assert plans[1].limit < 140_000
    assert plans[1].total <= budget
    later = CPU.bytes_for(plans[1].limit, 0, 3) - CPU.fixed
    assert plans[1].scene == later + 2 * CPU.gaussian * min(random, plans[1].limit)
    assert plan_memory(replace(with_points, points=None), config, DEVICE, 10**10, budget, 140_000)


@pytest.mark.parametrize("available", [0, 399, 400, 4000, 4399, 4400, 4500, 100_000])
def test_the_number_of_gaussians_that_fit_is_the_largest(available: int) -> None:
    cost = _SceneCost(each=100, random=10, extra=300)
    count = cost.gaussians_in(available)
    assert cost.bytes_for(count) <= available < cost.bytes_for(count + 1)
