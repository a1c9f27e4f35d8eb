"""What is checked of a dataset: impossible cameras, and hashes that tell whether it has changed."""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path

from snowsplat.data import Dataset
from snowsplat.data.judge.verdict import judge
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message

logger = logging.getLogger(__name__)

_PART = 1 << 16  # bytes at the begin, the middle and the end of a file that a hash covers


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
    views = [*dataset.train, *dataset.test]
    files = {image.path for view in views for image in (view.image, view.mask) if image is not None}
    for path in sorted(files):
        digest.update(os.path.relpath(path, folder).encode("utf-8", "replace"))
        digest.update(_parts_of(path))
    return digest.hexdigest()


def _parts_of(path: Path) -> bytes:
    """The size of a file and parts of its content: an edited image is compressed anew, so all parts
    change. Raises OSError."""
    size = path.stat().st_size
    parts = [size.to_bytes(8, "little")]
    with open(path, "rb") as file:
        for start in sorted({0, max(0, (size - _PART) // 2), max(0, size - _PART)}):
            file.seek(start)
            parts.append(file.read(_PART))
    return b"".join(parts)


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
