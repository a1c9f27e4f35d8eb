"""Detection of values that are not finite: their location, their number, the message to the user.

Training stops at the step in which such values occur. They do not change the state of the training:
a step with a non-finite loss changes nothing, and a non-finite update of a value is skipped
(`ops.adam_step`). So the parameters are always finite between two steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message, message, plural

if TYPE_CHECKING:
    from torch import Tensor

    from snowsplat.data.dataset import View
    from snowsplat.data.photos.decode import LoadedImage
    from snowsplat.scene.gaussians import Gaussians

_LOWER_RATES = message("use lower learning rates")
_FINITE_INIT = message("start from finite values")


class Diverged(UserError):
    """The loss, a gradient or a parameter is not finite; the step did not change the state."""


def rows_not_finite(tensors: Mapping[str, Tensor]) -> dict[str, int]:
    """Name → number of rows with infinity or NaN; only names with such rows."""
    found: dict[str, int] = {}
    for name, tensor in tensors.items():
        # The sum is a fast test. Because it may overflow for large finite values, the rows are
        # counted if it is not finite.
        if tensor.is_floating_point() and not bool(tensor.sum().isfinite()):
            rows = tensor.flatten(1) if tensor.ndim > 1 else tensor.reshape(-1, 1)
            count = int((~rows.isfinite()).any(dim=1).sum())
            found |= {name: count} if count else {}
    return found


def check_finite(what: Message, tensors: Mapping[str, Tensor], advice: Message) -> None:
    """Raises UserError ``"<what>: non-finite values in …; <advice>"`` unless all are finite."""
    if found := rows_not_finite(tensors):
        raise UserError(
            "{what}: non-finite values in {listed}; {advice}",
            what=what,
            listed=rows_text(found),
            advice=advice,
        )


def check_state(
    rows: Mapping[str, Tensor],
    common: Mapping[str, Tensor],
    given: Mapping[str, Tensor],
    views: int,
) -> None:
    """Check that a trainer can load a state.

    Args:
        rows: the part of the state of the trainer with one row for each Gaussian.
        common: the other part. Only ``order`` and the excluded views may have another size.
        given: the state to load.
        views: number of training views of the trainer.

    Raises:
        UserError: the state has another density control, SH degree or dataset, or is not finite.
    """
    own = {**rows, **common}
    fits = own.keys() == given.keys() and all(
        (mine.dtype, mine.ndim, mine.shape[1:]) == (other.dtype, other.ndim, other.shape[1:])
        for mine, other in ((own[name], given[name]) for name in own)
    )
    # The kernels take one number of rows for all tensors of Gaussians.
    fits = fits and len({len(given[name]) for name in rows}) == 1
    fits = fits and all(
        common[name].shape == given[name].shape
        for name in common
        if name not in ("order", "unexplained.left_out")
    )
    every = set(range(views))
    if fits and "unexplained.left_out" in given:
        excluded = set(given["unexplained.left_out"].tolist())
        fits = excluded < every
        every -= excluded
    if not fits or int(given["step"]) < 0 or not set(given["order"].tolist()) <= every:
        raise UserError(
            "the checkpoint: made with another dataset or recipe; resume with the original ones"
        )
    check_finite(message("the checkpoint"), given, message("resume from an earlier one"))


def check_parameters(step: int, gaussians: Gaussians) -> None:
    """Raises Diverged unless all parameters are finite at ``step``."""
    if found := rows_not_finite(gaussians.parameters()):
        raise Diverged(
            "step {step}: non-finite Gaussians, {listed}; {finite_init}",
            step=step,
            listed=rows_text(found),
            finite_init=_FINITE_INIT,
        )


def check_updates(step: int, nonfinite_rows: Sequence[float], gaussians: Gaussians) -> None:
    """Check the update of ``step``.

    ``nonfinite_rows``: for each parameter, the number of rows that `ops.adam_step` skipped.

    Raises: Diverged: rows were skipped.
    """
    if not any(nonfinite_rows):
        return
    check_parameters(step, gaussians)
    rows = zip(gaussians.parameters(), nonfinite_rows, strict=True)
    found = {name: int(count) for name, count in rows if count}
    raise Diverged(
        "step {step}: non-finite gradient or update in {listed}, skipped; {lower_rates}",
        step=step,
        listed=rows_text(found),
        lower_rates=_LOWER_RATES,
    )


def check_loss(
    step: int, loss: float, gaussians: Gaussians, view: View, photo: LoadedImage | None
) -> None:
    """Check the loss of ``step``; if it is not finite, find the cause.

    ``photo``: that of ``view``; None if another process has it.

    Raises: Diverged: the loss is not finite.
    """
    if math.isfinite(loss):
        return
    if found := rows_not_finite(gaussians.parameters()):
        cause = message(
            "from non-finite Gaussians, {rows}; {advice}",
            rows=rows_text(found),
            advice=_FINITE_INIT,
        )
    elif photo is not None and (pixels := rows_not_finite({"": photo.planes.flatten(1).T})):
        cause = message(
            "from {count:,} non-finite pixels; fix or remove that photo", count=pixels[""]
        )
    elif not view.camera.is_finite():
        cause = message("from a non-finite camera; correct its pose or remove that photo")
    else:
        cause = message("training has diverged; {advice}", advice=_LOWER_RATES)
    raise Diverged(
        "step {step}, photo {name}: the loss is {loss}, {cause}",
        step=step,
        name=view.name,
        loss=loss,
        cause=cause,
    )


def rows_text(counts: Mapping[str, int]) -> Message:
    """Text such as "means (3 rows), quats (1 row)"."""
    rows = [
        plural("{name} ({n:,} row)", "{name} ({n:,} rows)", n=count, name=name)
        for name, count in counts.items()
    ]
    return message("{rows}", rows=rows)
