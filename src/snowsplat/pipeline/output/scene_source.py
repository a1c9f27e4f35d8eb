"""Loads a scene and its cameras from the output folder of a training run, or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from snowsplat.data import Dataset
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.output.edit_record import EditRecord, Note, read_record
from snowsplat.pipeline.output.output_folder import DatasetSettings, OutputFolder
from snowsplat.pipeline.output.scene_paths import (
    existing_folder,
    file_of_make,
    folder_around,
    index_in,
    training_folder,
)
from snowsplat.pipeline.run.refined_cameras import with_refined
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, rotation_from_quat
from snowsplat.scene.initial_view import InitialView
from snowsplat.scene.origin import Origin
from snowsplat.util.errors import UserError
from snowsplat.viewer.web.scene import ReadyScene, ready, viewing_frame
from snowsplat.viewer.web.viewer_page import Annotation

Color = tuple[float, float, float]


@dataclass(frozen=True)
class TrainedScene:
    """A scene in the output folder of its training, with its dataset.

    Attributes:
        iteration: the step after which it was saved; 0 for a file.
        gaussians: on the device that was requested, with the origin of the dataset.
        dataset: its photos and cameras, split as in the training.
        background: red, green, blue in 0..1.
    """

    folder: OutputFolder
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
    file = index_in(Path(output)) or Path(output)
    if file.is_file():
        if dataset is None:
            raise UserError(
                "{file}: a scene file does not name its photos; set `dataset`", file=file
            )
        settings = DatasetSettings(str(dataset), resolution=resolution or -1, hold_out=8)
        folder, background = OutputFolder(file.with_name(f"{file.stem}_views")), (0.0, 0.0, 0.0)
        data, found, gaussians = settings.load(), 0, read_gaussians(file)
    else:
        folder = existing_folder(Path(output))
        data, background = load_dataset_of(folder, dataset, resolution)
        found, gaussians = folder.read_scene(iteration)
    gaussians = seen_from_dataset(gaussians, data.origin).to((compute or Compute()).apply())
    return TrainedScene(folder, found, gaussians, data, background)


def load_dataset_of(
    folder: OutputFolder, dataset: Path | str | None = None, resolution: int | None = None
) -> tuple[Dataset, Color]:
    """The dataset of the training in ``folder``, and its background colour; see `load_trained`.

    If the training has refined the cameras, the dataset has the refined cameras.
    """
    settings, background = folder.settings()
    if dataset is not None:
        settings = replace(settings, path=str(dataset))
    if resolution is not None:
        settings = replace(settings, resolution=resolution)
    return with_refined(folder.path, settings.load()), background


def cameras_of(folder: OutputFolder) -> list[Camera]:
    """The cameras of the photos of the training in ``folder``; empty if they are not stored.
    Raises: UserError: the file is damaged.
    """
    file = folder.path / "cameras.json"
    return read_cameras(file)[1] if file.is_file() else []


def seen_by_cameras(gaussians: Gaussians, folder: OutputFolder) -> Gaussians:
    """The scene relative to the origin of the cameras of the training in ``folder``."""
    return seen_from_dataset(gaussians, folder.origin())


def background_of(folder: OutputFolder) -> Color:
    """The background colour of the training in ``folder``; black if it is not stored."""
    return folder.settings()[1] if folder.is_output_folder() else (0.0, 0.0, 0.0)


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

    def ready(self) -> ReadyScene:
        """The scene for a page."""
        notes = [Annotation(note.title, note.text, view) for note, view in self.notes]
        what = self.gaussians, self.cameras, self.background, self.start, notes
        return ready(*what, turn=not self.turned)

    def frame(self) -> Similarity:
        """The transform to the frame of its page."""
        change, _ = viewing_frame(self.gaussians, self.cameras, turn=not self.turned)
        return change or Similarity.identity()


def load_viewable(path: Path | str, iteration: int | None = None) -> ViewableScene:
    """Load a scene file of any format, levels of detail, or a scene of an output folder.

    ``iteration``: an iteration of an output folder; default: the last one.

    Raises:
        UserError: the scene is missing or damaged, or ``iteration`` is set and ``path`` is a file.
    """
    path = Path(path)
    if not path.exists():
        raise UserError("{path}: no such file or folder", path=path)
    path = index_in(path) or path
    if iteration is None and path.is_dir():
        path = file_of_make(path) or path
    if path.is_dir():
        folder = training_folder(path)
        found, gaussians = folder.read_scene(iteration)
        file = folder.scene_path(found)
    else:
        if iteration is not None:
            raise UserError("`iteration` selects a scene of an output folder; leave it out")
        file, gaussians = path, read_gaussians(path)
        return viewable(file, gaussians)
    gaussians = seen_by_cameras(gaussians, folder)
    return ViewableScene(file, gaussians, cameras_of(folder), background_of(folder))


def viewable(file: Path, gaussians: Gaussians) -> ViewableScene:
    """The scene of a file, with the cameras and the background of its training if it is known.

    An edited scene has the cameras of the other scene, at its scale, turned with it.
    """
    record = read_record(file)
    if record is None:
        folder = folder_around(file)
        gaussians = seen_by_cameras(gaussians, folder)
        return ViewableScene(file, gaussians, cameras_of(folder), background_of(folder))
    folder = folder_around(file.with_name(Path(record.scene).name))
    origin = folder.origin()
    change = change_of(record)
    gaussians = seen_from_dataset(gaussians, origin and moved_origin(origin, change))
    cameras = [camera.transformed(change) for camera in cameras_of(folder)]
    start = None if record.start is None else _view(record.start)
    notes = [(note, _view(note.view)) for note in record.notes]
    turned = record.turn is not None
    return ViewableScene(file, gaussians, cameras, background_of(folder), start, notes, turned)


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
