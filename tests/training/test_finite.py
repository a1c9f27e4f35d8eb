"""Values that are not finite: training stops, names them, and never stores them."""

import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from snowsplat.data import Dataset
from snowsplat.data.dataset import Points
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops.native import LAUNCHERS
from snowsplat.training.core import checkpoint
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.density import McmcDensity
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.step.finite import Diverged, check_loss, rows_not_finite
from snowsplat.util.errors import UserError

from ..ops.engines import launcher
from .test_trainer import BUSY, CALM, dataset, every_density_control
from .test_trainer_gpu import with_capacity

__all__ = ["dataset"]  # a fixture

VALUES = [math.nan, math.inf, -math.inf]
PARAMETERS = ["means", "log_scales", "quats", "opacity_logits", "sh_dc"]
ENGINES = [
    "native",
    pytest.param("emulated", marks=pytest.mark.emulated),
    pytest.param("cuda", marks=pytest.mark.gpu),
]
#: Its regulariser has a huge gradient at huge scales, whether or not they are visible.
HUGE_GRADIENTS = replace(
    CALM, density=McmcDensity(densify_from=10, densify_interval=10, max_gaussians=50)
)


@pytest.fixture(params=ENGINES)
def begun(
    request: pytest.FixtureRequest, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> Callable[[TrainConfig], Trainer]:
    """A training run of two steps, by the kernels of each engine."""
    if request.param != "native":
        monkeypatch.setitem(LAUNCHERS, "cpu", launcher(request.param))

    def begin(config: TrainConfig) -> Trainer:
        trainer = with_capacity(Trainer(dataset, config), 100_000)
        trainer.run(until=2)
        return trainer

    return begin


def assert_finite(trainer: Trainer) -> None:
    assert not rows_not_finite(trainer.state_tensors())


def one_line(error: pytest.ExceptionInfo[BaseException]) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 300
    return text


# ----------------------------------------------------------------------------- during training


def test_a_nonfinite_gradient_is_skipped(begun) -> None:
    """The loss of that step is finite. Training stops one step later, in a finite state."""
    trainer = begun(HUGE_GRADIENTS)
    trainer.gaussians.log_scales[3, 1] = 60.0
    trainer.gaussians.log_scales[7] = 90.0
    before, moments = trainer.gaussians.clone(), trainer.optimizer.exp_avg["log_scales"].clone()
    trainer.step_once()
    after = trainer.gaussians
    assert trainer.step == 3
    assert_finite(trainer)
    assert torch.equal(after.log_scales[7], before.log_scales[7])
    assert torch.equal(trainer.optimizer.exp_avg["log_scales"][7], moments[7])
    assert after.log_scales[3, 1] == 60.0
    assert (after.log_scales[8:] != before.log_scales[8:]).any(dim=1).all()

    kept = trainer.gaussians.clone()
    with pytest.raises(
        Diverged, match=r"^step 3: non-finite gradient .* log_scales \(2 rows\), skipped"
    ) as error:
        trainer.run(until=5)
    one_line(error)
    assert trainer.step == 3
    for name, parameter in trainer.gaussians.parameters().items():
        if name != "means":  # the noise of the next step was added
            assert torch.equal(parameter, kept.parameters()[name]), name
    assert_finite(trainer)


def test_a_nonfinite_gradient_of_the_last_step_is_reported(dataset: Dataset) -> None:
    trainer = Trainer(dataset, HUGE_GRADIENTS)
    trainer.run(until=2)
    trainer.gaussians.log_scales[7] = 90.0
    with pytest.raises(
        Diverged, match="^step 3: non-finite gradient or update in log_scales \\(1 row\\)"
    ):
        trainer.run(until=3)
    assert_finite(trainer)


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, VALUES[i % 3]) for i, name in enumerate(PARAMETERS)],
)
def test_nonfinite_parameters(begun, name: str, value: float) -> None:
    trainer = begun(CALM)
    broken = trainer.gaussians.parameters()[name]
    broken[4:7] = value
    other = {n: rows_not_finite({n: t}) for n, t in trainer.state_tensors().items()}
    with pytest.raises(Diverged, match=rf"Gaussians, .*{name} \(3 rows\)") as error:
        trainer.run(until=5)
    assert re_step(one_line(error)) == 3
    # The non-finite values do not spread to other rows.
    for n, found in other.items():
        assert rows_not_finite({n: trainer.state_tensors()[n]}) == found, n


def re_step(text: str) -> int:
    return int(re.match(r"step (\d+)[:,]", text)[1])


@every_density_control
def test_an_invisible_nonfinite_gaussian_is_found_by_the_refinement(dataset, config) -> None:
    """If Adam updates only visible Gaussians, it does not read this one."""
    trainer = Trainer(dataset, config)
    trainer.run(until=2)
    trainer.gaussians.quats[5] = math.nan
    with pytest.raises(Diverged, match=r"^step 10: non-finite Gaussians, quats \(1 row\)") as error:
        trainer.run()
    one_line(error)
    assert trainer.step == 10


def test_the_cause_of_a_nonfinite_loss_is_named(dataset: Dataset) -> None:
    trainer, view = Trainer(dataset, CALM), dataset.train[2]
    planes = torch.full((3, 20, 24), 0.5)
    planes[1, 3, 4:6] = math.nan
    pose = view.camera.cam_from_world.clone()
    pose[0, 3] = math.inf
    lost = replace(view, camera=replace(view.camera, cam_from_world=pose))
    good = LoadedImage(torch.zeros(3, 20, 24, dtype=torch.uint8))
    cases = [
        (view, LoadedImage(planes), "from 2 non-finite pixels"),
        (lost, good, "from a non-finite camera"),
        (view, good, "training has diverged"),
    ]
    for seen, photo, expected in cases:
        with pytest.raises(Diverged, match=expected) as error:
            check_loss(7, math.nan, trainer.gaussians, seen, photo)
        assert one_line(error).startswith(f"step 7, photo {view.name}: the loss is nan, ")
        check_loss(7, 0.5, trainer.gaussians, seen, photo)


# ----------------------------------------------------------------------------- before training


@pytest.mark.parametrize("value", [*VALUES, 1e300])
def test_nonfinite_cameras_and_points(dataset: Dataset, value: float) -> None:
    view = dataset.train[1]
    assert dataset.points is not None
    pose = view.camera.cam_from_world.clone()
    pose[1, 3] = value
    broken = [{"cam_from_world": pose}]
    if value > 0 or math.isnan(value):
        broken += [{"cx": value}, {"fx": value}] if value > 0 else [{"cx": value}]
    for change in broken:
        lost = replace(view, camera=replace(view.camera, **change))
        train = [dataset.train[0], lost, *dataset.train[2:]]
        with pytest.raises(UserError, match=f"1 of 8 cameras .*{view.name}") as error:
            replace(dataset, train=train, description="somewhere")
        assert one_line(error).startswith("somewhere: ")
    xyz = dataset.points.xyz.clone()
    xyz[3:5, 1] = torch.tensor(value)
    with pytest.raises(UserError, match="2 of 40 points are not finite") as error:
        replace(dataset, points=Points(xyz, dataset.points.rgb))
    one_line(error)


@pytest.mark.parametrize("extent", [math.nan, math.inf, 0.0])
def test_an_invalid_extent(dataset: Dataset, extent: float) -> None:
    with pytest.raises(UserError, match="the extent"):
        replace(dataset, extent=extent)


@pytest.mark.parametrize("far", [1e18, 1e20, 3e38])
def test_extremely_distant_points(dataset: Dataset, far: float) -> None:
    """Training either runs or reports these points."""
    assert dataset.points is not None
    xyz = dataset.points.xyz.clone()
    xyz[3] = far
    moved = replace(dataset, points=Points(xyz, dataset.points.rgb))
    if far <= 1e18:
        trainer = Trainer(moved, CALM)
        trainer.run(until=5)
        assert_finite(trainer)
        return
    with pytest.raises(UserError, match=r"log_scales \(\d+ rows?\); remove points") as error:
        Trainer(moved, CALM)
    one_line(error)


# ---------------------------------------------------------------------------------- checkpoints


@pytest.mark.parametrize("key", ["gaussians.means", "optimizer.exp_avg_sq.quats", "density.views"])
def test_checkpoints_are_finite(dataset: Dataset, key: str, tmp_path, monkeypatch) -> None:
    trainer = Trainer(dataset, BUSY)
    trainer.run(until=3)
    good = checkpoint.save(tmp_path, 3, trainer.state_tensors(), {})
    kept = good.read_bytes()
    bad = {name: tensor.clone() for name, tensor in trainer.state_tensors().items()}
    bad[key][2] = math.nan
    with pytest.raises(
        UserError, match=rf"^the state of step 4: non-finite values in {key} \(1 row\); "
    ) as error:
        checkpoint.save(tmp_path, 4, bad, {})
    one_line(error)
    assert [path.name for path in tmp_path.iterdir()] == [good.name]
    assert good.read_bytes() == kept

    # A file written by another program.
    with monkeypatch.context() as without:
        without.setattr(checkpoint, "check_finite", lambda *_: None)
        newer = checkpoint.save(tmp_path, 5, bad, {})
    with pytest.raises(UserError, match=rf"{key} \(1 row\)"):
        checkpoint.load(newer)
    with pytest.warns(UserWarning, match="using the previous one"):
        newest = checkpoint.latest(tmp_path)
    assert newest is not None
    assert newest.path == good
    with pytest.raises(
        UserError, match=rf"^the checkpoint: non-finite values in {key} \(1 row\); "
    ):
        Trainer(dataset, BUSY).load_state(bad)


def test_training_continues_after_loading_an_earlier_state(dataset: Dataset) -> None:
    trainer = Trainer(dataset, HUGE_GRADIENTS)
    trainer.run(until=2)
    state = {name: tensor.clone() for name, tensor in trainer.state_tensors().items()}
    trainer.gaussians.log_scales[7] = 90.0
    with pytest.raises(Diverged):
        trainer.run(until=4)
    trainer.load_state(state)
    trainer.run(until=4)
    assert trainer.step == 4


@pytest.mark.parametrize(("values", "rows"), [([3e38, 3e38], 0), ([3e38, math.inf], 1)])
def test_sums_may_overflow(values: list[float], rows: int) -> None:
    found = rows_not_finite({"a": torch.tensor(values), "b": torch.tensor(1.0)})
    assert found == ({"a": rows} if rows else {})
