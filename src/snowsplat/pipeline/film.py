"""`film`: a video through the views that were chosen in the page of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from snowsplat import trajectory
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.page_film import PageFilm
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.pipeline.videos import VideoOptions, render_video
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.geometry import Similarity
from snowsplat.viewer.web.panel import view_of_page
from snowsplat.viewer.web.scene import viewing_frame

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
    cameras, _, _ = _keys(Path(scene), plan)
    write_cameras(Path(keys), ((str(i), camera) for i, camera in enumerate(cameras)))
    options = VideoOptions(path=str(keys), seconds=plan.seconds, size=plan.size, ease=plan.ease)
    (file,) = render_video(scene, options, target=target, compute=compute, observer=observer)
    return file


def film_preview(scene: Path | str, plan: PageFilm) -> list[list[float]]:
    """The path of a film, for its page: cameras at equal distances in time.

    Each camera is its position, a point ahead, the direction up, and the vertical field of view in
    degrees, in the frame of the page.

    Raises: UserError: see `film`.
    """
    cameras, means, change = _keys(Path(scene), plan)
    distance = trajectory.viewing_distance(cameras, means)
    count = max(2, min(_MOST, round(plan.seconds * _PREVIEW)))
    path = trajectory.key_path(cameras, count, distance, ease=plan.ease)
    if change is not None:
        path = [camera.transformed(change) for camera in path]
    return [_in_page(camera) for camera in path]


def _keys(scene: Path, plan: PageFilm) -> tuple[Sequence[Camera], Tensor, Similarity | None]:
    """The key cameras in the world of the scene, its means (N, 3), and the change to the page."""
    source = load_viewable(scene)
    change = viewing_frame(source.gaussians, source.cameras)[0]
    cameras = [view_of_page(key).camera(*plan.pixels()) for key in plan.keys]
    if change is not None:
        back = change.inverse()
        cameras = [camera.transformed(back) for camera in cameras]
    closed = cameras[:1] if plan.loop else []
    return [*cameras, *closed], source.gaussians.means, change


def _in_page(camera: Camera) -> list[float]:
    """In the world of the viewer, which is rotated by 180° about the z axis."""
    pose = camera.world_from_cam
    turned = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)[:, None] * pose
    place, ahead, up = turned[:, 3], turned[:, 2], -turned[:, 1]
    half = 0.5 * camera.height / camera.fy
    fov = float(torch.rad2deg(2 * torch.atan(torch.tensor(half, dtype=torch.float64))))
    return [*place.tolist(), *(place + ahead).tolist(), *up.tolist(), fov]
