"""The curves of a training run: few points, exact sums, and continuation after resuming."""

import json

import pytest

from snowsplat.training.core.history import MOST_POINTS, History, Stretch


def filled(steps: int) -> History:
    history = History()
    for step in range(1, steps + 1):
        history.step_begins()
        history.step_ends(step, loss=1.0 / step, gaussians=10 * step)
    return history


@pytest.mark.parametrize("steps", [1, 3, MOST_POINTS, MOST_POINTS + 1, 5 * MOST_POINTS + 7])
def test_few_points_for_any_number_of_steps(steps):
    history = filled(steps)
    points = history.stretches
    assert min(steps, MOST_POINTS // 2) <= len(points) <= MOST_POINTS
    # Every step is counted exactly once.
    assert sum(point.steps for point in points) == points[-1].step == steps
    assert {point.steps for point in points[:-1]} <= {history.stride}
    mean = sum(point.steps * point.loss for point in points) / steps
    assert mean == pytest.approx(sum(1.0 / step for step in range(1, steps + 1)) / steps)
    assert points[-1].gaussians == 10 * steps


def test_only_the_time_of_steps_counts(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    history = History()
    for step in range(1, 4):
        now[0] += 100.0  # between two steps
        history.step_begins()
        now[0] += 2.0
        history.step_ends(step, 0.1, 5)
    assert history.seconds == 6.0
    assert [stretch.seconds for stretch in history.stretches] == [2.0, 2.0, 2.0]
    history.step_begins()
    now[0] += 50.0  # an evaluation within the step
    history.step_ends(4, 0.1, 5, timed=False)
    assert history.seconds == 8.0


def test_the_history_continues_from_a_checkpoint(tmp_path):
    """The file may have later steps than the checkpoint. The resumed run repeats these steps."""
    history = filled(1000)
    for step in (400, 800):
        history.measure(step, 20.0 + step / 100, 0.5)
    history.write(tmp_path / "history.json")
    read = History.read(tmp_path / "history.json", 1000)
    assert read == history
    again = History.read(tmp_path / "history.json", 600)
    assert again.stretches[-1].step == 600
    assert [metrics.step for metrics in again.measured] == [400]
    for step in range(601, 1001):
        again.step_ends(step, 1.0 / step, 10 * step)
    assert sum(stretch.steps for stretch in again.stretches) == 1000
    assert len(again.stretches) <= MOST_POINTS


def test_measuring_a_step_again_replaces_its_metrics():
    history = History()
    history.measure(5, 20.0, 0.5)
    history.measure(5, 21.0, 0.6)
    assert [metrics.psnr for metrics in history.measured] == [21.0]


def test_a_missing_or_damaged_file_is_an_empty_history(tmp_path):
    path = tmp_path / "history.json"
    assert History.read(path, 10) == History()
    incomplete = json.dumps({"stretches": [{"step": 1}], "measured": [], "stride": 1})
    for content in (
        "",
        "{",
        "[]",
        "{}",
        incomplete,
        '{"stretches": 1, "measured": 2, "stride": 3}',
    ):
        path.write_text(content)
        assert History.read(path, 10) == History()


def test_two_stretches_are_merged():
    both = Stretch(10, 10, 1.0, 2.0, 50).then(Stretch(15, 5, 4.0, 1.0, 60))
    assert both == Stretch(15, 15, 2.0, 3.0, 60)
