"""Lines that tell the user what a training run has found in the photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

#: Largest number of photos that a line names.
_LISTED = 10


def sky_line(share: float) -> str:
    """The line about the sky: the share of the photos that shows it."""
    return f"the photos show the sky ({100 * share:.0f}% of them): the training starts with it"


def ended_early_line(steps: int, planned: int) -> str:
    """The line about a scene that began to overfit."""
    return f"stopped after {steps} of {planned} steps: the views between the photos became worse"


def left_out_line(names: Sequence[str]) -> str:
    """The line about photos that the scene does not explain; at least one name."""
    one = len(names) == 1
    photos, poses = ("photo is", "pose is") if one else ("photos are", "poses are")
    listed = ", ".join(names[:_LISTED])
    if len(names) > _LISTED:
        listed += f" and {len(names) - _LISTED} more"
    return (
        f"{len(names)} {photos} not explained by the scene and left out of the training: {listed}; "
        f"{'its' if one else 'their'} camera {poses} probably wrong"
    )


def moving_line(shares: Mapping[str, float], photos: int) -> str:
    """The line about what moves.

    Args:
        shares: the masked share of each photo in which something moves; at least one.
        photos: number of training photos.
    """
    mean = 100.0 * sum(shares.values()) / len(shares)
    return (
        f"something moves in {len(shares)} of {photos} photos: masked there, {mean:.1f}% of their "
        "pixels; see the report"
    )
