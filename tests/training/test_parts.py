"""Parts, losses and rows that a user adds: their effect, and their place in checkpoints."""

from dataclasses import replace

import pytest
import torch

from snowsplat import Part, Trainer, load_dataset, ops, parts_of, recipe
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.render import render
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core import checkpoint
from snowsplat.training.parts.densification import Densification
from snowsplat.util.errors import UserError

SETTINGS = {"init": "points", "max_gaussians": 500, "densify_from": 5, "densify_interval": 5}
CONFIG = replace(recipe("default", iterations=40, **SETTINGS), coarse_to_fine=(0, 0))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    return load_dataset(write_toy_dataset(folder, "colmap-bin", 8, 48, 36, n_points=200))


def trainer_with(dataset, *parts, config=CONFIG, **arguments) -> Trainer:
    return Trainer(dataset, config, parts=[*parts_of(config), *parts], **arguments)


class Recorded(Part):
    """Writes down which method was called, and at which step."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def __getattribute__(self, name: str):
        value = super().__getattribute__(name)
        if name in vars(Part) and callable(value) and name not in ("state", "load", "row_state"):
            return lambda run, *rest: (self.calls.append((name, run.step)), value(run, *rest))[1]
        return value


def test_the_loop_calls_each_method_in_its_place(dataset):
    part = Recorded()
    trainer_with(dataset, part).run(until=2)
    once = ["background", "target", "image", "loss", "gradients"]
    assert part.calls[:3] == [("prepare", 0), ("points", 0), ("begin", 0)]
    step = [(name, 0) for name in [*once, "after_step"]]
    assert part.calls[3:] == [*step, ("between", 1), *((name, 1) for name, _ in step)]


def test_gradients_pass_through_the_list_backwards(dataset):
    """So a part at its end can change a gradient before density control sees it."""

    class OnlyRight(Part):
        def gradients(self, run, step, batch, gradients):
            for gradient in gradients:
                gradient.ignore(run.gaussians.means[:, 0] < 0.0)

    trainer = trainer_with(dataset, OnlyRight())
    before = trainer.gaussians.clone()
    trainer.run(until=3)
    grad_sum = trainer.part(Densification).control.grad_sum
    left = before.means[:, 0] < 0.0
    assert grad_sum[~left].any()
    assert not grad_sum[left].any()
    moved = (trainer.gaussians.means != before.means).any(1)
    assert moved[~left].any()
    assert not moved[left].any()


class Entropy(Part):
    def regularizer(self, run, gaussians):
        o = gaussians.opacities
        return -(o * o.log() + (1 - o) * (1 - o).log()).sum() / run.total


def test_a_regularizer_adds_its_gradient(dataset):
    seen = {}

    class Seen(Part):
        def gradients(self, run, step, batch, gradients):
            run.gaussians.opacity_logits.grad = torch.ones_like(run.gaussians.opacity_logits)

    trainer = trainer_with(dataset, Seen(), Entropy())
    logits = trainer.gaussians.opacity_logits.double()
    step = trainer.optimizer.step

    def recorded(gaussians, gradients, number):
        seen["grad"] = gaussians.opacity_logits.grad.clone()
        step(gaussians, gradients, number)

    trainer.optimizer.step = recorded
    trainer.step_once()
    o = logits.sigmoid()
    expected = 1.0 - logits * o * (1 - o) / len(logits)  # d/dx of the entropy of σ(x) is −x σ'(x)
    torch.testing.assert_close(seen["grad"].double(), expected, rtol=1e-5, atol=1e-7)
    assert trainer.gaussians.opacity_logits.grad is None


class Depth(Part):
    with_depth = True

    def loss(self, run, view, rendered):
        return 0.3 * rendered.depth.mean() + 0.1 * rendered.alpha.square().mean()


def test_a_term_of_the_loss_is_added_to_it(dataset):
    alone = replace(dataset, train=dataset.train[:1])
    [view] = alone.train
    usual, more = trainer_with(alone), trainer_with(alone, Depth())
    scene = usual.gaussians.clone()
    out = render(scene, view.camera, torch.zeros(3), 0, with_depth=True)
    term = 0.3 * out.depth.mean() + 0.1 * out.alpha.square().mean()
    assert more.step_once() == pytest.approx(usual.step_once() + float(term), rel=1e-6)
    assert not torch.equal(more.gaussians.means, usual.gaussians.means)


def test_the_gradient_of_the_depth_reaches_the_means(dataset):
    """The optimiser gets the gradient of the rasterizer in float64."""
    alone = replace(dataset, train=dataset.train[:1])
    seen = {}

    class OnlyDepth(Depth):
        def gradients(self, run, step, batch, gradients):
            [gradient] = gradients
            seen["packed"] = gradient.packed_grad.clone()
            seen["values"] = gradient.splats.packed.detach().clone()

    config = replace(CONFIG, ssim_weight=0.0)
    zero = lambda image, photo, background: 0.0 * image.sum()  # noqa: E731
    trainer_with(alone, OnlyDepth(), config=config, loss=zero).step_once()
    assert float(seen["packed"].abs().max()) > 0.0

    camera = alone.train[0].camera
    packed = seen["values"].double().requires_grad_()
    _, alpha, depth = ops.rasterize(
        Splats2D(packed, None, 3),
        camera.width,
        camera.height,
        torch.zeros(3).double(),
        with_depth=True,
    )
    (0.3 * depth.mean() + 0.1 * alpha.square().mean()).backward()
    expected = packed.grad.float()
    assert float(expected[:, 6].abs().max()) > 0.0
    scale = expected.abs().amax(0).clamp_min(1e-12)
    torch.testing.assert_close(seen["packed"] / scale, expected / scale, rtol=1e-3, atol=1e-3)


class Marked(Part):
    """Marks the first Gaussians, and remembers where they are."""

    def begin(self, run):
        run.rows["mark"] = torch.arange(1, len(run.gaussians) + 1)
        self.colors = run.gaussians.sh_dc.clone()

    def gradients(self, run, step, batch, gradients):
        for gradient in gradients:
            gradient.packed_grad[:, 8:] = 0.0  # colours do not change


def test_rows_follow_density_control(dataset):
    part = Marked()
    trainer = trainer_with(dataset, part)
    trainer.run(until=31)
    marks = trainer.rows["mark"]
    assert len(marks) == len(trainer.gaussians) != len(part.colors)
    old = marks > 0
    assert 0 < int(old.sum()) < len(marks)  # some are new
    assert not torch.equal(marks[old], marks[old].sort().values)  # and the order has changed
    assert torch.equal(trainer.gaussians.sh_dc[old], part.colors[marks[old] - 1])


class Counted(Part):
    def __init__(self) -> None:
        self.steps = 0

    def after_step(self, run, step, batch):
        self.steps += 1

    def state(self):
        return {"steps": torch.tensor(self.steps)}

    def load(self, tensors):
        self.steps = int(tensors["steps"])


def test_a_misspelt_method_is_reported(caplog):
    type("Mine", (Part,), {"regulariser": print, "helper": print})
    assert caplog.messages == ["a training calls regularizer, not Mine.regulariser"]


class Renamed(Part):
    """Has the name of a part of the package."""

    name = "decay"


class Rows(Part):
    """Keeps rows by itself, for as long as no Gaussian is added or removed."""

    def begin(self, run):
        self.seen = torch.zeros(len(run.gaussians))

    def after_step(self, run, step, batch):
        self.seen += 1.0

    def row_state(self):
        return {"seen": self.seen}

    def load(self, tensors):
        self.seen = tensors["seen"].clone()


def test_rows_of_a_part_are_loaded_again(dataset):
    calm = replace(CONFIG, density=replace(CONFIG.density, densify_from=1000))
    first = trainer_with(dataset, Rows(), config=calm)
    first.run(until=7)
    second = trainer_with(dataset, Rows(), config=calm, state=first.state_tensors())
    assert torch.equal(second.part(Rows).seen, torch.full((len(second.gaussians),), 7.0))


def test_a_state_that_cannot_be_loaded_names_its_part(dataset):
    state = trainer_with(dataset, Counted()).state_tensors()
    del state["Counted.steps"]
    with pytest.raises(UserError, match="the state of the part 'Counted' cannot be loaded"):
        trainer_with(dataset, Counted(), state=state)


@pytest.mark.parametrize("name", ["rows", "gaussians", "a.b", ""])
def test_reserved_names_are_rejected(dataset, name):
    part = Counted()
    part.name = name
    with pytest.raises(UserError, match="cannot have the name"):
        trainer_with(dataset, part)


def test_a_regularizer_acts_on_gaussians_that_no_view_shows(dataset):
    class Larger(Part):
        def regularizer(self, run, gaussians):
            return None if run.step == 0 else -gaussians.log_scales.sum()

    assert CONFIG.visible_only
    trainer = trainer_with(dataset, Larger())
    trainer.run(until=1)
    before = trainer.gaussians.log_scales.clone()
    trainer.run(until=2)
    assert (trainer.gaussians.log_scales != before).all()


def test_a_regularizer_may_be_constant(dataset):
    class Zero(Part):
        def regularizer(self, run, gaussians):
            return torch.zeros(())

    trainer_with(dataset, Zero()).run(until=2)


def test_mcmc_adds_its_gradient_to_that_of_a_part(dataset):
    class Seven(Part):
        def gradients(self, run, step, batch, gradients):
            run.gaussians.opacity_logits.grad = torch.full_like(run.gaussians.opacity_logits, 7.0)

    config = recipe("mcmc-short", iterations=40, max_gaussians=500)
    trainer = trainer_with(dataset, Seven(), config=config)
    seen = []
    step = trainer.optimizer.step
    trainer.optimizer.step = lambda gaussians, *rest: (
        seen.append(gaussians.opacity_logits.grad.clone()),
        step(gaussians, *rest),
    )
    trainer.step_once()
    assert (seen[0] > 7.0).all()


def charbonnier(image, photo, background):
    return ((image - photo.over(background)).square() + 1e-4).sqrt().mean()


def test_a_resumed_run_with_parts_and_a_loss_has_the_same_bits(dataset, tmp_path):
    def begun(**arguments) -> Trainer:
        return trainer_with(
            dataset, Counted(), Marked(), Entropy(), Depth(), loss=charbonnier, **arguments
        )

    whole, first = begun(), begun()
    whole.run()
    first.run(until=23)
    path = checkpoint.save(tmp_path, 23, first.state_tensors(), {})
    second = begun(state=checkpoint.load(path).tensors)
    assert second.part(Counted).steps == 23
    second.run()
    state = whole.state_tensors()
    assert int(state["Counted.steps"]) == 40
    for name, tensor in second.state_tensors().items():
        assert torch.equal(tensor, state[name]), name


@pytest.mark.parametrize(
    ("saved", "resumed", "message"),
    [
        ({"parts": [Entropy]}, {}, "made with the part 'Entropy'"),
        ({"parts": [Counted]}, {"parts": [Entropy]}, "made with the part 'Counted'"),
        ({"loss": charbonnier}, {}, "made with the loss 'charbonnier'"),
        ({}, {"parts": [Entropy]}, "made without the part 'Entropy'"),
        ({}, {"loss": charbonnier}, "made without the loss 'charbonnier'"),
        ({"left": "decay"}, {}, "made without the part 'decay'; leave it out again"),
        ({}, {"left": "decay"}, "made with the part 'decay' of the package"),
        ({"left": "decay", "parts": [Renamed]}, {}, "made with the part 'decay'"),
    ],
)
def test_what_is_missing_is_named(dataset, saved, resumed, message):
    def begun(parts=(), loss=None, left="", **state) -> Trainer:
        usual = [part for part in parts_of(CONFIG) if part.name != left]
        parts = [*usual, *(part() for part in parts)]
        return Trainer(dataset, CONFIG, parts=parts, loss=loss, **state)

    state = begun(**saved).state_tensors()
    with pytest.raises(UserError, match=message) as error:
        begun(**resumed, state=state)
    assert "\n" not in str(error.value)


def test_two_parts_of_one_name_are_rejected(dataset):
    with pytest.raises(UserError, match="two parts have the name 'Counted'"):
        trainer_with(dataset, Counted(), Counted())


def test_a_part_of_the_package_can_be_replaced_and_left_out(dataset):
    class Fixed(Part):
        name = "density"

    others = [part for part in parts_of(CONFIG) if part.name != "density"]
    trainer = Trainer(dataset, CONFIG, parts=[*others, Fixed()])
    count = len(trainer.gaussians)
    trainer.run()
    assert len(trainer.gaussians) == count


def test_parts_of_names_each_option():
    everything = replace(
        recipe("default"),
        exposure="on",
        leave_out_after=0.1,
        refine_poses=True,
        depth_weight=0.1,
        surfaces=True,
    )
    assert [part.name for part in parts_of(everything)] == [
        "unexplained", "poses", "exposure", "transients", "depth", "normals",
        "near_limit", "sky", "density", "decay", "scale_limit", "smoothing", "surfaces",
    ]  # fmt: skip
    assert [part.name for part in parts_of(recipe("paper"))] == [
        "pose_check", "density", "decay",
    ]  # fmt: skip
