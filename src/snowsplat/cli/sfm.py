"""`snowsplat sfm`: photos or a video become a posed dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from snowsplat.cli.computing import check_threads
from snowsplat.cli.flags import flag, switch
from snowsplat.cli.stages import StageProgress
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.sfm.dataset_folder import DatasetOptions
    from snowsplat.sfm.progress import Report
    from snowsplat.util.stages import Outcome

_NAMED = 5  # photos that are listed one by one


@dataclass
class Sfm:
    """Find out where photos were taken from: what training needs, from a folder or a video.

    Examples:
      snowsplat sfm photos/ -o garden           a folder of photos
      snowsplat sfm walk.mp4 -o garden          a video: the sharpest frames are taken
      snowsplat sfm walk.mp4 -o garden --frames 120
      snowsplat sfm a.mp4 b.mp4 details/ -o garden
      snowsplat sfm -s garden --resize          photos in garden/input, as for convert.py
      snowsplat train garden -o out                 goes on from there

    Masks are taken from PHOTOS/masks/IMG.jpg.png or IMG.png (black is left out), or are what is
    transparent in the photo. How it went is told in DATASET/capture_report.html. Stopped, it goes
    on with the same command.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("INPUT [INPUT ...]")] = ()
    """Folders of photos (JPEG, PNG, WebP, TIFF, HEIC), photos, and videos."""
    output: Annotated[Path | None, flag("DATASET", "-o")] = None
    """Folder for the dataset; made if it is not there."""
    source_path: Annotated[Path | None, flag("LOCATION", "-s")] = None
    """As in the reference's convert.py: LOCATION/input has the photos, LOCATION the dataset."""

    fps: Annotated[float | None, flag("F")] = None
    """Frames to take from a second of video."""
    frames: Annotated[int | None, flag("N")] = None
    """Frames to take from a video in all."""
    size: Annotated[int | None, flag("PIXELS", default="as they are")] = None
    """Make the longer side of photos and frames no longer than this."""
    resize: Annotated[bool, switch()] = False
    """Also make images_2, images_4 and images_8: a half, a quarter, an eighth as large."""

    quality: Annotated[
        Literal["draft", "normal", "best"], flag("{draft,normal,best}", default="normal")
    ] = "normal"
    """How hard to look for common points in the photos; best takes several times as long."""
    camera_model: Annotated[str | None, flag("MODEL", "--camera")] = None
    """Of the lens, a name of COLMAP's: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE, PINHOLE …"""
    mapper: Annotated[
        Literal["incremental", "global"], flag("{incremental,global}", default="incremental")
    ] = "incremental"
    """How the cameras are placed: one by one, or all at once (quicker for many photos)."""
    skip_matching: Annotated[bool, switch()] = False
    """With -s: take the model that is in LOCATION/distorted/sparse/0, only undistort."""

    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Threads to compute with."""
    overwrite: Annotated[bool, switch()] = False
    """Replace a dataset of other photos that is in DATASET."""
    quiet: Annotated[bool, switch("-q")] = False
    """No progress, only the result."""

    def run(self) -> int:
        """Gives the exit code, 0."""
        from snowsplat.sfm.dataset_folder import make_dataset

        inputs, folder = self._where()
        with StageProgress(self.quiet) as progress:
            watcher = SfmProgress(progress)
            outcomes = make_dataset(inputs, folder, self._options(), watcher, self.overwrite)
        poses = outcomes["poses"].result
        found, count = len(poses["registered"]), len(poses["unregistered"])
        print(
            f"{folder}: {found} of {found + count} photos placed, {poses['points']:,} points; "
            f"see {folder / outcomes['report'].result['file']}"
        )
        print(f"train it with: snowsplat train {folder} -o OUT --eval")
        return 0

    def _where(self) -> tuple[tuple[Path, ...], Path]:
        if self.source_path is not None:
            if self.inputs:
                raise UserError("-s LOCATION takes the photos in LOCATION/input; leave out INPUT")
            if not (self.source_path / "input").is_dir():
                raise UserError(
                    f"{self.source_path / 'input'}: no such folder; put the photos there, or use "
                    "snowsplat sfm PHOTOS -o DATASET"
                )
            return (self.source_path / "input",), self.output or self.source_path
        if not self.inputs:
            raise UserError("sfm needs photos; name a folder of photos, or a video")
        if self.output is None:
            raise UserError("sfm needs a folder for the result; add -o DATASET")
        if self.skip_matching:
            raise UserError("--skip-matching needs a model to take; use it with -s LOCATION")
        return self.inputs, self.output

    def _options(self) -> DatasetOptions:
        from snowsplat.sfm.colmap import SfmOptions
        from snowsplat.sfm.dataset_folder import DatasetOptions
        from snowsplat.sfm.ingest.inputs import GatherOptions

        check_threads(self.threads)
        lens: dict[str, Any] = {}
        if self.camera_model is not None:
            lens["camera_model"] = self.camera_model
        return DatasetOptions(
            gather=GatherOptions(fps=self.fps, frames=self.frames, size=self.size),
            sfm=SfmOptions(mapper=self.mapper, effort=self.quality, threads=self.threads, **lens),
            resize=self.resize,
            skip_matching=self.skip_matching,
        )


class SfmProgress:
    """Tells about the stages of `make_capture` in words."""

    def __init__(self, progress: StageProgress) -> None:
        self.progress = progress

    def begin(self, stage: str) -> Report:
        return self.progress.begin(stage)

    def note(self, line: str) -> None:
        self.progress.say(line)

    def end(self, stage: str, outcome: Outcome) -> None:
        tell = getattr(self, f"_{stage}")
        line, *details = tell(outcome.result)
        self.progress.end(line, outcome.seconds, outcome.again)
        if not outcome.again:
            for detail in details:
                self.progress.say(f"          {detail}")

    def _photos(self, gathered: dict[str, Any]) -> list[str]:
        photos, skipped = gathered["photos"], gathered["skipped"]
        line = f"{len(photos)} photos"
        if skipped:
            line += f", {len(skipped)} left out"
        return [line, *_listed([f"{source}: {why}" for source, why in skipped])]

    def _poses(self, sfm: dict[str, Any]) -> list[str]:
        lost = sfm["unregistered"]
        placed = len(sfm["registered"])
        line = (
            f"{placed} of {placed + len(lost)} photos placed, {sfm['points']:,} points, "
            f"reprojection error {sfm['reprojection_error']:.2f} px"
        )
        details = []
        if len(sfm["sub_models"]) > 1:
            sizes = ", ".join(map(str, sfm["sub_models"]))
            details.append(
                f"the photos fall into {len(sfm['sub_models'])} groups that show nothing in "
                f"common ({sizes} photos); the largest is taken"
            )
        if len(sfm["attempts"]) > 1:
            details.append("tried: " + "; ".join(sfm["attempts"]))
        return [line, *details, *_listed([f"{name}: {why}" for name, why in lost.items()])]

    def _images(self, undistorted: dict[str, Any]) -> list[str]:
        sizes = sorted(undistorted["sizes"], key=lambda size: -size[2])
        width, height, _ = sizes[0]
        others = f" and {len(sizes) - 1} other sizes" if len(sizes) > 1 else ""
        line = f"{undistorted['images']} pictures of {width}x{height}{others}"
        line += ", lens distortion taken out" if undistorted["resampled"] else ""
        return [line + (f", {undistorted['masks']} masks" if undistorted["masks"] else "")]

    def _report(self, written: dict[str, Any]) -> list[str]:
        return [written["file"]]


def _listed(lines: list[str]) -> list[str]:
    more = len(lines) - _NAMED
    return lines[:_NAMED] + ([f"and {more} more, see {'capture_report.html'}"] if more > 0 else [])
