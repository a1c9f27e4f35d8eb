"""`snowsplat sfm`: photos or a video become a posed dataset."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.cli.command import JsonCommand, next_step, print_message
from snowsplat.cli.observer import TerminalObserver
from snowsplat.pipeline.options import common
from snowsplat.sfm.options import DatasetOptions
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.settings import argument, group, setting


@dataclass(frozen=True, kw_only=True)
class Sfm(JsonCommand):
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

    inputs: tuple[Path, ...] = argument(
        (),
        "INPUT [INPUT ...]",
        "One or more photos (JPEG, PNG, WebP, TIFF, HEIC), folders of photos, or videos.",
    )
    output: Path | None = setting(
        None,
        "Folder for the dataset. It is created if it does not exist.",
        metavar="DATASET",
        aliases=("-o",),
    )
    source_path: Path | None = setting(
        None,
        "Use the photos in LOCATION/input, and write the dataset to LOCATION, like convert.py of "
        "the reference implementation.",
        metavar="LOCATION",
        aliases=("-s",),
    )
    options: DatasetOptions = group(DatasetOptions)
    overwrite: bool = common.overwrite(
        "Replace the dataset in DATASET even if it was made from other photos."
    )
    quiet: bool = common.quiet()

    def run(self) -> dict[str, Any]:
        inputs, folder = self._inputs_and_folder()
        from snowsplat.data.frame.placement import placement_of
        from snowsplat.evaluation.verdict import Verdict
        from snowsplat.sfm.make_dataset import make_dataset

        with TerminalObserver(self.quiet) as observer:
            outcomes = make_dataset(inputs, folder, self.options, observer, self.overwrite)
        poses = outcomes["poses"].result
        found, count = len(poses["registered"]), len(poses["unregistered"])
        print_message(
            "{folder}: {found} of {count} photos placed, {poses:,} points; see {result}",
            folder=folder,
            found=found,
            count=found + count,
            poses=poses["points"],
            result=folder / outcomes["report"].result["file"],
        )
        placement = placement_of(outcomes["images"].result)
        for line in placement.lines() if placement is not None else []:
            print(line)
        verdict = Verdict.from_json(outcomes["report"].result["verdict"])
        for line in [] if verdict is None else verdict.lines(message("the photos")):
            print(line)
        print(next_step(message("train it with"), "train", folder, "-o", "OUT", "--eval"))
        results = {stage: outcome.result for stage, outcome in outcomes.items()}
        return {"dataset": folder, **results}

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
        if self.options.skip_matching:
            raise UserError("--skip-matching needs a model; use it with -s LOCATION")
        return self.inputs, self.output
