"""`render_video`: a video of a scene along a camera path."""

import dataclasses
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch

from snowsplat import trajectory
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.video import CAMERA_PATHS, VideoOptions, VideoSize, panorama_width
from snowsplat.pipeline.output import image_files
from snowsplat.pipeline.output.scene_source import cameras_of
from snowsplat.project.project import Project
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras, read_speeds
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.orientation import scene_up
from snowsplat.scene.panorama import PanoramaRenderer, level_pose
from snowsplat.scene.render import render, to_8bit
from snowsplat.trajectory.video_file import video_writer
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import remove_temporaries
from snowsplat.util.stages import Outcome

_RANGE_FRAMES = 8  # number of frames that determine the range of the depth colours


def level_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras turned so that their horizons are level, which players of 360° videos expect."""
    up = scene_up(np.array([camera.cam_from_world[:, :3].cpu().numpy() for camera in cameras]))
    return [
        dataclasses.replace(camera, cam_from_world=level_pose(camera.cam_from_world, up))
        for camera in cameras
    ]


def render_video(
    scene: Path | str,
    options: VideoOptions | None = None,
    *,
    target: Path | str | None = None,
    iteration: int | None = None,
    compute: Compute | None = None,
    observer: Observer = SILENT,
) -> list[Path]:
    """Render a video of a scene; the photos are not needed.

    Args:
        scene: the output folder of a training run, or a scene file.
        target: an .mp4 file; default: OUT/videos/PATH.mp4, or for a scene file, SCENE_PATH.mp4 in
            the same folder. PATH is the camera path. A video of the depth has _depth in its name.
        iteration: an iteration of an output folder; default: the last one.

    Returns:
        The files.

    Raises:
        UserError: a missing or damaged scene or camera file; a camera path that needs the cameras
            of a training run.
        KeyboardInterrupt: Ctrl-C; no file is left.
    """
    options = options or VideoOptions()
    if target is not None and Path(target).suffix.lower() != ".mp4":
        raise UserError("{target}: the name of a video must end in .mp4", target=target)
    device = (compute or Compute()).apply()
    gaussians, trained, background, file = _source(Path(scene), iteration, options.name)
    size = VideoSize.parse(options.size)
    cameras = cameras_along(
        options.path, gaussians, trained, options.frames, size, ease=options.ease
    )
    gaussians = gaussians.to(device)
    if options.antialias is not None:
        gaussians.antialiased = options.antialias
    around, first = None, cameras[0]
    width, height = first.width, first.height
    if options.projection == "equirectangular":
        around = PanoramaRenderer(panorama_width(options.size), device)
        width, height = around.width, around.height
        cameras = level_cameras(cameras)
    file = file if target is None else Path(target)
    files = {file: 2 * width if options.side_by_side else width}
    if options.depth and not options.side_by_side:
        files[file.with_name(f"{file.stem}_depth{file.suffix}")] = width
    with_depth = options.depth or options.side_by_side

    def draw(camera: Camera) -> tuple[np.ndarray, np.ndarray | None]:
        color = torch.tensor(background)
        if around is not None:
            return to_8bit(around.render(gaussians, camera.cam_from_world, color)), None
        output = render(gaussians, camera, color, with_depth=with_depth)
        depth = None if output.depth is None else image_files.mean_depth(output.depth, output.alpha)
        return to_8bit(output.image), depth

    def frames() -> Iterator[list[np.ndarray]]:
        near, far = 1.0, 2.0
        if with_depth:  # one range for the whole video, so that its colours do not flicker
            sample = cameras[:: -(-len(cameras) // _RANGE_FRAMES)]
            depths = (draw(camera)[1] for camera in sample)
            near, far = image_files.depth_range([depth for depth in depths if depth is not None])
        for camera in cameras:
            color, depth = draw(camera)
            if depth is None:
                yield [color]
                continue
            shown = image_files.depth_in_color(depth, near, far)
            beside = options.side_by_side
            yield [np.concatenate([color, shown], axis=1)] if beside else [color, shown]

    with torch.no_grad():
        every = around is not None
        write_videos(files, height, options.fps, frames(), len(cameras), observer, every)
    return [*files]


def write_videos(
    files: Mapping[Path, int],
    height: int,
    fps: float,
    frames: Iterable[Sequence[np.ndarray]],
    count: int,
    observer: Observer,
    panorama: bool = False,
) -> None:
    """Write videos of the same length, as the stage "video" of the observer.

    Args:
        files: file -> width in pixels; width and height are even.
        frames: for each time, a frame (height, width, 3) uint8 of each file.
        count: their number.
        panorama: whether the frames show all directions.

    Raises: UserError: a file cannot be written.
    """
    started, report = time.monotonic(), observer.begin("video")
    with ExitStack() as stack:
        for file in files:
            file.parent.mkdir(parents=True, exist_ok=True)
            remove_temporaries(file.parent, [file.name])
        adds = [
            stack.enter_context(video_writer(file, width, height, fps, panorama=panorama))
            for file, width in files.items()
        ]
        for i, images in enumerate(frames):
            for add, pixels in zip(adds, images, strict=True):
                add(pixels)
            report(i + 1, count, "frames")
    first = next(iter(files.values()))
    result = {"files": [*map(str, files)], "frames": count, "size": [first, height]}
    observer.end("video", Outcome(result, time.monotonic() - started, False))


def _source(
    scene: Path, iteration: int | None, name: str
) -> tuple[Gaussians, tuple[list[str], list[Camera]] | None, tuple[float, float, float], Path]:
    """The scene, names and cameras of its photos, the background, and the default file."""
    project = Project.open(scene)
    if project.is_file:
        training, found = project.training, project.scene_file()
        file = found.with_name(f"{found.stem}_{name}.mp4")
    else:
        training = project.training_folder()
        found = training.find_scene(iteration)[1]
        file = training.videos / f"{name}.mp4"
    gaussians = read_gaussians(found)
    if training is None or not training.is_training():
        return gaussians, None, (0.0, 0.0, 0.0), file
    names, cameras = cameras_of(training)
    gaussians = seen_from_dataset(gaussians, training.origin())
    return gaussians, (names, cameras) if names else None, training.background(), file


def cameras_along(
    path: str,
    gaussians: Gaussians,
    trained: tuple[list[str], list[Camera]] | None,
    frames: int,
    size: VideoSize,
    *,
    ease: bool = False,
) -> list[Camera]:
    """One camera per frame.

    Args:
        path: one of `CAMERA_PATHS`, or a file of key cameras.
        trained: names and cameras of the photos; None for a scene file without an output folder.
        ease: see `VideoOptions`.

    Raises: UserError: no such path or file, or one that needs the cameras of a training run.
    """
    if path not in CAMERA_PATHS:
        if Path(path).suffix.lower() != ".json":
            raise SettingError(
                "path",
                "{path} is unknown; use {known} or a file of cameras (.json)",
                path=path,
                known=[*CAMERA_PATHS],
            )
        _, keys = read_cameras(Path(path))
        # Cameras in the world are nearer to the origin of the scene than to 0.
        middle = torch.stack([camera.position for camera in keys]).mean(0)
        origin = torch.tensor(gaussians.origin, dtype=middle.dtype)
        if (middle - origin).norm() < middle.norm():
            keys = [camera.seen_from(gaussians.origin) for camera in keys]
        distance = trajectory.viewing_distance(keys, gaussians.means)
        speeds = read_speeds(Path(path))
        cameras = trajectory.key_path(keys, frames, distance, ease=ease, speeds=speeds)
    elif trained is not None:
        names, given = trained
        distance = trajectory.viewing_distance(given, gaussians.means)
        if path == "training":
            cameras = trajectory.training_path(given, names, frames, distance)
        else:
            make_path = trajectory.ellipse_path if path == "ellipse" else trajectory.spiral_path
            cameras = make_path(given, frames, distance)
    elif path == "ellipse":
        width, height = size.width or 1280, size.height or (size.width or 1280) * 9 // 16
        cameras = trajectory.orbit_path(gaussians.means, gaussians.opacities, frames, width, height)
    else:
        raise SettingError(
            "path",
            "{path} needs the cameras of a training run; use its output folder, or ellipse or a "
            "file of cameras",
            path=path,
        )
    width, height = size.for_camera(cameras[0])
    return [trajectory.resized(camera, width, height) for camera in cameras]
