"""What is checked of a dataset: impossible cameras, and whether it has changed.

Stamps of photos and masks, which `resume` compares, tell what has changed, and hashes of the whole,
which `make` compares.
"""

import hashlib
import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from snowsplat.data import Dataset
from snowsplat.data.judge.verdict import judge
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message

logger = logging.getLogger(__name__)

_PART = 1 << 16  # bytes at the begin, the middle and the end of a file that its digest covers


@dataclass(frozen=True)
class Stamp:
    """A file at one time."""

    size: int  # bytes
    time: int  # of its last change, in nanoseconds; copies of a file may have another one
    # Of parts of its content. An edited image is compressed anew, so all parts change.
    digest: str


def stamps_of(
    dataset: Dataset, folder: Path | str, before: Mapping[str, Stamp] | None = None
) -> dict[str, Stamp]:
    """The stamps of photos and masks, by their paths relative to the folder of the dataset.

    Files with the same size and time as in ``before``, earlier stamps, are not read again. Raises
    OSError.
    """
    stamps: dict[str, Stamp] = {}
    for view in [*dataset.train, *dataset.test]:
        for image in (view.image, view.mask):
            if image is not None:
                name = Path(os.path.relpath(image.path, folder)).as_posix()
                if name not in stamps:
                    stamps[name] = _stamp(image.path, (before or {}).get(name))
    return stamps


def edited(before: Mapping[str, Stamp], now: Mapping[str, Stamp]) -> list[str]:
    """The files with another content, and those that are only in one of both; sorted."""

    def content(stamps: Mapping[str, Stamp]) -> set[tuple[str, int, str]]:
        return {(name, stamp.size, stamp.digest) for name, stamp in stamps.items()}

    return sorted({name for name, _, _ in content(before) ^ content(now)})


def _stamp(path: Path, before: Stamp | None) -> Stamp:
    status = path.stat()
    size, time = status.st_size, status.st_mtime_ns
    if before is not None and (before.size, before.time) == (size, time):
        return before
    digest = hashlib.blake2b(digest_size=8)
    with open(path, "rb") as file:
        for start in sorted({0, max(0, (size - _PART) // 2), max(0, size - _PART)}):
            file.seek(start)
            digest.update(file.read(_PART))
    return Stamp(size, time, digest.hexdigest())


def hash_of_dataset(dataset: Dataset, folder: Path) -> str:
    """A hash of the cameras and points of a dataset, and of its photos and masks."""
    digest = hashlib.sha256()
    for view in [*dataset.train, *dataset.test]:
        camera = view.camera
        intrinsics = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        pose = camera.cam_from_world.tolist()
        digest.update(repr((view.name, intrinsics, pose, view.image.view)).encode())
    if dataset.points is not None:
        digest.update(dataset.points.xyz.numpy().tobytes())
    stamps = stamps_of(dataset, folder)
    digest.update(repr(sorted((k, v.size, v.digest) for k, v in stamps.items())).encode())
    return digest.hexdigest()


def hash_of_files(dataset: DatasetFolder) -> str:
    """A hash of the cameras, and of the names and sizes of photos and masks."""
    digest = hashlib.sha256()
    for path in sorted(dataset.model.glob("*.bin")):
        digest.update(path.read_bytes())
    for folder in (dataset.images, dataset.masks):
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                name = path.relative_to(dataset.path)
                digest.update(f"{name} {path.stat().st_size}\n".encode())
    return digest.hexdigest()


def check_cameras(
    dataset: Dataset, path: str, *, trusted: bool = False
) -> tuple[tuple[Message, ...], list[str]]:
    """Judge the cameras of a dataset; see `snowsplat.data.judge.verdict.judge`.

    Args:
        path: of the dataset, for messages.
        trusted: the user is sure of the cameras: what is impossible is a doubt too.

    Returns one sentence for each doubt, for the report, each of which is also logged as a warning;
    and the photos to leave out, because the matches contradict their poses.

    Raises: UserError: the cameras are impossible. The message says why, and what to do.
    """
    findings = judge(dataset)
    for finding in findings:
        if finding.impossible and not trusted:
            raise UserError(
                "{path}: {text} (or set `trust_cameras` if you are sure)",
                path=path,
                text=finding.sentence,
            )
    for finding in findings:
        logger.warning("warning: %s: %s", path, finding.sentence)
    wrong = {name for finding in findings if not trusted for name in finding.photos}
    views = [view for view in [*dataset.train, *dataset.test] if view.name in wrong]
    return tuple(finding.sentence for finding in findings), sorted({view.photo for view in views})
