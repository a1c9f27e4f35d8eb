"""`evaluate`: PSNR, SSIM and LPIPS of a trained scene."""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from snowsplat.data import View
from snowsplat.evaluation.lpips import Lpips
from snowsplat.evaluation.metrics import Evaluation, ViewMetrics, evaluate_views
from snowsplat.pipeline.output.scene_source import TrainedScene
from snowsplat.util.errors import UserError
from snowsplat.util.process import single_threaded

logger = logging.getLogger(__name__)

Split = Literal["test", "train"]


def evaluate(
    scene: TrainedScene,
    *,
    split: Split = "test",
    lpips: Lpips | Path | str | None = None,
    on_view: Callable[[ViewMetrics], None] | None = None,
) -> Evaluation:
    """Compare the renderings of a scene with its photos; write OUT/metrics.json, if possible.

        evaluate(load_trained("out/garden")).psnr

    Args:
        split: "test": the held-out photos; "train": the training photos.
        lpips: a file of weights, see `snowsplat.evaluation.lpips`; None: LPIPS is not measured.
        on_view: called after each view.

    Returns:
        PSNR, SSIM and LPIPS of each view, and their means.

    Raises:
        UserError: there are no photos in this split, or a photo or the weights file is damaged.
        OSError: metrics.json cannot be written, for another reason than a folder or disk in which
            nothing can be written.
    """
    views = views_of(scene, split)
    if isinstance(lpips, Path | str):
        lpips = Lpips.load(Path(lpips))
    with single_threaded():  # so that the metrics do not depend on the number of cores
        evaluation = evaluate_views(
            scene.gaussians, views, background=scene.background, lpips=lpips, on_view=on_view
        )
    try:
        scene.folder.write_metrics(scene.iteration, split, evaluation.as_json())
    except OSError as error:  # the folder may be of somebody else; the figures are returned
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC):
            raise
        logger.warning("metrics.json was not written: %s", error)
    return evaluation


def views_of(scene: TrainedScene, split: Split) -> list[View]:
    """The views of a split. Raises: UserError: there are none."""
    views = scene.dataset.test if split == "test" else scene.dataset.train
    if not views:
        raise UserError(
            "no photos were held out for testing; train with `hold_out`, or evaluate the `split` "
            "train"
        )
    return views
