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

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snowsplat.project.left_out import LeftOut
from snowsplat.util.safe_json import read_json

#: The folders that undistortion writes.
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "masks", "sparse")
RECORD = "sfm.json"
REPORT = "dataset_report.html"


@dataclass(frozen=True)
class DatasetFolder:
    """The folder of a dataset, existing or not."""

    path: Path

    @property
    def record(self) -> Path:
        return self.path / RECORD

    @property
    def report(self) -> Path:
        return self.path / REPORT

    @property
    def photos(self) -> Path:
        """The folder of the photos with their distortion."""
        return self.path / "input"

    @property
    def distorted(self) -> Path:
        return self.path / "distorted"

    @property
    def distorted_masks(self) -> Path:
        return self.distorted / "masks"

    def mask_of(self, photo: str) -> Path:
        """The mask of a photo in `photos`."""
        return self.distorted_masks / f"{photo}.png"

    @property
    def database(self) -> Path:
        """The features and matches of the photos in `photos`, in a database of COLMAP."""
        return self.distorted / "database.db"

    @property
    def distorted_models(self) -> Path:
        """The COLMAP models of the photos in `photos`, "0", "1" …: the largest first."""
        return self.distorted / "sparse"

    @property
    def distorted_model(self) -> Path:
        """The largest COLMAP model of the photos in `photos`."""
        return self.distorted_models / "0"

    @property
    def images(self) -> Path:
        return self.path / "images"

    @property
    def masks(self) -> Path:
        return self.path / "masks"

    @property
    def model(self) -> Path:
        """The COLMAP model of the undistorted images."""
        return self.path / "sparse" / "0"

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
        *(LeftOut(**values) for values in photos.get("left_out", [])),
        *(LeftOut(photo, "poses", why) for photo, why in poses.get("unregistered", {}).items()),
    ]
