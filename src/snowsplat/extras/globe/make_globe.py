"""`make_globe`: a scene in a snow globe, as a web page and a video."""

from dataclasses import dataclass
from pathlib import Path

from snowsplat.extras.globe.glass import engraving
from snowsplat.extras.globe.globe_page import write_page
from snowsplat.extras.globe.globe_video import GlobeVideo
from snowsplat.extras.globe.layout import arrange
from snowsplat.extras.globe.options import LONGEST_NAME, GlobeOptions
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.pipeline.videos import write_videos
from snowsplat.project.project import Project
from snowsplat.util.errors import UserError


@dataclass(frozen=True)
class GlobeResult:
    """A globe."""

    page: Path  # the HTML file
    video: Path | None  # None if none was requested
    gaussians: int  # the number of Gaussians in the globe


def make_globe(
    scene: Path | str,
    page: Path | str | None = None,
    options: GlobeOptions | None = None,
    *,
    video: Path | str | None = None,
    iteration: int | None = None,
    threads: int | None = None,
    observer: Observer = SILENT,
) -> GlobeResult:
    """Put a scene into a snow globe: a web page in one file and, if requested, a video.

    The video does not need a browser: it is rendered by snowsplat, on the CPU. The same scene and
    options give the same frames, bit by bit.

    Args:
        scene: the output folder of a training run, or a scene file of any format.
        page: the HTML file; default: OUT/globe.html or, for a scene file, SCENE_globe.html in the
            same folder.
        options: number of Gaussians, name, size of the video.
        video: an .mp4 file; None: no video.
        iteration: an iteration of an output folder; default: the last one.
        threads: number of CPU threads; None: all cores.

    Raises:
        UserError: the scene is missing, damaged or has no visible Gaussians; a wrong suffix.
        OSError: a file cannot be written.
        KeyboardInterrupt: Ctrl-C; no incomplete file is left.
    """
    options, scene = options or GlobeOptions(), Path(scene)
    project = Project.open(scene, iteration)
    beside = scene.with_name(f"{project.name}_globe.html")
    default = scene / "globe.html" if scene.is_dir() else beside
    target = default if page is None else Path(page)
    if target.suffix.lower() != ".html":
        raise UserError("{target}: the name of the page must end in .html", target=target)
    if video is not None and Path(video).suffix.lower() != ".mp4":
        raise UserError("{video}: the name of a video must end in .mp4", video=video)
    Compute("cpu", threads).apply()
    with observer.waiting("reading"):
        source = load_viewable(project)
    with observer.waiting("arranging"):
        arrangement = arrange(source.gaussians, source.cameras, options.gaussians)
    name = options.name or project.name[:LONGEST_NAME]
    write_page(target, arrangement, name)
    if video is not None:
        width, height = options.video_size
        made = GlobeVideo(arrangement, engraving(name), width, height, options.fps)
        frames = ([frame] for frame in made.frames())
        write_videos({Path(video): width}, height, made.fps, frames, made.count, observer)
    count = len(arrangement.gaussians)
    return GlobeResult(target, None if video is None else Path(video), count)
