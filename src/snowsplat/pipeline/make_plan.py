"""`choose_plan`: how `make` keeps a time budget: quality, size and number of the photos.

Structure from motion must be finished after `_SHARE` of the time; training uses the rest.
`sfm.cost` predicts the time of structure from motion on this machine. The plan is the first entry
of this list that is fast enough:

    all photos      at the size of "best", then at the size at which "best" detects features;
                    the same for "normal", then for "draft"
    fewer photos    for "draft", at the smaller size: as many as there is time for, but at least
                    `_FEWEST`. Photos are evenly spread in the order of their names; frames of a
                    video are selected as usual

At the smaller size of a quality, the poses are as accurate as at the larger one, and a short
training uses even smaller photos.

The prediction may be too low; the training then has less time. If structure from motion takes 45%
longer than predicted, a third of the time is still left for the training.

`given_poses`: the camera poses that a folder of photos has already, if they are plausible.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from snowsplat.data import Dataset, View, read_dataset
from snowsplat.data.files.matching import match_names
from snowsplat.data.judge.verdict import judge
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.options.make import PRESETS, Quality
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.sfm.colmap.options import EFFORTS
from snowsplat.sfm.cost import Photos, Speed, Step, predicted_seconds
from snowsplat.sfm.ingest.search.sources import Source, Sources
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown
from snowsplat.util.messages import Message, message

#: The share of the time that everything before the training may take.
_SHARE = 0.45
#: No further attempt to find poses begins if it would probably end after this share of the time.
POSES_SHARE = 0.6
#: With fewer photos, the cameras may be too far apart for matches.
_FEWEST = 20
# With poses of a smaller share of the photos, a scene of all of them is not possible.
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class MakePlan:
    """The work of structure from motion in `make`."""

    quality: Quality  # the effort to estimate the camera poses
    size: int  # photos are reduced to this longer side, in pixels
    photos: int | None = None  # number of photos to use; None: all
    frames: int | None = None  # number of frames to use of each video; None: as many as usual


def choose_plan(
    seconds: float, photos: Photos, speed: Speed, quality: Quality | None = None
) -> MakePlan:
    """The best plan whose structure from motion takes at most `_SHARE` of ``seconds``.

    Args:
        photos: all photos and frames that would be used without a time budget.
        quality: the requested quality; None: any.
    """

    def fits(photos: Photos, quality: Quality, size: int) -> bool:
        return predicted_seconds(photos, size, quality, speed) <= _SHARE * seconds

    allowed = list(_sizes(quality))
    for quality, size in allowed:
        if fits(photos, quality, size):
            return MakePlan(quality, size)
    quality, size = allowed[-1]
    count, fewest = photos.count, min(_FEWEST, photos.count)
    while count > fewest and not fits(_thinned(photos, count), quality, size):
        count -= 1
    fewer = _thinned(photos, count)
    return MakePlan(
        quality,
        size,
        photos=max(1, fewer.stills) if fewer.stills < photos.stills else None,
        frames=max(3, fewer.frames // photos.videos) if fewer.frames < photos.frames else None,
    )


def _sizes(quality: Quality | None) -> Iterator[tuple[Quality, int]]:
    """Qualities and sizes of the photos, in the order in which they are tried."""
    every: tuple[Quality, ...] = ("best", "normal", "draft")
    for each in every if quality is None else (quality,):
        yield each, PRESETS[each].photos
        yield each, EFFORTS[each].image_size


def _thinned(photos: Photos, count: int) -> Photos:
    """``count`` of the photos and frames, with the same share of frames."""
    frames = round(count * photos.frames / photos.count)
    return replace(photos, stills=count - frames, frames=frames)


def described(plan: MakePlan, photos: Photos, seconds: float) -> Message:
    """The plan in one line, such as "3 min 0 s: 60 of 300 photos, 1000 pixels, draft effort"."""
    return message(
        "{time}: {photos}, {size} pixels, {quality} effort",
        time=duration(seconds),
        photos=_counted(plan, photos),
        size=min(plan.size, max(photos.longest, photos.video)),
        quality=plan.quality,
    )


def expected(quality: Quality, photos: Photos, seconds: float) -> Message:
    """What `make` begins, and how long it takes, in one line: "36 photos, draft: about 3 min"."""
    plan = MakePlan(quality, PRESETS[quality].photos)
    return message(
        "{photos}, {quality}: about {time}",
        photos=_counted(plan, photos),
        quality=quality,
        time=duration(seconds),
    )


def expected_seconds(quality: Quality, photos: Photos, speed: Speed, poses: bool = True) -> float:
    """The predicted time of `make` on the CPU; ``poses``: whether they are estimated."""
    size = PRESETS[quality].photos
    before = predicted_seconds(photos, size, quality, speed) if poses else 0.0
    return before + training_seconds(quality, photos.count, speed)


def training_seconds(quality: Quality, photos: int, speed: Speed) -> float:
    """The predicted time of `make` on the CPU after the poses are known."""
    preset = PRESETS[quality]
    return Step(preset.training + preset.training_per_photo * photos).seconds(speed)


def _counted(plan: MakePlan, photos: Photos) -> Message:
    stills = message("{photos} photos", photos=photos.stills)
    if plan.photos is not None:
        stills = message("{used} of {all} photos", used=plan.photos, all=photos.stills)
    frames = message("{frames} frames", frames=photos.frames)
    if plan.frames is not None:
        used = plan.frames * photos.videos
        frames = message("{used} of {all} frames", used=used, all=photos.frames)
    both = message("{photos} and {frames}", photos=stills, frames=frames)
    return both if photos.stills and photos.frames else stills if photos.stills else frames


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
        reason = next((each.text for each in judge(dataset) if each.impossible), None)
        if not reason and len(without) > (1 - _LEAST_SHARE) * len(sources.photos):
            reason = message(
                "{n} of {photos} photos have no pose", n=len(without), photos=len(sources.photos)
            )
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


def _without_pose(photos: Sequence[Source], views: Sequence[View]) -> list[Source]:
    """The photos that no view shows."""
    used = {view.image.path.resolve() for view in views}
    left = [photo for photo in photos if photo.path.resolve() not in used]
    if len(left) < len(photos):
        return left
    # The views show undistorted copies of the photos, in another folder.
    names = match_names([photo.name for photo in photos], [path.as_posix() for path in used]).files
    return [photo for photo in photos if photo.name not in names]
