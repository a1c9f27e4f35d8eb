"""`Recorder`: writes the progress of a task to the state of its scene."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from snowsplat.data.points_ply import read_points
from snowsplat.pipeline.observer import Observer, Page
from snowsplat.pipeline.stage_lines import described
from snowsplat.project.project import Project
from snowsplat.project.studio_scene import StudioScene
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.geometry import shortest_rotation
from snowsplat.scene.orientation import scene_up
from snowsplat.sfm.progress import Report
from snowsplat.sfm.report.dataset_report import draw_from_above
from snowsplat.sfm.report.scene_map import PlacedPhoto, draw_scene
from snowsplat.studio.texts import in_languages
from snowsplat.training.core.trainer import Progress
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text
from snowsplat.util.messages import Message, message
from snowsplat.util.stages import Outcome

_PAUSE = 1.0  # seconds between two files of the state
_CURVE = 400  # points of the curve of the loss


class Recorder(Observer):
    """Writes the progress of a task to the state of its scene."""

    def __init__(self, scene: StudioScene, task: str = "make") -> None:
        self._scene, self._task = scene, task
        self._written = 0.0
        self._every = 1  # steps between two points of the curve
        self._drawn = False  # the map
        self.state: dict[str, Any] = {
            "started": time.time(),
            "stages": [],
            "notes": [],
            "curve": [],
        }
        self.write()

    def write(self, now: bool = True) -> None:
        """Write the state; unless ``now``, only if the last time is a moment ago."""
        if now or time.monotonic() - self._written > _PAUSE:
            with suppress(OSError):  # a full disk is for the job to tell
                self._scene.write_state(self.state, self._task)
            self._written = time.monotonic()

    def note(self, line: Message) -> None:
        self.state["notes"].append(in_languages(line))
        self.write()

    def begin(self, stage: str) -> Report:
        self.state["now"] = now = {"stage": stage, "began": time.time()}
        self.write()

        def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
            now.update({"done": done, "total": total, "what": in_languages(what), "left": left})
            self.write(now=False)

        return report

    def end(self, stage: str, outcome: Outcome) -> None:
        lines = [in_languages(line) for line in described(stage, outcome.result)]
        self.state["stages"].append(
            {"stage": stage, "lines": lines, "seconds": outcome.seconds, "again": outcome.again}
        )
        if stage == "images":
            self._draw_map(lambda made: draw_from_above(made.dataset.path))
        if stage == "poses":
            self.state.pop("placed", None)
        self.leave()

    def show_poses(self, photos: Sequence[PlacedPhoto], points: np.ndarray) -> None:
        self.state["placed"] = [photo.name for photo in photos]
        self._draw_map(lambda made: draw_level(photos, points))
        self.write()

    def leave(self) -> None:
        self.state.pop("now", None)
        self.write()

    def step(self, progress: Progress) -> None:
        if not self._drawn:  # the poses were given
            self._draw_map(lambda made: cameras_from_above(made.training_folder()))
        self.state["steps"] = {
            "step": progress.step,
            "iterations": progress.iterations,
            "gaussians": progress.gaussians,
            "left": progress.seconds_left,
        }
        if progress.metrics is not None:
            self.state["steps"]["psnr"] = progress.metrics.psnr
        curve = self.state["curve"]
        if progress.step % self._every == 0:
            curve.append([progress.step, progress.loss])
            if len(curve) > _CURVE:
                del curve[::2]
                self._every *= 2
        self.write(now=False)

    def page_opened(self, page: Page) -> None:
        self.state["page"] = page.url
        self.write()

    def steps_end(self) -> None:
        self.state.pop("page", None)
        self.write()

    def _draw_map(self, draw: Callable[[Project], str]) -> None:
        self._drawn = True
        try:
            write_text(self._scene.map, draw(Project.open(self._scene.made)))
        except (UserError, OSError) as error:  # the job goes on without it
            self.note(message("there is no map of the cameras: {error}", error=error))


def cameras_from_above(training: TrainingFolder) -> str:
    """An SVG drawing of the cameras and points of a training run, seen from above.

    It needs no points. Up is the up direction of the cameras, whatever that of the dataset is.

    Raises: UserError: the training has not begun; or its cameras or points are missing or damaged.
    """
    names, cameras = read_cameras(training.cameras)
    photos = [
        PlacedPhoto(
            name,
            None,
            camera.cam_from_world.numpy(),
            camera.width / 2 / camera.fx,
            camera.height / 2 / camera.fy,
        )
        for name, camera in zip(names, cameras, strict=True)
    ]
    if not training.points.is_file():
        return draw_level(photos, np.empty((0, 3)))
    return draw_level(photos, *read_points(training.points))


def draw_level(
    photos: Sequence[PlacedPhoto], xyz: np.ndarray, rgb: np.ndarray | None = None
) -> str:
    """An SVG drawing from above, where up is the up direction of the cameras.

    Args:
        photos: at least one; their frame may be any.
        xyz: (P, 3) points.
        rgb: (P, 3) uint8, their colours; None: grey.
    """
    up = scene_up(np.array([photo.cam_from_world[:, :3] for photo in photos]))
    above = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)  # of the drawing
    back = shortest_rotation(torch.from_numpy(up), above).numpy().T
    level = []
    for photo in photos:
        pose = photo.cam_from_world
        turned = np.column_stack([pose[:, :3] @ back, pose[:, 3]])
        level.append(replace(photo, cam_from_world=turned))
    colours = np.full(xyz.shape, 128, np.uint8) if rgb is None else rgb
    return draw_scene(level, xyz.astype(np.float64) @ back, colours)[0].svg
