"""The training loop on a tiny scene: it learns, repeats and resumes bitwise, and stops cleanly."""

import math
import os
import signal
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from snowsplat import ops
from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.ops import reference
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render
from snowsplat.training.core import checkpoint
from snowsplat.training.core.trainer import Progress, Trainer
from snowsplat.training.core.view_queue import Background
from snowsplat.training.density import AdaptiveDensity, McmcDensity
from snowsplat.training.parts.densification import Densification
from snowsplat.training.settings import TrainConfig, changed
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.settings.starts import STARTS
from snowsplat.training.step.losses import view_loss
from snowsplat.util.errors import UserError

from ..gaussians import assert_identical

WIDTH, HEIGHT, COUNT = 24, 20, 40


def true_scene() -> Gaussians:
    generator = torch.Generator().manual_seed(11)
    return Gaussians(
        means=torch.rand(COUNT, 3, generator=generator) * 2 - 1,
        log_scales=torch.rand(COUNT, 3, generator=generator) - 2.0,
        quats=torch.randn(COUNT, 4, generator=generator),
        opacity_logits=torch.rand(COUNT, generator=generator) * 3,
        sh_dc=torch.rand(COUNT, 1, 3, generator=generator) * 3 - 1.5,
        sh_rest=torch.zeros(COUNT, 15, 3),
    )


def camera_at(angle: float) -> Camera:
    position = torch.tensor([3.5 * math.cos(angle), 0.8, 3.5 * math.sin(angle)]).double()
    pose = look_at(position, torch.zeros(3).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    return Camera(WIDTH, HEIGHT, 26.0, 26.0, WIDTH / 2, HEIGHT / 2, pose)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder: Path = tmp_path_factory.mktemp("tiny")
    scene = true_scene()
    views = []
    for i in range(8):
        camera = camera_at(2 * math.pi * i / 8)
        image = render(scene, camera, torch.zeros(3)).image.clamp(0, 1)
        path = folder / f"{i}.png"
        Image.fromarray((255 * image).round().to(torch.uint8).numpy().copy()).save(path)
        views.append(View(path.name, camera, ImageSource(path, WIDTH, HEIGHT)))
    generator = torch.Generator().manual_seed(12)
    xyz = scene.means + 0.05 * torch.randn(COUNT, 3, generator=generator)
    rgb = (255 * scene.base_colors.clamp(0, 1)).to(torch.uint8)
    return Dataset(views[1:], views[:1], Points(xyz, rgb), extent=3.5)


#: 60 steps with densification, coarse to fine, decay, annealing, and increasing SH degrees.
BUSY = TrainConfig(
    iterations=60,
    background="random",
    sh_interval=10,
    coarse_to_fine=(0.1, 0.2),
    visible_only=True,
    learning_rates=LearningRates(anneal=0.1, anneal_from=0.5),
    decay=DecayRates(opacity=0.05, scale=0.05),
    density=AdaptiveDensity(
        densify_from=10,
        densify_until=50,
        densify_interval=10,
        opacity_reset_interval=0,
        max_gaussians=150,
    ),
    test_iterations=(),
)
BUSY_ABS_GRAD = replace(BUSY, density=replace(BUSY.density, abs_grad=True))
BUSY_MCMC = replace(
    BUSY, density=McmcDensity(densify_from=10, densify_interval=10, max_gaussians=50)
)
#: Runs a test with every density control. Add a new one here.
every_density_control = pytest.mark.parametrize(
    "config",
    [
        pytest.param(BUSY, id="adaptive"),
        pytest.param(BUSY_ABS_GRAD, id="abs-grad"),
        pytest.param(BUSY_MCMC, id="mcmc"),
        pytest.param(replace(BUSY, antialias=True), id="antialias"),
    ],
)
CALM = TrainConfig(
    iterations=300,
    sh_interval=100,
    learning_rates=LearningRates(means_steps=1.0),
    density=AdaptiveDensity(densify_until=0),
    test_iterations=(),
)


def trained(dataset: Dataset, config: TrainConfig) -> Gaussians:
    trainer = Trainer(dataset, config)
    trainer.run()
    return trainer.gaussians


@pytest.mark.slow
def test_training_learns_and_has_the_same_losses_in_float64(dataset, monkeypatch):
    """80 of the 300 steps, up to the highest SH degree, have the losses of the reference ops."""

    def losses(trainer: Trainer, steps: int) -> torch.Tensor:
        return torch.tensor([trainer.step_once() for _ in range(steps)], dtype=torch.float64)

    config = replace(CALM, sh_interval=15)
    trainer = Trainer(dataset, config)
    before = trainer.evaluate()
    native = losses(trainer, 300)
    after = trainer.evaluate()
    assert native[-50:].mean() < 0.35 * native[:50].mean()
    assert after.psnr > before.psnr + 3

    exact = Trainer(dataset, config)
    exact.gaussians = exact.gaussians.to(dtype=torch.float64)
    for moments in (exact.optimizer.exp_avg, exact.optimizer.exp_avg_sq):
        moments.update({name: moment.double() for name, moment in moments.items()})
    for name in ("project", "rasterize", "photometric_loss", "adam_step"):
        monkeypatch.setattr(ops, name, getattr(reference, name))
    expected = losses(exact, 80)
    native = native[:80]
    torch.testing.assert_close(native[:30], expected[:30], rtol=1e-3, atol=0)
    # Rounding errors grow during training, so only the trend is the same later.
    torch.testing.assert_close(native, expected, rtol=0.1, atol=0)
    assert float(native[-50:].mean()) == pytest.approx(float(expected[-50:].mean()), rel=0.02)


@pytest.mark.isa
@every_density_control
def test_the_number_of_threads_does_not_change_a_bit(dataset, config):
    torch_threads, ops_threads = torch.get_num_threads(), ops.get_num_threads()
    try:
        scenes = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            ops.set_num_threads(threads)
            scenes.append(trained(dataset, config))
            assert torch.get_num_threads() == threads  # restored
    finally:
        torch.set_num_threads(torch_threads)
        ops.set_num_threads(ops_threads)
    assert_identical(*scenes)
    assert len(scenes[0]) != COUNT  # density control did something


def test_another_seed_gives_another_scene(dataset):
    a, b = (trained(dataset, replace(BUSY, seed=seed)) for seed in (0, 1))
    assert len(a) != len(b) or not torch.equal(a.means, b.means)


@every_density_control
@pytest.mark.parametrize("stop", [30, 37])
def test_resuming_is_bit_identical(dataset, config, stop, tmp_path):
    """The run is interrupted before step 30, which densifies, or before a step that does not."""
    uninterrupted = trained(dataset, config)
    first = Trainer(dataset, config)
    first.run(until=stop)
    path = checkpoint.save(tmp_path, first.step, first.state_tensors(), {})
    second = Trainer(dataset, config)
    second.load_state(checkpoint.load(path).tensors)
    assert second.step == stop
    second.run()
    assert_identical(second.gaussians, uninterrupted)


def test_a_run_starts_from_given_gaussians_and_does_not_change_them(dataset):
    initial = true_scene()
    trainer = Trainer(dataset, TrainConfig(iterations=3), initial=initial)
    assert trainer.evaluate().psnr > 45
    trainer.run()
    assert torch.equal(initial.means, true_scene().means)
    assert not torch.equal(trainer.gaussians.means, initial.means)


def test_an_antialiased_scene(dataset):
    """It is trained with the filter: without it, the same Gaussians fit the photos less well."""
    config = replace(CALM, antialias=True, batch=2, learning_rates=LearningRates().scaled(3.0))
    small = dataset.points.xyz.repeat(4, 1) + 0.1 * torch.randn(
        4 * COUNT, 3, generator=torch.Generator().manual_seed(3)
    )
    points = Points(small, dataset.points.rgb.repeat(4, 1))
    trainer = Trainer(replace(dataset, points=points), config)
    before = trainer.evaluate().psnr
    trainer.run()
    assert trainer.gaussians.antialiased
    with_filter = trainer.evaluate().psnr
    trainer.gaussians.antialiased = False
    assert with_filter > max(before, trainer.evaluate().psnr) + 2


def test_a_resumed_run_does_not_initialise_again(dataset, monkeypatch):
    """Depth maps take time, and the Gaussians come from the checkpoint."""
    config = changed(BUSY, init="points+sweep", initial_points=0.5, max_gaussians=500)
    uninterrupted = trained(dataset, config)
    first = Trainer(dataset, config)
    first.run(until=30)
    state = {name: tensor.clone() for name, tensor in first.state_tensors().items()}
    monkeypatch.delitem(STARTS, "sweep")
    second = Trainer(dataset, config, state=state)
    assert second.step == 30
    second.run()
    assert_identical(second.gaussians, uninterrupted)


@every_density_control
def test_a_stretched_run_completes_its_schedule_and_resumes_bitwise(dataset, config, tmp_path):
    """60 steps become 90 after step 20, and 45 after step 40."""
    rates = replace(config.learning_rates, means_steps=1.0)
    config = replace(config, coarse_to_fine=(0.2, 0.5), learning_rates=rates)
    reports: list[Progress] = []
    first = Trainer(dataset, config)

    def stretch(progress: Progress) -> None:
        reports.append(progress)
        if progress.step == 20:
            first.schedule.stretch(20, 90)
        if progress.step == 40:
            first.schedule.stretch(40, 45)
            checkpoint.save(tmp_path, 40, first.state_tensors(), asdict(first.schedule))

    first.run(stretch)
    assert [report.iterations for report in reports] == 20 * [60] + 20 * [90] + 5 * [45]
    assert [report.downscale for report in reports] == 12 * [4] + 26 * [2] + 7 * [1]
    assert first.optimizer.rates_at(45) == Trainer(dataset, config).optimizer.rates_at(60)
    saved = checkpoint.latest(tmp_path)
    assert saved is not None
    second = Trainer(dataset, config, Schedule(**saved.meta))
    second.load_state(saved.tensors)
    second.run()
    assert second.step == 45
    assert_identical(second.gaussians, first.gaussians)


def test_a_checkpoint_of_another_configuration_is_rejected(dataset):
    state = Trainer(dataset, BUSY).state_tensors()
    for other in (BUSY_MCMC, replace(BUSY, sh_degree=1)):
        with pytest.raises(UserError, match="another dataset or recipe"):
            Trainer(dataset, other).load_state(state)
    trainer = Trainer(dataset, BUSY)
    trainer.run(until=1)
    fewer = replace(dataset, train=dataset.train[:2])
    with pytest.raises(UserError, match="another dataset or recipe"):
        Trainer(fewer, BUSY).load_state(trainer.state_tensors())


def test_a_checkpoint_of_inconsistent_tensors_is_rejected(dataset):
    """The kernels assume equal numbers of rows in all tensors and would read out of bounds."""
    trainer = Trainer(dataset, BUSY)
    trainer.run(until=1)
    state = trainer.state_tensors()
    for name, value in (
        ("gaussians.means", state["gaussians.means"][:3]),
        ("optimizer.exp_avg.quats", state["optimizer.exp_avg.quats"][:3]),
        ("gaussians.quats", state["gaussians.quats"].to(torch.int32)),
        ("gaussians.opacity_logits", state["gaussians.opacity_logits"][0]),
        ("random.views", state["random.views"][:5]),
        ("order", state["order"] - 100),
        ("step", torch.tensor([1, 2])),
        ("step", torch.tensor(-2)),
        ("random.views", torch.zeros_like(state["random.views"])),
    ):
        assert name in state
        with pytest.raises(UserError, match="another dataset or recipe|is damaged"):
            Trainer(dataset, BUSY).load_state({**state, name: value})
    Trainer(dataset, BUSY).load_state(state)


def test_density_control_gets_the_absolute_gradients(dataset):
    """They are larger if the image has more than one tile; the step itself is the same."""
    trainers = []
    for config in (BUSY, BUSY_ABS_GRAD):
        trainer = Trainer(dataset, replace(config, coarse_to_fine=(0, 0)))
        trainer.step_once()
        trainers.append(trainer)
    signed, absolute = (
        trainer.part(Densification).control.state_tensors()["grad_sum"] for trainer in trainers
    )
    assert (absolute >= 0.999 * signed).all()
    assert absolute.sum() > 1.05 * signed.sum()
    assert_identical(*(trainer.gaussians for trainer in trainers))


def test_refinement_waits_for_the_next_step(dataset):
    """Step 20 densifies, but the scene that is evaluated and saved after it is not densified."""
    counts = []
    Trainer(dataset, BUSY).run(lambda progress: counts.append(progress.gaussians), until=21)
    assert counts[19] == counts[10]
    assert counts[20] > counts[19]


def test_every_step_is_followed_by_density_control(dataset, monkeypatch):
    trainer = Trainer(dataset, BUSY)
    after_step, steps = trainer.part(Densification).control.after_step, []

    def recorded(step, gaussians, optimizer):
        steps.append(step)
        return after_step(step, gaussians, optimizer)

    monkeypatch.setattr(trainer.part(Densification).control, "after_step", recorded)
    trainer.run(until=5)
    assert steps == [1, 2, 3, 4]


@pytest.mark.parametrize("config", [BUSY, BUSY_MCMC], ids=["adaptive", "mcmc"])
@pytest.mark.parametrize("cap", [25, 46])
def test_the_cap_is_never_exceeded(dataset, config, cap):
    counts = []
    capped = replace(config, density=replace(config.density, max_gaussians=cap))
    Trainer(dataset, capped).run(lambda progress: counts.append(progress.gaussians))
    assert max(counts) == cap
    assert counts[0] == min(cap, COUNT)


def test_a_dataset_without_points_starts_from_random_points(dataset):
    config = replace(CALM, initial_points=300)
    trainer = Trainer(replace(dataset, points=None), config)
    assert len(trainer.gaussians) == 300
    losses = [trainer.step_once() for _ in range(60)]
    assert sum(losses[-7:]) < 0.8 * sum(losses[:7])


def test_every_view_once_an_epoch(dataset, monkeypatch):
    trainer = Trainer(dataset, CALM)
    seen = [trainer.queue.take(0, 1)[0].camera.position for _ in range(1, 15)]
    positions = torch.stack(seen)
    for epoch in (positions[:7], positions[7:]):
        assert len(epoch.unique(dim=0)) == 7
    assert not torch.equal(positions[:7], positions[7:])


def test_photos_are_decoded_ahead_in_order_at_the_resolution_of_their_step(dataset, monkeypatch):
    """The order is extended before steps 1, 6 and 13; the resolution changes at 4 and 9."""
    trainer = Trainer(dataset, replace(CALM, coarse_to_fine=(3, 8)))
    prefetch, get = trainer.images.prefetch, trainer.images.get
    expected: list[tuple[View, int]] = []  # the photos that were announced and not yet requested
    calls = []

    def recorded_prefetch(order, downscale=None):
        expected[:] = [(view, downscale) for view in order]
        calls.append(step)
        prefetch(order, downscale)

    def recorded_get(view, downscale):
        assert expected.pop(0) == (view, downscale)
        return get(view, downscale)

    monkeypatch.setattr(trainer.images, "prefetch", recorded_prefetch)
    monkeypatch.setattr(trainer.images, "get", recorded_get)
    for step in range(1, 15):
        trainer.queue.take(step - 1, step)
    assert calls == [1, 4, 6, 9, 13]


def test_the_loss_of_a_step(dataset):
    """The image is rendered over the background and with the SH degree of the step."""
    alone = replace(dataset, train=dataset.train[:1])
    trainer = Trainer(alone, replace(CALM, background="white", ssim_weight=0.3))
    trainer.gaussians.sh_rest[:] = 0.2  # of degree 1 to 3, not in use before step 100
    [view], white = alone.train, torch.ones(3)
    image = render(trainer.gaussians, view.camera, white, sh_degree=0).image
    expected = view_loss(image, trainer.images.get(view), white, 0.3)
    assert trainer.step_once() == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.parametrize(("background", "color"), [("black", 0.0), ("white", 1.0), ("random", 0.0)])
def test_the_background_of_an_evaluation(dataset, background, color):
    trainer = Trainer(dataset, replace(CALM, background=background))
    expected = evaluate_views(trainer.gaussians, dataset.test, background=3 * (color,))
    assert trainer.evaluate() == expected


def test_a_fixed_background_is_put_behind_transparent_photos_once(dataset, tmp_path):
    """With a fixed background, a photo is stored as (H, W, 3) uint8; a random one needs alpha."""
    Image.new("RGBA", (WIDTH, HEIGHT), (200, 100, 0, 0)).save(tmp_path / "a.png")
    source = ImageSource(tmp_path / "a.png", WIDTH, HEIGHT)
    alone = replace(dataset, train=[replace(dataset.train[0], image=source)])
    photo = Trainer(alone, replace(CALM, background="white")).queue.take(0, 1)[0].photo
    assert photo.alpha is None
    assert (photo.rgb == 255).all()
    random = Trainer(alone, replace(CALM, background="random"))
    assert random.queue.take(0, 1)[0].photo.alpha is not None


def test_the_cap_by_the_size_of_the_photos_uses_their_median(dataset):
    views = [
        replace(view, camera=replace(view.camera, width=width))
        for view, width in zip(dataset.train, (70, 10, 40, 20, 60, 30, 50), strict=True)
    ]
    trainer = Trainer(replace(dataset, train=views), replace(CALM, gaussians_per_pixel=0.01))
    assert trainer.config.density.max_gaussians == 40 * HEIGHT // 100


def test_the_memory_for_images(dataset):
    assert Trainer(dataset, replace(CALM, image_memory=12345)).images.budget_bytes == 12345
    assert Trainer(dataset, CALM).images.budget_bytes > 1_000_000


def test_the_generators_of_a_seed(dataset):
    """If a generator changes, the same seed produces another scene."""
    seeds = {
        n: g.initial_seed() for n, g in Trainer(dataset, replace(CALM, seed=5)).generators.items()
    }
    assert seeds == {"start": 20, "views": 21, "background": 22, "density": 23}


def test_cameras_and_random_backgrounds_are_on_the_device(dataset, monkeypatch):
    devices = []
    to = Camera.to
    monkeypatch.setattr(
        Camera, "to", lambda self, device: devices.append(device) or to(self, device)
    )
    cpu = torch.device("cpu")
    Trainer(dataset, BUSY, device=cpu)
    assert devices == 7 * [cpu]
    background = Background("random", torch.Generator(), torch.device("meta"))
    assert background.draw().device.type == "meta"


def test_a_step_without_evaluation_reports_no_metrics():
    assert Progress(1, 0.5, 40, 60, 1).metrics is None


def test_reports_and_evaluations(dataset):
    reports: list[Progress] = []
    config = replace(BUSY, iterations=20, test_iterations=(5, 20))
    Trainer(dataset, config).run(reports.append)
    assert [report.step for report in reports] == list(range(1, 21))
    assert [report.step for report in reports if report.metrics is not None] == [5, 20]
    assert [report.downscale for report in reports] == [4, 4, 2, 2] + 16 * [1]
    assert all(math.isfinite(report.loss) for report in reports)


def test_ctrl_c_waits_for_the_end_of_the_step(dataset, monkeypatch):
    trainer = Trainer(dataset, BUSY)
    photometric_loss = ops.photometric_loss

    def interrupted(*args):
        if trainer.step == 12:  # within step 13
            os.kill(os.getpid(), signal.SIGINT)
        return photometric_loss(*args)

    monkeypatch.setattr(ops, "photometric_loss", interrupted)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert trainer.step == 13
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    trainer.run()  # continues as if there had been no interrupt
    monkeypatch.undo()
    assert_identical(trainer.gaussians, trained(dataset, BUSY))


def test_divergence_names_the_step(dataset):
    trainer = Trainer(dataset, CALM)
    trainer.run(until=3)
    assert trainer.within_step is False
    trainer.gaussians.sh_dc[:] = torch.inf
    with pytest.raises(UserError, match=r"^step 4, .*sh_dc \(40 rows\)"):
        trainer.run()
    assert trainer.step == 3
    assert trainer.within_step is True


def test_divergence_in_the_last_step_names_it(dataset):
    trainer = Trainer(dataset, CALM)
    assert trainer.within_step is False
    trainer.run(until=2)
    trainer.runner._nonfinite_rows[0] = 5  # what `adam_step` does
    with pytest.raises(UserError, match=r"^step 2: .*means \(5 rows\), skipped; use lower"):
        trainer.run(until=2)


def test_a_dataset_without_training_views(dataset):
    with pytest.raises(UserError, match="no training views"):
        Trainer(replace(dataset, train=[]), CALM)
