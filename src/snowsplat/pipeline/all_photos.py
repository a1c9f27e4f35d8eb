"""The last part of `make`: after the evaluation, the scene is trained on the held-out photos, too.

It continues the training for a moment with fixed Gaussians, at the learning rates of its end and
somewhat above. The metrics remain those of the scene before: afterwards, no photo can judge it. See
docs/what-was-tried.md.
"""

import math
from dataclasses import replace
from functools import partial

import torch

from snowsplat.data import ImageLoader
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.output.scene_source import TrainedScene, load_trained
from snowsplat.pipeline.run.results import LastPart
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.training.budgets.pace import Pace
from snowsplat.training.budgets.step_cost import Work
from snowsplat.training.core.history import History
from snowsplat.training.core.trainer import Progress, Trainer
from snowsplat.training.parts.exposure import Exposure
from snowsplat.training.parts.list import all_parts_of
from snowsplat.training.parts.transients import KnownTransients
from snowsplat.training.parts.unexplained import unexplained_views
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.rates import DecayRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.settings.stored import config_from_json
from snowsplat.util.messages import message

#: The steps, relative to those of the training.
SHARE = 0.12
#: The fewest steps for each photo.
_LOOKS = 2
# The learning rates decrease from so many times those of the end of the training to these.
_FASTER = 6.0
# The speed of the last so many stretches of the history is that of the last part.
_LAST_STRETCHES = 10


def train_on_all(
    folder: TrainingFolder, iteration: int, seconds: float, compute: Compute, observer: Observer
) -> tuple[LastPart, Gaussians | None]:
    """Continue a finished training with all photos; writes nothing.

    Photos that the training has left out remain so, and so do held-out photos that the scene does
    not explain. If something moves in the photos, it is masked in all of them. There is no last
    part if there are fewer than `_LOOKS` steps for each photo: with many photos, or little time,
    the last part would change little.

    Returns: what was done, and the scene; None if there was no last part.

    Args:
        iteration: of the scene to begin with.
        seconds: the time that is left; infinite if there is no limit.

    Raises: UserError: scene, settings, dataset or a photo are missing or damaged.
    """
    scene = load_trained(folder.path, iteration=iteration, compute=compute)
    left_out = {each.photo for each in folder.left_out()}
    used = [view for view in scene.dataset.train if view.name not in left_out]
    views = [*used, *scene.dataset.test]
    steps = round(SHARE * iteration)
    if math.isfinite(seconds):
        last = History.read(folder.history, iteration).stretches[-_LAST_STRETCHES:]
        mean = sum(each.seconds for each in last) / max(1, sum(each.steps for each in last))
        steps = min(steps, int(seconds / mean)) if mean > 0 else 0
    if steps < _LOOKS * len(views):
        return LastPart(why_not=message("it would use each photo less than twice")), None
    background = torch.tensor(scene.background, device=scene.gaussians.means.device)
    with ImageLoader(views, device=background.device) as images:
        wrong = unexplained_views(
            scene.gaussians,
            views,
            images,
            background=background,
            sh_degree=scene.gaussians.sh_degree,
            render=partial(render, with_depth=True),
        )
    views = [view for i, view in enumerate(views) if i < len(used) or i not in wrong]
    exposures = folder.exposures()
    config = config_from_json(folder.training_settings())
    config = _last_config(config, scene, steps, exposures=bool(exposures))
    trainer = Trainer(
        replace(scene.dataset, train=views, test=[]),
        config,
        device=background.device,
        initial=scene.gaussians.clone(),
        parts=[*all_parts_of(config), *([KnownTransients()] if folder.masks.is_dir() else [])],
    )
    exposure = trainer.part(Exposure)
    if exposure is not None:
        exposure.continue_with(torch.tensor([exposures[view.name] for view in used]))
    pace = Pace(Work.for_training(config, trainer.dataset))

    def on_step(progress: Progress) -> None:
        pace.after_step(trainer.schedule, progress.step, 1, progress.gaussians)
        observer.step(replace(progress, seconds_left=pace.seconds_left))

    with observer.stepping(0, steps):
        trainer.run(on_step)
    photos = len(scene.dataset.train) + len(scene.dataset.test)
    return LastPart(steps, len(views), photos - len(views)), trainer.gaussians.detach()


def _last_config(
    config: TrainConfig, scene: TrainedScene, last: int, *, exposures: bool
) -> TrainConfig:
    """The configuration of the training, changed for ``last`` more steps.

    ``exposures``: whether gains of exposure are learnt.
    """
    iteration, extent, views = scene.iteration, scene.dataset.extent, len(scene.dataset.train)
    ends = config.learning_rates.at(iteration, Schedule(iteration), extent, views)
    ends["means"] /= extent
    rates = replace(
        config.learning_rates,
        **{name: _FASTER * rate for name, rate in ends.items()},
        means_final=ends["means"],
        means_steps=1.0,
        sh_rest_passes=0.0,
        anneal=1.0 / _FASTER,
        anneal_from=0.0,
    )
    return replace(
        config,
        iterations=last,
        learning_rates=rates,
        density=replace(
            config.density, densify_until=0, max_gaussians=max(1, len(scene.gaussians))
        ),
        gaussians_per_pixel=0.0,
        decay=DecayRates(),
        exposure="on" if exposures else "off",
        sh_interval=0,
        coarse_to_fine=(0, 0),
        test_iterations=(),
        leave_out_after=0,
        transients="off",
        sky=False,
    )
