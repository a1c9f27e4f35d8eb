"""`film`: a video through the views that were chosen in the page of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from snowsplat import trajectory
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.video import VideoOptions
from snowsplat.pipeline.output.scene_source import change_of, load_viewable
from snowsplat.pipeline.videos import render_video
from snowsplat.project.page_film import PageFilm
from snowsplat.project.project import Project
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import entries_of
from snowsplat.scene.geometry import Similarity
from snowsplat.util.files import write_json
from snowsplat.viewer.web.panel import view_numbers, view_of_page

_PREVIEW = 10.0  # cameras per second
_MOST = 600  # cameras of a preview


def film(
    scene: Path | str,
    plan: PageFilm,
    keys: Path | str,
    target: Path | str,
    *,
    compute: Compute | None = None,
    observer: Observer = SILENT,
) -> Path:
    """Render a film; the same as `render_video` with the path ``keys``.

    Args:
        scene: a scene file.
        plan: its keys are in the frame of the page of the scene.
        keys: the camera list (JSON) that is written first: the keys in the world of the scene.
        target: the .mp4 file.
        observer: gets the stage "video".

    Raises:
        UserError: the scene is missing or damaged, or all keys are the same.
        KeyboardInterrupt: Ctrl-C; an earlier film is kept.
    """
    write_keys(scene, plan, keys)
    options = VideoOptions(path=str(keys), seconds=plan.seconds, size=plan.size, ease=plan.ease)
    (file,) = render_video(scene, options, target=target, compute=compute, observer=observer)
    return file


def write_keys(scene: Path | str, plan: PageFilm, keys: Path | str) -> None:
    """Write the keys of a film as a camera list in the world of the scene; see `film`."""
    cameras, speeds, _, _ = _keys(Path(scene), plan)
    entries = entries_of((str(i), camera) for i, camera in enumerate(cameras))
    for entry, speed in zip(entries, speeds, strict=True):
        entry["speed"] = speed
    write_json(Path(keys), entries)


def page_frames(scene: Path | str) -> list[Similarity]:
    """The transforms, one after the other, from the world of a scene as it was made, before all
    edits, to the frame of its page.

    Raises: UserError: the scene is missing or damaged.
    """
    project = Project.open(scene)
    edits = [] if project.edit is None else [change_of(project.edit)]
    return [*edits, load_viewable(project).frame()]


def moved_film(plan: PageFilm, before: list[Similarity], after: list[Similarity]) -> PageFilm:
    """The plan with its keys at the same places of a scene whose page has another frame; see
    `page_frames`."""
    changes = [*(change.inverse() for change in reversed(before)), *after]
    keys = []
    for key in plan.keys:
        view = view_of_page(key)
        for change in changes:
            view = view.transformed(change)
        keys.append([*view_numbers(view, view.aspect), view.aspect])
    return replace(plan, keys=keys)


def film_preview(scene: Path | str, plan: PageFilm) -> list[list[float]]:
    """The path of a film, for its page: cameras at equal distances in time.

    Each camera is its position, a point ahead, the direction up, and the vertical field of view in
    degrees, in the frame of the page.

    Raises: UserError: see `film`.
    """
    cameras, speeds, means, change = _keys(Path(scene), plan)
    distance = trajectory.viewing_distance(cameras, means)
    count = max(2, min(_MOST, round(plan.seconds * _PREVIEW)))
    path = trajectory.key_path(cameras, count, distance, ease=plan.ease, speeds=speeds)
    return [_in_page(camera.transformed(change)) for camera in path]


def _keys(
    scene: Path, plan: PageFilm
) -> tuple[Sequence[Camera], Sequence[float], Tensor, Similarity]:
    """The key cameras in the world of the scene and their speeds, its means (N, 3), and the change
    to the page."""
    source = load_viewable(scene)
    change = source.frame()
    back = change.inverse()
    cameras = [view_of_page(key).camera(*plan.pixels()).transformed(back) for key in plan.keys]
    speeds = plan.speeds or (1.0,) * len(cameras)
    if plan.loop:
        cameras, speeds = [*cameras, cameras[0]], (*speeds, speeds[0])
    return cameras, speeds, source.gaussians.means, change


def _in_page(camera: Camera) -> list[float]:
    """In the world of the viewer, which is rotated by 180° about the z axis."""
    pose = camera.world_from_cam
    turned = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)[:, None] * pose
    place, ahead, up = turned[:, 3], turned[:, 2], -turned[:, 1]
    half = 0.5 * camera.height / camera.fy
    fov = float(torch.rad2deg(2 * torch.atan(torch.tensor(half, dtype=torch.float64))))
    return [*place.tolist(), *(place + ahead).tolist(), *up.tolist(), fov]
