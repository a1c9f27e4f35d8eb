"""`check_test_photos`: finds damaged photos that would be read only after the training."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from snowsplat.data import View
from snowsplat.data.decode import load_thumbnail

_SIDE = 64  # pixels of the copies, which are not used


def check_test_photos(views: Sequence[View]) -> None:
    """Decode the held-out photos. The training itself decodes the others in its first steps.

    Raises:
        UserError: a photo cannot be decoded.
    """
    workers = min(4, os.cpu_count() or 1)
    with ThreadPoolExecutor(workers, thread_name_prefix="snowsplat-check") as pool:
        for _ in pool.map(lambda view: load_thumbnail(view.image, _SIDE), views):
            pass
