"""The order in which a path visits cameras."""

import itertools

import pytest
import torch

from snowsplat.trajectory.follow import MOST_CAMERAS, in_order, short_tour

from .rigs import camera_at, ring


def length(lengths: torch.Tensor, tour: list[int]) -> float:
    return float(lengths[tour[:-1], tour[1:]].sum())


def test_short_tours_are_nearly_the_shortest():
    orders = torch.tensor(list(itertools.permutations(range(8))))
    for seed in range(5):
        random = torch.Generator().manual_seed(seed)
        places = torch.rand(8, 2, generator=random, dtype=torch.float64)
        lengths = torch.cdist(places, places)
        tour = short_tour(lengths)
        assert sorted(tour) == list(range(8))
        best = lengths[orders[:, :-1], orders[:, 1:]].sum(1).min()
        assert length(lengths, tour) < 1.15 * best


def test_reversing_a_section_makes_no_tour_shorter():
    for seed in range(3):
        random = torch.Generator().manual_seed(seed)
        places = torch.rand(9, 2, generator=random, dtype=torch.float64)
        lengths = torch.cdist(places, places)
        tour = short_tour(lengths)
        least = length(lengths, tour) - 1e-6
        for i, j in itertools.combinations(range(10), 2):
            assert length(lengths, tour[:i] + tour[i:j][::-1] + tour[j:]) > least


def test_tours_of_few_places():
    for count in range(4):
        assert sorted(short_tour(torch.rand(count, count))) == list(range(count))


def test_a_tour_of_places_that_coincide_ends():
    assert sorted(short_tour(torch.zeros(4, 4))) == [0, 1, 2, 3]


def test_cameras_of_a_walk_are_ordered_by_name():
    """frame_10 comes after frame_9. The order of the list does not matter."""
    cameras = ring(30, turn=5.0)
    mixed = torch.randperm(30, generator=torch.Generator().manual_seed(0)).tolist()
    order = in_order([cameras[i] for i in mixed], [f"frame_{i}" for i in mixed], 3.0)
    assert [mixed[i] for i in order] == list(range(30))


def test_names_that_are_not_in_order_are_ignored():
    cameras = ring(30, turn=5.0)
    order = in_order(cameras, [f"{(7 * i) % 30:02d}" for i in range(30)], 3.0)
    assert order in (list(range(30)), list(range(29, -1, -1)))


def test_many_cameras_are_subsampled():
    count = 3 * MOST_CAMERAS
    cameras = [camera_at((0.01 * i, 0.0, -3.0)) for i in range(count)]
    order = in_order(cameras, [f"{i:05d}" for i in range(count)], 3.0)
    assert order == list(range(0, count, 3))


@pytest.mark.parametrize(("detours", "by_name"), [(3, True), (4, False)])
def test_names_are_used_up_to_one_point_six_times_a_short_tour(detours, by_name):
    """Twelve cameras in a line: a tour of length 11, to which each exchanged pair adds 2."""
    places = list(range(12))
    for i in (1, 4, 7, 9)[:detours]:
        places[i], places[i + 1] = places[i + 1], places[i]
    cameras = [
        camera_at((float(x), 0.0, -3.0), torch.tensor([x, 0.0, 9.0]).double()) for x in places
    ]
    order = in_order(cameras, [f"photo {i}" for i in range(12)], 1.0)
    assert (order == list(range(12))) == by_name
    if not by_name:
        assert [places[i] for i in order] in (list(range(12)), list(range(11, -1, -1)))


def test_of_the_views_of_a_panorama_one_is_visited():
    """Panoramas along x; each has views in four directions, of which one looks along the way."""
    ways = {"back": (-5, 0), "front": (5, 0), "left": (0, 5), "right": (0, -5)}
    cameras, names = [], []
    for i in range(5):
        for name, (x, z) in ways.items():
            target = torch.tensor([float(i + x), 0.0, float(z)], dtype=torch.float64)
            cameras.append(camera_at((float(i), 0.0, 0.0), target))
            names.append(f"pano_{i}_{name}.jpg")
    order = in_order(cameras, names, 3.0)
    assert [names[i] for i in order] == [f"pano_{i}_front.jpg" for i in range(5)]
