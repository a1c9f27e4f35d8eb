"""Training runs within a time budget, on simulated machines."""

from collections.abc import Callable

import pytest

from snowsplat.training.budgets.pace import FEWEST_STEPS, Pace
from snowsplat.training.budgets.step_cost import StepCost, Work
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.recipes import recipe
from snowsplat.training.settings.schedule import Schedule

PIXELS, FINAL, VIEWS = 500_000.0, 120_000, 6


class Machine:
    """A clock that advances with each step, and a number of Gaussians that grows."""

    def __init__(self, config: TrainConfig, cost: Callable[[int, int, float], float]) -> None:
        self.config, self.cost, self.now = config, cost, 100.0
        self.downscales: list[int] = []
        self.shares: list[float] = []
        self.lengths: list[int] = []
        self.ends: list[float] = []  # as told after each step

    def train(self, seconds: float, iterations: int, time_ratio: float = 1.0) -> float:
        """Returns the time of the last step, as a fraction of the budget."""
        start = self.now
        schedule = Schedule(iterations)
        pace = Pace(Work(self.config, PIXELS, VIEWS), seconds, time_ratio, lambda: self.now)
        step, gaussians = 0, 10_000
        while step < schedule.iterations:
            step += 1
            downscale = self.config.downscale_at(step, schedule)
            self.now += self.cost(downscale, gaussians, (self.now - start) / seconds)
            if step % 100 == 0 and step <= schedule.step_of(self.config.density.densify_until):
                gaussians = min(FINAL, int(1.4 * gaussians))
            self.downscales.append(downscale)
            self.shares.append(schedule.share(step))
            length = pace.after_step(schedule, step, downscale, gaussians)
            if length is not None:
                schedule.stretch(step, length)
                self.lengths.append(length)
            self.ends.append(self.now + pace.seconds_left)
        self.iterations = schedule.iterations
        self.gaussians = gaussians
        return (self.now - start) / seconds


def usual(downscale: int, gaussians: int, when: float) -> float:
    return (2.0 + 60.0 * PIXELS / 1e6 / downscale**2 + 80.0 * gaussians / 1e6) / 1000


def flat(downscale: int, gaussians: int, when: float) -> float:
    return 0.02


def steep(downscale: int, gaussians: int, when: float) -> float:
    return (0.3 + 80.0 / downscale**3 + 10.0 * gaussians / 1e6) / 1000


def twice_as_slow_from_half(downscale: int, gaussians: int, when: float) -> float:
    return usual(downscale, gaussians, when) * (2.0 if when > 0.5 else 1.0)


def three_times_as_fast_from_half(downscale: int, gaussians: int, when: float) -> float:
    return usual(downscale, gaussians, when) / (3.0 if when > 0.5 else 1.0)


def busy_now_and_then(downscale: int, gaussians: int, when: float) -> float:
    return usual(downscale, gaussians, when) * (3.0 if int(20 * when) % 3 == 0 else 1.0)


MACHINES = [
    usual,
    flat,
    steep,
    twice_as_slow_from_half,
    three_times_as_fast_from_half,
    busy_now_and_then,
]


@pytest.mark.parametrize("cost", MACHINES, ids=lambda cost: cost.__name__)
@pytest.mark.parametrize(("seconds", "guess"), [(20.0, 30_000), (60.0, 300)])
def test_the_training_ends_in_time(cost, seconds, guess):
    """For any initial guess, and including the evaluation after the last step."""
    machine = Machine(recipe("default"), cost)
    end = machine.train(seconds, guess)
    after = VIEWS * (0.5 * cost(1, machine.gaussians, 1.0) + 0.05 * PIXELS / 1e6)
    after += 4.0 * machine.gaussians / 1e6
    assert end + after / seconds == pytest.approx(1.0, abs=0.01)
    # The schedule was monotonic, included every stage, and was completed.
    assert machine.shares == sorted(machine.shares)
    assert machine.shares[-1] == 1.0
    assert machine.downscales == sorted(machine.downscales, reverse=True)
    assert set(machine.downscales) == {4, 2, 1}


@pytest.mark.parametrize("name", ["paper", "mcmc"])
def test_other_recipes(name):
    machine = Machine(recipe(name), usual)
    assert machine.train(60.0, 3000) == pytest.approx(0.98, abs=0.04)


def test_the_number_of_steps_converges():
    machine = Machine(recipe("default"), usual)
    machine.train(120.0, 10_000, time_ratio=1.5)
    later = machine.lengths[len(machine.lengths) // 2 :]
    assert max(later) < 1.1 * min(later)
    assert machine.downscales.count(4) / machine.iterations == pytest.approx(0.15, abs=0.03)
    assert machine.downscales.count(2) / machine.iterations == pytest.approx(0.25, abs=0.03)


def test_one_slow_step_is_an_outlier():
    """The computer sleeps for ten seconds. This time is lost; later predictions do not change."""

    def sleepy(downscale: int, gaussians: int, when: float) -> float:
        asleep = 0.5 < when < 0.5001 or (when > 0.5 and not slept)
        if asleep:
            slept.append(True)
        return usual(downscale, gaussians, when) + 10.0 * asleep

    slept: list[bool] = []
    machine = Machine(recipe("default"), sleepy)
    assert machine.train(60.0, 2000) == pytest.approx(0.98, abs=0.03)
    assert len(slept) == 1


def test_a_pause_moves_the_deadline():
    """Training that is paused for a minute ends a minute later, with the same number of steps."""
    now = 100.0
    config = recipe("default")
    pace, paused = (Pace(Work(config, PIXELS, VIEWS), 60.0, 1.0, lambda: now) for _ in range(2))
    plain, other = Schedule(2000), Schedule(2000)
    clocks = [100.0, 100.0]
    for step in range(1, 400):
        lengths = []
        for i, (each, schedule) in enumerate(((pace, plain), (paused, other))):
            clocks[i] += 0.023
            if i and step == 200:
                clocks[i] += 60.0
                each.postpone(60.0)
            now = clocks[i]
            lengths.append(each.after_step(schedule, step, 1, 10_000))
        assert lengths[1] == (lengths[0] and pytest.approx(lengths[0], abs=1)), step
    assert paused.end == pace.end + 60.0


def test_without_time_the_schedule_is_completed_in_few_steps():
    machine = Machine(recipe("default"), usual)
    machine.train(0.01, 3000)
    assert machine.shares[-1] == 1.0
    assert machine.iterations == FEWEST_STEPS
    told = [end - 100.0 for end in machine.ends[25:]]  # the first estimate is after 0.1 s
    assert told == pytest.approx([machine.now - 100.0] * len(told), rel=0.3)


def test_a_future_stage_is_predicted_with_the_present_slowness():
    work = Work(recipe("default"), PIXELS, VIEWS)
    cost = StepCost(work, 1.0, 5.0)
    for _ in range(3000):
        cost.observe(3.0 * work.seconds(2, 50_000), 2, 50_000)
    for stage in ((2, 50_000), (1, 90_000), (4, 10_000)):
        assert cost.predict(*stage) == pytest.approx(3.0 * work.seconds(*stage), rel=0.01)
