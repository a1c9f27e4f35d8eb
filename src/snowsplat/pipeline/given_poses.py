"""`given_poses`: the camera poses that a folder of photos has already, if they are plausible."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from snowsplat.data import Dataset, View, read_dataset
from snowsplat.data.files.matching import match_names
from snowsplat.data.judge.verdict import judge
from snowsplat.pipeline.observer import Observer
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.sfm.ingest.search.sources import Source, Sources
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message

# With poses of a smaller share of the photos, a scene of all of them is not possible.
_LEAST_SHARE = 0.5


def given_poses(sources: Sources, settings: DatasetSettings, observer: Observer) -> Dataset | None:
    """The dataset in the folder ``sources.posed``, read with ``settings``; None if its poses must
    be estimated. A line says whether the poses are used, and if not, why. Photos without a pose are
    named.
    """
    name = shown(settings.path)
    try:
        dataset = read_dataset(settings)
        views = [*dataset.train, *dataset.test]
        without = _without_pose(sources.photos, views)
        reason = _why_not(dataset, len(without), len(sources.photos))
    except UserError as error:
        reason = error.message
    if reason:
        observer.inform(
            "{name}: its camera poses are not used, but estimated again: {reason}",
            name=name,
            reason=reason,
        )
        return None
    line = message(
        "{name}: its camera poses are used ({dataset})", name=name, dataset=dataset.description
    )
    folders = [str(photo.path.parent) for photo in sources.photos]
    photos = os.path.commonpath(folders or [settings.path])
    if Path(photos) != Path(settings.path):  # there are no poses in this folder
        line = message(
            "{line}; to estimate them again: snowsplat make {photos}",
            line=line,
            photos=shown(photos),
        )
    observer.note(line)
    if without:
        observer.inform(
            "{name}: {without} of {photos} photos have no pose and are not used (the first "
            "is {path})",
            name=name,
            without=len(without),
            photos=len(sources.photos),
            path=shown(without[0].path),
        )
    return dataset


def _why_not(dataset: Dataset, without: int, photos: int) -> Message | None:
    """The reason why the poses are not used; None if they are."""
    impossible = [finding.text for finding in judge(dataset) if finding.impossible]
    if impossible:
        return Message(impossible[0].rsplit(";", 1)[0])  # without the advice
    if without > (1 - _LEAST_SHARE) * photos:
        return message("{n} of {photos} photos have no pose", n=without, photos=photos)
    return None


def _without_pose(photos: Sequence[Source], views: Sequence[View]) -> list[Source]:
    """The photos that no view shows."""
    used = {view.image.path.resolve() for view in views}
    left = [photo for photo in photos if photo.path.resolve() not in used]
    if len(left) < len(photos):
        return left
    # The views show undistorted copies of the photos, in another folder.
    names = match_names([photo.name for photo in photos], [path.as_posix() for path in used]).files
    return [photo for photo in photos if photo.name not in names]
