"""`DatasetFolder`: the files of a dataset that `sfm` makes from photos.

    DATASET/input/                the photos or video frames, upright
    DATASET/distorted/            COLMAP database, models of the original photos, log of COLMAP
    DATASET/images/, sparse/0/    the input of training: undistorted images and their cameras
    DATASET/masks/                masks, if there are any
    DATASET/images_2/, _4, _8     smaller copies, if requested
    DATASET/sfm.json              settings and results of each stage, see `snowsplat.util.stages`
    DATASET/dataset_report.html   the same as a page, with a map of cameras and points

The layout is that of the reference implementation's convert.py.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.project.inside import Inside
from snowsplat.project.left_out import LeftOut
from snowsplat.util.messages import as_message
from snowsplat.util.safe_json import read_json

#: The folders that undistortion writes.
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "masks", "sparse")


@dataclass(frozen=True)
class DatasetFolder:
    """The folder of a dataset, existing or not."""

    path: Path

    record = Inside("sfm.json")
    report = Inside("dataset_report.html")
    #: The folder of the photos with their distortion.
    photos = Inside("input")
    distorted = Inside("distorted")
    distorted_masks = Inside("distorted/masks")
    #: The features and matches of the photos in `photos`, in a database of COLMAP.
    database = Inside("distorted/database.db")
    #: The COLMAP models of the photos in `photos`, "0", "1" …: the largest first.
    distorted_models = Inside("distorted/sparse")
    distorted_model = Inside("distorted/sparse/0")
    images = Inside("images")
    masks = Inside("masks")
    #: The COLMAP model of the undistorted images.
    model = Inside("sparse/0")

    def mask_of(self, photo: str) -> Path:
        """The mask of a photo in `photos`."""
        return self.distorted_masks / f"{photo}.png"

    def result(self, stage: str) -> dict[str, Any]:
        """The result of a stage, as the record says; empty if it is not finished, or damaged."""
        try:
            return dict(read_json(self.record)["stages"][stage]["result"])
        except (OSError, ValueError, KeyError, TypeError):
            return {}

    def left_out(self) -> list[LeftOut]:
        """The photos that the stages "photos" and "poses" have left out."""
        try:
            return left_out_of(self.result("photos"), self.result("poses"))
        except (TypeError, AttributeError):  # a damaged record
            return []


def left_out_of(photos: Mapping[str, Any], poses: Mapping[str, Any]) -> list[LeftOut]:
    """The photos that these stages have left out; their results are those of the record."""
    return [
        *(
            LeftOut(each["photo"], each["stage"], as_message(each["reason"]))
            for each in photos.get("left_out", [])
        ),
        *(
            LeftOut(photo, "poses", as_message(why))
            for photo, why in poses.get("unregistered", {}).items()
        ),
    ]
