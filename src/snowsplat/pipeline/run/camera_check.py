"""`check_cameras`: before a training, refuses cameras that are impossible and warns of doubts."""

from __future__ import annotations

import logging

from snowsplat.data import Dataset
from snowsplat.data.judge.verdict import judge
from snowsplat.util.errors import UserError

logger = logging.getLogger(__name__)


def check_cameras(dataset: Dataset, path: str, *, trusted: bool = False) -> tuple[str, ...]:
    """Judge the cameras of a dataset; see `snowsplat.data.judge.verdict.judge`.

    Logs a warning for each doubt.

    Args:
        path: of the dataset, for messages.
        trusted: the user is sure of the cameras: what is impossible is a doubt too.

    Returns:
        One sentence for each doubt, for the report.

    Raises:
        UserError: the cameras are impossible. The message says why, and what to do.
    """
    findings = judge(dataset)
    for finding in findings:
        if finding.impossible and not trusted:
            raise UserError(f"{path}: {finding.text} (or set `trust_cameras` if you are sure)")
    for finding in findings:
        logger.warning("warning: %s: %s", path, finding.text)
    return tuple(finding.text for finding in findings)
