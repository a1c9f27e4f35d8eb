"""Loads a scene and its cameras from the output folder of a training run, or from a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from snowsplat.data import Dataset, read_dataset
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.run.training_files import with_refined
from snowsplat.project.edit_record import EditRecord, Note
from snowsplat.project.project import Project
from snowsplat.project.training_folder import Color, DatasetSettings, TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, rotation_from_quat
from snowsplat.scene.initial_view import InitialView
from snowsplat.scene.origin import Origin
from snowsplat.util.errors import UserError
from snowsplat.viewer.web.scene import ReadyScene, ready, viewing_frame
from snowsplat.viewer.web.viewer_settings import Annotation


@dataclass(frozen=True)
class TrainedScene:
    """A scene in the output folder of its training, with its dataset.

    Attributes:
        iteration: the step after which it was saved; 0 for a file.
        gaussians: on the device that was requested, with the origin of the dataset.
        dataset: its photos and cameras, split as in the training.
        background: red, green, blue in 0..1.
    """

    folder: TrainingFolder
    iteration: int
    gaussians: Gaussians
    dataset: Dataset
    background: Color


def load_trained(
    output: Path | str,
    *,
    iteration: int | None = None,
    dataset: Path | str | None = None,
    resolution: int | None = None,
    compute: Compute | None = None,
) -> TrainedScene:
    """Load a scene from the output folder of `train`, `make` or the reference implementation.

    A scene file of any program, or the result folder of gsplat, is loaded if ``dataset`` is given.
    Its world must be that of the dataset. The test split of the dataset, or every 8th photo, is
    held out, the background is black, and results are written to the folder NAME_views beside it.

    Args:
        iteration: the iteration to load; default: the last one.
        dataset: the folder of the dataset, if it was moved after the training.
        resolution: see `TrainOptions`; default: as trained.
        compute: the device for the Gaussians; default: a GPU if there is one.

    Raises:
        UserError: scene, settings or dataset are missing or damaged; an unusable device.
    """
    project = Project.open(output)
    if project.is_file:
        file = project.scene_file()
        if dataset is None:
            raise UserError(
                "{file}: a scene file does not name its photos; set `dataset`", file=file
            )
        settings = DatasetSettings(str(dataset), resolution=resolution or -1, hold_out=8)
        folder, background = TrainingFolder(file.with_name(f"{file.stem}_views")), (0.0, 0.0, 0.0)
        data, found = read_dataset(settings), 0
    else:
        folder = project.training_folder()
        data, background = load_dataset_of(folder, dataset, resolution)
        found, file = folder.find_scene(iteration)
    gaussians = seen_from_dataset(read_gaussians(file), data.origin)
    gaussians = gaussians.to((compute or Compute()).apply())
    return TrainedScene(folder, found, gaussians, data, background)


def load_dataset_of(
    folder: TrainingFolder, dataset: Path | str | None = None, resolution: int | None = None
) -> tuple[Dataset, Color]:
    """The dataset of the training in ``folder``, and its background colour; see `load_trained`.

    If the training has refined the cameras, the dataset has the refined cameras.
    """
    settings, background = folder.settings()
    if dataset is not None:
        settings = replace(settings, path=str(dataset))
    if resolution is not None:
        settings = replace(settings, resolution=resolution)
    return with_refined(folder, read_dataset(settings)), background


def photos_of(training: TrainingFolder | None, dataset: Path) -> tuple[Dataset, str]:
    """The photos for `pipeline.decimate.refine`, and the colour behind them.

    If the training of the scene is known, the photos have the size of its training, those that it
    held out are held out, and the cameras are those that it has refined.
    Raises: UserError: ``dataset`` is not a dataset.
    """
    settings = DatasetSettings(str(dataset.absolute()))
    if training is None or not training.scenes():
        return read_dataset(settings), "black"
    trained, color = training.settings()
    photos = read_dataset(replace(trained, path=settings.path))
    return with_refined(training, photos), "white" if min(color) == 1.0 else "black"


def cameras_of(training: TrainingFolder | None) -> tuple[list[str], list[Camera]]:
    """Names and cameras of the photos of a training; empty if they are not stored.
    Raises: UserError: the file is damaged.
    """
    known = training is not None and training.cameras.is_file()
    return read_cameras(training.cameras) if training and known else ([], [])


@dataclass(frozen=True)
class ViewableScene:
    """A scene for a viewer, from a file or an output folder; its photos are not needed."""

    file: Path  # the scene file
    gaussians: Gaussians
    cameras: list[Camera]  # the cameras of its photos; empty if unknown
    background: Color
    start: InitialView | None = None  # the initial view; None: not chosen
    notes: Sequence[tuple[Note, InitialView]] = ()  # annotations, and the views that show them
    turned: bool = False  # a person has turned it upright: −y is up

    def ready(self, *, walk: bool = False) -> ReadyScene:
        """The scene for a page. ``walk``, and what is raised: see `viewer.web.scene.ready`."""
        notes = [Annotation(note.title, note.text, view) for note, view in self.notes]
        what = self.gaussians, self.cameras, self.background, self.start, notes
        return ready(*what, turn=not self.turned, walk=walk)

    def frame(self) -> Similarity:
        """The transform to the frame of its page."""
        change, _ = viewing_frame(self.gaussians, self.cameras, turn=not self.turned)
        return change or Similarity.identity()


def load_viewable(scene: Project | Path | str, iteration: int | None = None) -> ViewableScene:
    """Load a scene file of any format, levels of detail, or a scene of an output folder.

    ``iteration``: an iteration of an output folder; default: the last one.

    Raises:
        UserError: the scene is missing or damaged, or ``iteration`` is set and ``scene`` is a file.
    """
    project = scene if isinstance(scene, Project) else Project.open(scene, iteration)
    return viewable(project, read_gaussians(project.scene_file()))


def viewable(project: Project, gaussians: Gaussians) -> ViewableScene:
    """``gaussians``, read from the scene file of a project, with the cameras and the background of
    its training if it is known.

    An edited scene has the cameras of the other scene, at its scale, turned with it.
    """
    training, edit = project.original.training, project.edit
    cameras, background = cameras_of(training)[1], (0.0, 0.0, 0.0)
    origin = None
    if training is not None:
        origin, background = training.origin(), training.background()
    if edit is None:
        gaussians = seen_from_dataset(gaussians, origin)
        return ViewableScene(project.scene_file(), gaussians, cameras, background)
    change = change_of(edit)
    gaussians = seen_from_dataset(gaussians, origin and moved_origin(origin, change))
    return ViewableScene(
        project.scene_file(),
        gaussians,
        [camera.transformed(change) for camera in cameras],
        background,
        None if edit.start is None else _view(edit.start),
        [(note, _view(note.view)) for note in edit.notes],
        turned=edit.turn is not None,
    )


def change_of(record: EditRecord) -> Similarity:
    """The transform from the world of the scene that was edited to that of the edited scene."""
    same = Similarity.identity()
    if record.turn is None:
        return replace(same, scale=record.scale)
    quat = torch.tensor(record.turn, dtype=torch.float64)
    return replace(same, scale=record.scale, rotation=rotation_from_quat(quat))


def moved_origin(origin: Origin, change: Similarity) -> Origin:
    """The place of an origin in the new world of ``change``."""
    x, y, z = change.apply(torch.tensor(origin, dtype=torch.float64)).tolist()
    return x, y, z


def _view(numbers: Sequence[float]) -> InitialView:
    x, y, z, u, v, w, fov, aspect = numbers
    return InitialView((x, y, z), (u, v, w), fov, aspect)
