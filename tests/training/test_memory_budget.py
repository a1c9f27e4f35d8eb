"""What a training takes: words for it, what is given up for a budget, and that it is kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from snowsplat.data import Dataset, Points, View
from snowsplat.data.decode import ImageSource
from snowsplat.data.image_loader import DECODERS
from snowsplat.scene.camera import Camera
from snowsplat.training.memory_budget import CPU, GPU, in_words, parse_bytes, plan_memory
from snowsplat.training.recipes import recipe
from snowsplat.util.errors import UserError

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
def test_bytes(text: str, count: int) -> None:
    assert parse_bytes(text) == count


@pytest.mark.parametrize("text", ["", "much", "-1GB", "0", "4 GBs", "4ib", "1e9", "nan", "GB"])
def test_no_bytes(text: str) -> None:
    with pytest.raises(UserError, match="must be like 4GB or 800MB"):
        parse_bytes(text)


def test_words() -> None:
    assert in_words(1_300_000_000) == "1.3 GB"
    assert in_words(240_000_000) == "240 MB"
    assert in_words(0) == "1 MB"


def test_without_a_budget_nothing_is_given_up() -> None:
    config = recipe("default")
    plan = plan_memory(dataset_of(100, 1000, 500), config, DEVICE, available=10**10)
    assert plan.given_up == ()
    assert plan.photos == 100 * 3 * 1000 * 500
    assert plan.config.image_memory == config.image_memory
    assert plan.limit is not None
    decoding = plan.total - plan.photos - CPU.of(plan.limit, 500_000, 3)
    assert decoding == DECODERS * 18 * 500_000


def test_without_a_limit_it_says_what_a_million_takes() -> None:
    config = recipe("paper")
    assert config.density.max_gaussians == 0
    plan = plan_memory(dataset_of(9, 100, 100), config, DEVICE, available=10**10)
    assert plan.limit is None
    assert "for each million Gaussians" in str(plan)


def test_photos_go_first_then_gaussians() -> None:
    dataset = dataset_of(200, 1000, 1000)  # 600 MB of photos
    config = recipe("default", max_gaussians=200_000)
    wide = plan_memory(dataset, config, DEVICE, available=10**10, budget=2 * 10**9)
    assert wide.given_up == ()
    narrow = plan_memory(dataset, config, DEVICE, available=10**10, budget=900_000_000)
    assert len(narrow.given_up) == 1
    assert narrow.config.density.max_gaussians == 200_000
    assert narrow.config.image_memory == narrow.photos < 600_000_000
    least = plan_memory(dataset, config, DEVICE, available=10**10, budget=500_000_000)
    assert len(least.given_up) == 2
    assert 1000 <= least.config.density.max_gaussians < 200_000
    for plan, budget in ((wide, 2e9), (narrow, 9e8), (least, 5e8)):
        assert plan.total <= budget


def test_files_are_decoded_whole_whatever_size_is_wanted() -> None:
    config, large = recipe("default"), 24_000_000
    wanted = plan_memory(dataset_of(9, 400, 300), config, DEVICE, 10**10)
    plan = plan_memory(dataset_of(9, 400, 300, large), config, DEVICE, 10**10)
    assert plan.images - wanted.images == DECODERS * 18 * (large - 400 * 300)
    with pytest.raises(UserError, match=r"give more, or make the files smaller$"):
        plan_memory(dataset_of(9, 400, 300, large), config, DEVICE, 10**10, 300_000_000)


def test_too_little_says_how_much_it_takes() -> None:
    with pytest.raises(UserError, match=r"--memory 50 MB is too little .* take \d+ MB; .* -r"):
        plan_memory(dataset_of(9, 2000, 1000), recipe("default"), DEVICE, 10**10, 50_000_000)


def test_what_is_there_already_has_to_fit() -> None:
    dataset, config = dataset_of(9, 100, 100), recipe("default", max_gaussians=50_000)
    whole = plan_memory(dataset, config, DEVICE, 10**10)
    plan = plan_memory(dataset, config, DEVICE, 10**10, whole.total, present=50_000)
    assert plan.given_up == ()
    with pytest.raises(UserError, match=r"go on with 50,000 Gaussians, which take \d+ MB .*more$"):
        plan_memory(dataset, config, DEVICE, 10**10, whole.total - 1_000_000, present=50_000)


def test_a_gpu_takes_less_than_a_gigabyte_for_a_million() -> None:
    assert GPU.of(1_000_000, 0, 3) < 1_000_000_000


@pytest.mark.parametrize("random", [20_000, 200_000])
def test_random_gaussians_begin_wide(random: int) -> None:
    """As many as are there at the start take three times the tiles; the later ones do not."""
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
    later = CPU.of(plans[1].limit, 0, 3) - CPU.fixed
    assert plans[1].scene == later + 2 * CPU.gaussian * min(random, plans[1].limit)
    assert plan_memory(replace(with_points, points=None), config, DEVICE, 10**10, budget, 140_000)
