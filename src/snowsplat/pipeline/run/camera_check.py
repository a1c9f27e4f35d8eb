"""Checks of a dataset before a training: impossible cameras, and damaged photos."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from snowsplat.data import Dataset, View
from snowsplat.data.judge.verdict import judge
from snowsplat.data.photos.decode import load_thumbnail
from snowsplat.util.errors import UserError

logger = logging.getLogger(__name__)

_SIDE = 64  # pixels of the copies of photos, which are not used


def check_cameras(
    dataset: Dataset, path: str, *, trusted: bool = False
) -> tuple[tuple[str, ...], list[str]]:
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
                text=finding.text,
            )
    for finding in findings:
        logger.warning("warning: %s: %s", path, finding.text)
    wrong = {name for finding in findings if not trusted for name in finding.photos}
    views = [view for view in [*dataset.train, *dataset.test] if view.name in wrong]
    return tuple(finding.text for finding in findings), sorted({view.photo for view in views})


def check_test_photos(views: Sequence[View]) -> None:
    """Decode the held-out photos. The training itself decodes the others in its first steps.
    Raises: UserError: a photo cannot be decoded.
    """
    workers = min(4, os.cpu_count() or 1)
    with ThreadPoolExecutor(workers, thread_name_prefix="snowsplat-check") as pool:
        for _ in pool.map(lambda view: load_thumbnail(view.image, _SIDE), views):
            pass
