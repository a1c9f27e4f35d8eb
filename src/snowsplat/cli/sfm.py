"""`snowsplat sfm`: photos or a video become a posed dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from snowsplat.cli.flags import Marker, Quiet, Threads, flag, marker_side, switch
from snowsplat.cli.next_steps import next_step
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.sfm.make_dataset import DatasetOptions


@dataclass
class Sfm(Reports):
    """Estimate the camera poses of photos or a video, and create a dataset.

    Examples:
      snowsplat sfm photos/ -o garden       a folder of photos
      snowsplat sfm walk.mp4 -o garden      a video: the sharpest frames are used
      snowsplat sfm walk.mp4 -o garden --frames 120
      snowsplat sfm a.mp4 b.mp4 details/ -o garden
      snowsplat sfm -s garden --resize      photos in garden/input, as in convert.py
      snowsplat train garden -o out         the next step

    Notes:
      The mask of PHOTOS/IMG.jpg is PHOTOS/masks/IMG.png, IMG.jpg.png or
      IMG_mask.png (black pixels are ignored), or the transparency of the photo.
      DATASET/dataset_report.html shows the cameras and lists unused photos.
      If the command is interrupted, run it again to resume.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("INPUT [INPUT ...]")] = ()
    """One or more photos (JPEG, PNG, WebP, TIFF, HEIC), folders of photos, or videos."""
    output: Annotated[Path | None, flag("DATASET", "-o")] = None
    """Folder for the dataset. It is created if it does not exist."""
    source_path: Annotated[Path | None, flag("LOCATION", "-s")] = None
    """Use the photos in LOCATION/input, and write the dataset to LOCATION, like convert.py of the
    reference implementation."""

    fps: Annotated[float | None, flag("F", default="2.5; lower for long videos")] = None
    """Number of frames to use per second of video."""
    frames: Annotated[int | None, flag("N", default="determined by --fps")] = None
    """Number of frames to use per video."""
    size: Annotated[int | None, flag("PIXELS", default="unchanged")] = None
    """Scale photos and frames down so that their longer side has this many pixels."""
    resize: Annotated[bool, switch()] = False
    """Also write the photos at 1/2, 1/4 and 1/8 of their width and height, to images_2, images_4
    and images_8."""

    quality: Annotated[
        Literal["draft", "normal", "best"], flag("{draft,normal,best}", default="normal")
    ] = "normal"
    """Effort to detect and match features. best takes several times as long as normal."""
    camera_model: Annotated[str | None, flag("MODEL", "--camera")] = None
    """Camera model, by its name in COLMAP: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE, PINHOLE …;
    EQUIRECTANGULAR: 360° panoramas whose files do not say so."""
    mapper: Annotated[
        Literal["incremental", "global"], flag("{incremental,global}", default="incremental")
    ] = "incremental"
    """incremental: estimate the camera poses one after the other; global: estimate all poses at
    once, which is faster for many photos."""
    skip_matching: Annotated[bool, switch()] = False
    """With -s, do not estimate camera poses; use the COLMAP model in LOCATION/distorted/sparse/0
    and only undistort the photos."""

    marker: Marker = None
    threads: Threads = None
    overwrite: Annotated[bool, switch()] = False
    """Replace the dataset in DATASET even if it was made from other photos."""
    quiet: Quiet = False
    json: JsonFlag = False

    def run(self) -> int:
        inputs, folder = self._inputs_and_folder()
        from snowsplat.data.frame.placement import placement_of
        from snowsplat.evaluation.verdict import Verdict
        from snowsplat.sfm.make_dataset import make_dataset

        options = self._options()
        with TerminalObserver(self.quiet) as observer:
            outcomes = make_dataset(inputs, folder, options, observer, self.overwrite)
        poses = outcomes["poses"].result
        found, count = len(poses["registered"]), len(poses["unregistered"])
        print(
            message(
                "{folder}: {found} of {count} photos placed, {poses:,} points; see {result}",
                folder=folder,
                found=found,
                count=found + count,
                poses=poses["points"],
                result=folder / outcomes["report"].result["file"],
            )
        )
        placement = placement_of(outcomes["images"].result)
        for line in placement.lines() if placement is not None else []:
            print(line)
        verdict = Verdict.from_json(outcomes["report"].result["verdict"])
        for line in [] if verdict is None else verdict.lines(message("the photos")):
            print(line)
        print(next_step("train it with", "train", folder, "-o", "OUT", "--eval"))
        results = {stage: outcome.result for stage, outcome in outcomes.items()}
        self.report = {"dataset": folder, **results}
        return 0

    def _inputs_and_folder(self) -> tuple[tuple[Path, ...], Path]:
        """The inputs, and the folder of the dataset. Raises UserError if flags do not match."""
        if self.source_path is not None:
            if self.inputs:
                raise UserError("-s LOCATION uses the photos in LOCATION/input; leave out INPUT")
            if not (self.source_path / "input").is_dir():
                raise UserError(
                    "{source_path}: no such folder; put the photos there, or use snowsplat sfm "
                    "PHOTOS -o DATASET",
                    source_path=self.source_path / "input",
                )
            return (self.source_path / "input",), self.output or self.source_path
        if not self.inputs:
            raise UserError("sfm needs photos; add a folder of photos, or a video")
        if self.output is None:
            raise UserError("sfm needs a folder for the result; add -o DATASET")
        if self.skip_matching:
            raise UserError("--skip-matching needs a model; use it with -s LOCATION")
        return self.inputs, self.output

    def _options(self) -> DatasetOptions:
        from snowsplat.pipeline.compute import Compute
        from snowsplat.sfm.colmap import SfmOptions
        from snowsplat.sfm.ingest.inputs import GatherOptions
        from snowsplat.sfm.make_dataset import DatasetOptions

        Compute(threads=self.threads)  # raises an error if there are fewer than 1
        lens: dict[str, Any] = {}
        if self.camera_model is not None:
            name = self.camera_model
            lens["camera_model"] = name if name == "auto" else name.upper()
        return DatasetOptions(
            gather=GatherOptions(fps=self.fps, frames=self.frames, size=self.size),
            sfm=SfmOptions(mapper=self.mapper, effort=self.quality, threads=self.threads, **lens),
            resize=self.resize,
            skip_matching=self.skip_matching,
            marker=marker_side(self.marker),
        )
