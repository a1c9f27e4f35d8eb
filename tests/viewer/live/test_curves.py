"""Curves of any length, and the PSNR of a few views."""

import math

import numpy as np
import pytest
import torch

from snowsplat.data import load_dataset
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.scene.gaussians import Gaussians
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.viewer.live.training import Curve, SampledPsnr


def test_a_curve_has_few_points_and_correct_means():
    curve = Curve()
    for step in range(1, 10_001):
        curve.add(step, 2.0 * step)
    steps, values = map(np.array, curve.lists())
    assert 250 < len(curve) == len(steps) <= 513
    assert np.allclose(values, 2.0 * steps)
    assert (np.diff(steps) > 0).all()
    assert steps[0] < 40
    assert steps[-1] > 9_950
    assert Curve().lists() == ([], [])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("sampled_psnr") / "dataset"
    return load_dataset(write_toy_dataset(root, "colmap-bin", 6, 48, 36, n_points=200))


def test_psnr_equals_an_evaluation(dataset):
    gaussians = Gaussians.from_points(dataset.points)
    black = torch.zeros(3)
    sampled_psnr = SampledPsnr(dataset.train, black)
    chosen = dataset.train[:4]  # evenly spaced, of five
    expected = evaluate_views(gaussians, chosen).psnr
    assert sampled_psnr.measure(gaussians) == pytest.approx(expected, abs=1e-4)
    gaussians.opacity_logits += 1.0
    later = [sampled_psnr.measure(gaussians) for _ in range(4)]  # one after the other
    assert later[0] != pytest.approx(expected, abs=1e-4)
    assert later[3] == pytest.approx(evaluate_views(gaussians, chosen).psnr, abs=1e-4)
    assert SampledPsnr(dataset.train[:2], black).measure(gaussians) > 0


def test_without_photos_there_is_no_psnr(dataset, tmp_path):
    assert not SampledPsnr([], torch.zeros(3)).can_measure
    root = write_toy_dataset(tmp_path / "dataset", "colmap-bin", 2, 48, 36, n_points=50)
    views = load_dataset(root).train
    for photo in (root / "images").iterdir():
        photo.unlink()
    sampled_psnr = SampledPsnr(views, torch.zeros(3))
    assert math.isnan(sampled_psnr.measure(Gaussians.from_points(dataset.points)))
    assert not sampled_psnr.can_measure
