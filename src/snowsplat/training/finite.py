"""Numbers that are not finite: where they are, how many, and what the user reads about them.

A training stops at the step where they arise. What they would have changed stays as it was: a step
whose loss is not finite changes nothing, and an update that is not finite is not taken, number by
number (`ops.adam_step`). So the parameters between two steps are always finite.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.decode import LoadedImage
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError

_ADVICE = "train anew with lower learning rates"
_BEGIN = "begin with ones that are"


class Diverged(UserError):
    """A training that came to numbers that are not finite, and did not take them."""


def rows_not_finite(tensors: Mapping[str, Tensor]) -> dict[str, int]:
    """Name → how many rows hold infinity or NaN; names without such rows are left out."""
    found: dict[str, int] = {}
    for name, tensor in tensors.items():
        # A sum is fast and tells it nearly always; that of large numbers may overflow.
        if tensor.is_floating_point() and not bool(tensor.sum().isfinite()):
            rows = tensor.flatten(1) if tensor.ndim > 1 else tensor.reshape(-1, 1)
            count = int((~rows.isfinite()).any(dim=1).sum())
            found |= {name: count} if count else {}
    return found


def check_finite(what: str, tensors: Mapping[str, Tensor], advice: str) -> None:
    """Raises UserError unless all ``tensors`` are finite."""
    if found := rows_not_finite(tensors):
        raise UserError(f"{what} is not finite, rows of {_named(found)}; {advice}")


def check_state(own: Mapping[str, Tensor], given: Mapping[str, Tensor], views: int) -> None:
    """Whether a trainer of so many views, whose state is ``own``, may go on from ``given``.

    Raises:
        UserError: it is of another density control, SH degree or dataset, or not finite.
    """
    fits = own.keys() == given.keys() and all(
        (mine.dtype, mine.ndim, mine.shape[1:]) == (other.dtype, other.ndim, other.shape[1:])
        for mine, other in ((own[name], given[name]) for name in own)
    )
    # The kernels take one number of rows for all; random states are of one length.
    fixed = ("random.", "step", "order")
    rows = {len(t) for name, t in given.items() if not name.startswith(fixed) and t.ndim}
    fits = fits and len(rows) == 1
    fits = fits and all(
        own[name].shape == given[name].shape for name in own if name.startswith("random.")
    )
    if not fits or int(given["step"]) < 0 or not set(given["order"].tolist()) <= set(range(views)):
        raise UserError(
            "the checkpoint is of another dataset or recipe; go on with those it was made with"
        )
    check_finite("the checkpoint", given, "go on from an earlier one")


def check_parameters(step: int, gaussians: Gaussians) -> None:
    """Raises Diverged unless all are finite at ``step``."""
    if found := rows_not_finite(gaussians.parameters()):
        raise Diverged(f"Gaussians are not finite at step {step}, their {_named(found)}; {_BEGIN}")


def check_updates(step: int, nonfinite_rows: Sequence[float], gaussians: Gaussians) -> None:
    """``nonfinite_rows``: rows that a step skipped, per parameter; `ops.adam_step` counts them.

    Raises:
        Diverged: any.
    """
    if not any(nonfinite_rows):
        return
    check_parameters(step, gaussians)
    rows = zip(gaussians.parameters(), nonfinite_rows, strict=True)
    counts = {name: int(n) for name, n in rows if n}
    raise Diverged(
        f"the gradient of Gaussians is not finite at step {step}, or leads there, that of their "
        f"{_named(counts)}, and was not taken; {_ADVICE}"
    )


def check_loss(
    step: int, loss: float, gaussians: Gaussians, view: View, photo: LoadedImage
) -> None:
    """Finds what a loss comes from that is not finite.

    Raises:
        Diverged: it is not.
    """
    if math.isfinite(loss):
        return
    if there := rows_not_finite(gaussians.parameters()):
        reason = f"Gaussians are not finite, their {_named(there)}; {_BEGIN}"
    elif pixels := rows_not_finite({"": photo.planes.flatten(1).T}):
        reason = (
            f"{pixels['']:,} pixels of {view.name} are not finite; mend that photo or leave it out"
        )
    elif not view.camera.is_finite():
        reason = f"the camera of {view.name} is not finite; correct its pose or leave it out"
    else:
        reason = f"training has diverged; {_ADVICE}"
    raise Diverged(f"the loss is {loss} at step {step}, photo {view.name}: {reason}")


def _named(counts: Mapping[str, int]) -> str:
    """As in "means (3), quats (1)"."""
    return ", ".join(f"{name} ({count:,})" for name, count in counts.items())
