"""`refine_photo`: a lifted photo of a dataset, trained further on all photos of the dataset."""

import time
from dataclasses import replace
from pathlib import Path

from snowsplat.data import Dataset, ImageLoader, Points, View, read_dataset
from snowsplat.data.maps.depth_alignment import align
from snowsplat.extras.lift.lift import lift
from snowsplat.extras.lift.lift_photo import LiftResult, finish, read_depth
from snowsplat.extras.lift.options import DepthSource, LiftOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.run.training_files import write_beginning
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import with_sh_degree
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.errors import UserError

# Share of the largest number of Gaussians that the lifted photo may use. Densification needs the
# others for what the photo does not show.
_LIFTED_SHARE = 0.5


def refine_photo(
    photo: Path | str,
    output: Path | str,
    depth: DepthSource,
    dataset: Path | str,
    options: LiftOptions | None = None,
    *,
    iterations: int = 1000,
    hold_out: int | None = None,
    swing: bool = False,
    threads: int | None = None,
    overwrite: bool = False,
    observer: Observer = SILENT,
) -> LiftResult:
    """Lift a photo of a dataset, and train the scene on all photos of the dataset.

    Image, camera and pose are those of the dataset. The depth is aligned to the points of the
    dataset: its scale, and for a disparity also its shift. The training starts with the lifted
    photo, and with those points that the photo does not show. It uses the recipe `default`.

    Args:
        photo: the path or the name of a photo of the dataset.
        dataset: a dataset with points, see `snowsplat.data.load_dataset`.
        iterations: number of training steps.
        hold_out: hold out every ``hold_out``-th photo for testing; default: none.

    Raises:
        UserError: see `lift_photo`; the dataset has no points, or the photo is not one of its
            training photos; the depth map contradicts the points.
        KeyboardInterrupt: Ctrl-C; the folder then contains the scene after 0 steps.
    """
    options, started = options or LiftOptions(), time.monotonic()
    out = TrainingFolder(Path(output))
    out.check_free(resume=False, overwrite=overwrite)
    settings = DatasetSettings(str(Path(dataset).absolute()), hold_out=hold_out)
    posed = read_dataset(settings)
    view = _view_of(posed, Path(photo))
    if posed.points is None:
        raise UserError(
            "{dataset}: has no points, which the depth is aligned to; use lift alone",
            dataset=dataset,
        )
    sizes = sorted(view.camera.width * view.camera.height for view in posed.train)
    config = recipe("default", iterations=iterations, init="points")
    config = config.capped(sizes[len(sizes) // 2], len(sizes))  # as in the training
    Compute("cpu", threads).apply()
    with ImageLoader([view], background=(1.0, 1.0, 1.0)) as loader:
        pixels = loader.get(view).rgb.float().div(255).contiguous()
    z = read_depth(depth, pixels, view.camera, options.edge)
    alignment = align(z, posed.points.xyz, view.camera, with_shift=depth.values_are == "disparity")
    z = alignment.apply(z)
    limit = round(_LIFTED_SHARE * config.density.max_gaussians)
    options = replace(options, max_gaussians=min(options.max_gaussians or limit, limit))
    lifted = replace(lift(pixels, z, view.camera, options), origin=posed.origin)
    out.remove_results()
    write_beginning(out, posed, settings, config)
    what = pixels, z, view.camera, "of the dataset"
    finish(out, 0, lifted, *what, swing=False, started=started)
    seconds = time.monotonic() - started
    initial = _with_unseen_points(lifted, posed.points, view.camera, config.initial_opacity)
    trainer = Trainer(posed, config, initial=with_sh_degree(initial, config.sh_degree))
    with observer.stepping(0, trainer.schedule.iterations):
        trainer.run(observer.step)
    result = finish(out, trainer.step, trainer.gaussians, *what, swing=swing, started=started)
    evaluation = trainer.evaluate() if posed.test else None
    if evaluation is not None:
        out.write_metrics(trainer.step, "test", evaluation.as_json())
    return replace(result, seconds=seconds, alignment=alignment, evaluation=evaluation)


def _view_of(dataset: Dataset, photo: Path) -> View:
    """The training view of a photo: of the same file or, if there is none, of the same name."""
    if photo.is_file():
        for view in dataset.train:
            if view.image.path.samefile(photo):
                return view
    named = [view for view in dataset.train if Path(view.name).name == photo.name]
    if len(named) == 1:
        return named[0]
    held_out = any(Path(view.name).name == photo.name for view in dataset.test)
    problem = "is held out for testing" if held_out else "is not a photo of the dataset"
    names = ", ".join(view.name for view in dataset.train[:3])
    raise UserError(
        "{photo}: {problem}; use one of its training photos, for example {names}",
        photo=photo,
        problem=problem,
        names=names,
    )


def _with_unseen_points(
    lifted: Gaussians, points: Points, camera: Camera, opacity: float
) -> Gaussians:
    """The Gaussians, and one for each point that is outside of the image of the camera."""
    unseen = ~camera.sees(points.xyz.double())[1]
    if not bool(unseen.any()):
        return lifted
    others = Gaussians.from_points(
        Points(points.xyz[unseen], points.rgb[unseen]), sh_degree=0, initial_opacity=opacity
    )
    return lifted.append(replace(others, origin=lifted.origin))
