"""`render_video`: a video of a scene along a camera path."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from snowsplat import trajectory
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output import image_files
from snowsplat.pipeline.output.scene_source import cameras_of
from snowsplat.project.project import Project
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras, read_speeds
from snowsplat.scene.edit import seen_from_dataset
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.orientation import scene_up
from snowsplat.scene.panorama import PanoramaRenderer, level_pose
from snowsplat.scene.render import render
from snowsplat.trajectory.video_file import video_writer
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import remove_temporaries
from snowsplat.util.stages import Outcome

Projection = Literal["pinhole", "equirectangular"]

#: The camera paths that are computed from the cameras of a training run.
CAMERA_PATHS = ("training", "ellipse", "spiral")

_LONGEST_SIDE = 1920  # of a video without a requested size
_SMALLEST, _LARGEST = 16, 8192  # pixels along a side
_MAX_FRAMES = 100_000
_PANORAMA_WIDTH = 3840  # of a 360° picture without a requested size
_RANGE_FRAMES = 8  # number of frames that determine the range of the depth colours


@dataclass(frozen=True)
class VideoSize:
    """The requested size of a video, in pixels; None if a side was not requested."""

    width: int | None = None
    height: int | None = None

    @classmethod
    def parse(cls, text: str | None) -> VideoSize:
        """Parse "1280x720", "1280" or None. Raises: UserError: ``text`` is no possible size."""
        if text is None:
            return cls()
        match = re.fullmatch(r"(\d{1,6})(?:[xX×](\d{1,6}))?", text)
        if match is None:
            raise SettingError(
                "size", "{text!r} is not a size; use e.g. 1280x720, or a width, 1280", text=text
            )
        width, height = int(match[1]), int(match[2]) if match[2] else None
        if not all(_SMALLEST <= side <= _LARGEST for side in (width, height) if side is not None):
            raise SettingError(
                "size",
                "{text} is out of range; use {smallest} to {largest} pixels",
                text=text,
                smallest=_SMALLEST,
                largest=_LARGEST,
            )
        return cls(width, height)

    def for_camera(self, camera: Camera) -> tuple[int, int]:
        """Width and height, both even; a side that was not requested is taken from ``camera``."""
        width, height = camera.width, camera.height
        if self.width is None:
            scale = min(1.0, _LONGEST_SIDE / max(width, height))
        else:
            scale = self.width / width
        wanted = (self.width or width * scale, self.height or height * scale)
        # Cameras may come from files. A very narrow one would be extremely high at a large width.
        width, height = (min(_LARGEST, max(_SMALLEST, 2 * int(side / 2 + 0.25))) for side in wanted)
        return width, height


def panorama_width(size: str | None) -> int:
    """The width of a panorama of the requested size, in pixels. Raises UserError."""
    wanted = VideoSize.parse(size)
    width = wanted.width or _PANORAMA_WIDTH
    if width % 4 or wanted.height not in (None, width // 2):
        raise SettingError(
            "size",
            "{size} is no size of a 360° picture, which is twice as wide as high with a width "
            "that is a multiple of 4; use e.g. 3840",
            size=size,
        )
    return width


def level_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras turned so that their horizons are level, which players of 360° videos expect."""
    up = scene_up(np.array([camera.cam_from_world[:, :3].cpu().numpy() for camera in cameras]))
    return [
        dataclasses.replace(camera, cam_from_world=level_pose(camera.cam_from_world, up))
        for camera in cameras
    ]


@dataclass(frozen=True)
class VideoOptions:
    """Options of a video: camera path, length, size, depth.

    Attributes:
        path: the camera path. "training": a smooth curve along the cameras of the photos;
            "ellipse": around the point that these cameras look at; "spiral": for scenes whose
            cameras look in one direction; or a file of key cameras in the format of cameras.json.
        seconds: length of the video.
        fps: frames per second.
        size: width and height such as "1280x720", or the width, "1280"; None: the size of the
            photos.
        depth: render a second video that shows the depth in colours.
        side_by_side: render only one video, with colour on the left and depth on the right.
        antialias: whether to render with the 2D mip filter, see `Gaussians`; None: as trained.
        projection: "equirectangular": a 360° video, level, with the heading of the cameras.
        ease: slow at the start and at the end; for a file of key cameras.

    Raises:
        UserError: an unusable length, rate or size.
    """

    path: str = "ellipse"
    seconds: float = 10.0
    fps: float = 30.0
    size: str | None = None
    depth: bool = False
    side_by_side: bool = False
    antialias: bool | None = None
    projection: Projection = "pinhole"
    ease: bool = False

    def __post_init__(self) -> None:
        for name, value in (("seconds", self.seconds), ("fps", self.fps)):
            if not 0 < value < float("inf"):
                raise SettingError(
                    name, "{value:g} is not positive; use a number above 0", value=value
                )
        if self.seconds * self.fps > _MAX_FRAMES:
            raise SettingError(
                "seconds",
                "{seconds:g} with `fps` {fps:g} is more than {max_frames:,} frames; make the "
                "video shorter",
                seconds=self.seconds,
                fps=self.fps,
                max_frames=_MAX_FRAMES,
            )
        if self.ease and self.path in CAMERA_PATHS:
            raise SettingError("ease", "is for a path through the cameras of a file; leave it out")
        if self.projection == "equirectangular":
            if self.depth or self.side_by_side:
                raise SettingError("projection", "equirectangular has no depth; render it alone")
            panorama_width(self.size)
        VideoSize.parse(self.size)

    @property
    def frames(self) -> int:
        """The number of frames."""
        return max(1, round(self.seconds * self.fps))

    @property
    def name(self) -> str:
        """The name of the file, without its suffix."""
        name = self.path if Path(self.path).suffix == "" else Path(self.path).stem
        around = self.projection == "equirectangular"
        return name + "_side_by_side" * self.side_by_side + "_360" * around


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
    source = _load(Path(scene), iteration, options.name)
    gaussians = source.gaussians.to(device)
    if options.antialias is not None:
        gaussians.antialiased = options.antialias
    cameras = cameras_along(
        options.path,
        source.gaussians,
        source.cameras,
        options.frames,
        VideoSize.parse(options.size),
        ease=options.ease,
    )
    around = None
    if options.projection == "equirectangular":
        around = PanoramaRenderer(panorama_width(options.size), device)
        cameras = level_cameras(cameras)
    video = Video(
        gaussians=gaussians,
        cameras=cameras,
        around=around,
        background=source.background,
        file=source.file if target is None else Path(target),
        fps=options.fps,
        depth=options.depth,
        side_by_side=options.side_by_side,
    )
    return video.write(observer)


@dataclass(frozen=True)
class _Source:
    """The scene to render, and the default file of the video."""

    gaussians: Gaussians
    cameras: tuple[list[str], list[Camera]] | None  # names and cameras of the photos
    background: tuple[float, float, float]
    file: Path  # where the video is written if the user names no file


def _load(scene: Path, iteration: int | None, name: str) -> _Source:
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
        return _Source(gaussians, None, (0.0, 0.0, 0.0), file)
    names, cameras = cameras_of(training)
    gaussians = seen_from_dataset(gaussians, training.origin())
    return _Source(gaussians, (names, cameras) if names else None, training.background(), file)


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
            known = ", ".join(CAMERA_PATHS)
            what = f"{path} is unknown; use {known} or a file of cameras (.json)"
            raise SettingError("path", what)
        _, keys = read_cameras(Path(path))
        keys = _in_frame_of(gaussians, keys)
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


def _in_frame_of(gaussians: Gaussians, cameras: list[Camera]) -> list[Camera]:
    """Cameras relative to the origin of the scene. In the world they are nearer to it than to 0."""
    middle = torch.stack([camera.position for camera in cameras]).mean(0)
    origin = torch.tensor(gaussians.origin, dtype=middle.dtype)
    if (middle - origin).norm() >= middle.norm():
        return cameras
    return [camera.seen_from(gaussians.origin) for camera in cameras]


@dataclass(frozen=True)
class Video:
    """A video to be rendered."""

    gaussians: Gaussians
    cameras: Sequence[Camera]  # one per frame, all of the same size; width and height are even
    # Renders all directions from the places of the cameras; None: what the cameras see.
    around: PanoramaRenderer | None
    background: tuple[float, float, float]
    file: Path  # the file of the colour video; that of the depth has _depth in its name
    fps: float
    depth: bool  # also render a video of the depth
    side_by_side: bool  # one video instead, with colour on the left and depth on the right

    def write(self, observer: Observer = SILENT) -> list[Path]:
        """Render and write; returns the files. Raises: UserError: a file cannot be written."""
        first = self.around or self.cameras[0]
        width, height = first.width, first.height
        files = self._files()
        with torch.no_grad(), ExitStack() as stack:
            started = time.monotonic()
            report = observer.begin("video")
            self.file.parent.mkdir(parents=True, exist_ok=True)
            remove_temporaries(self.file.parent, [file.name for file, _ in files])
            near, far = self._depth_range()
            around = self.around is not None
            adds = [
                stack.enter_context(
                    video_writer(file, factor * width, height, self.fps, panorama=around)
                )
                for file, factor in files
            ]
            for i, camera in enumerate(self.cameras):
                for add, pixels in zip(adds, self._frame(camera, near, far), strict=True):
                    add(pixels)
                report(i + 1, len(self.cameras), "frames")
        result = {
            "files": [str(file) for file, _ in files],
            "frames": len(self.cameras),
            "size": [files[0][1] * width, height],
        }
        observer.end("video", Outcome(result, time.monotonic() - started, False))
        return [file for file, _ in files]

    def _files(self) -> list[tuple[Path, int]]:
        """For each video: its file, and the number of images in a frame (2 if side by side)."""
        if self.side_by_side:
            return [(self.file, 2)]
        depth = self.file.with_name(f"{self.file.stem}_depth{self.file.suffix}")
        return [(self.file, 1), (depth, 1)] if self.depth else [(self.file, 1)]

    def _frame(self, camera: Camera, near: float, far: float) -> list[np.ndarray]:
        color, depth = self._render(camera)
        if depth is None:
            return [color]
        shown = image_files.depth_in_color(depth, near, far)
        return [np.concatenate([color, shown], axis=1)] if self.side_by_side else [color, shown]

    def _depth_range(self) -> tuple[float, float]:
        """One range of depths for the whole video, so that its colours do not flicker."""
        if not (self.depth or self.side_by_side):
            return 1.0, 2.0
        sample = self.cameras[:: -(-len(self.cameras) // _RANGE_FRAMES)]
        depths = (self._render(camera)[1] for camera in sample)
        return image_files.depth_range([depth for depth in depths if depth is not None])

    def _render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray | None]:
        with_depth = self.depth or self.side_by_side
        background = torch.tensor(self.background)
        if self.around is not None:
            pose = camera.cam_from_world
            return image_files.to_8bit(self.around.render(self.gaussians, pose, background)), None
        output = render(self.gaussians, camera, background, with_depth=with_depth)
        depth = None if output.depth is None else image_files.mean_depth(output.depth, output.alpha)
        return image_files.to_8bit(output.image), depth
