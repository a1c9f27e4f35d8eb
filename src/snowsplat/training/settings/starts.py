"""The names of the starts: where the first Gaussians come from; a start is registered here.

A start is a function that returns points; `initial_gaussians` makes one Gaussian of each. Those of
the package are in `snowsplat.training.starts`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

from snowsplat.util.messages import Message, message
from snowsplat.util.settings import suggestion

if TYPE_CHECKING:
    import torch

    from snowsplat.data.dataset import Dataset, Points
    from snowsplat.data.photos.image_loader import Photos

    #: dataset, its photos, maximum number of points, random generator on the CPU -> points in the
    #: world frame, on the CPU; there may be none.
    Start: TypeAlias = Callable[[Dataset, Photos, int, torch.Generator], Points]

#: The starts by name; None: that of the package, see `snowsplat.training.starts.start_of`.
STARTS: dict[str, Start | None] = {"points": None, "random": None, "depth": None, "sweep": None}


def register_start(name: str, start: Start) -> None:
    """Add a start under a name for ``TrainConfig.init``.

    Raises:
        ValueError: the name contains "+", which joins names.
    """
    if "+" in name:
        raise ValueError(f"{name!r}: a name must not contain +")
    STARTS[name] = start


def check_starts(names: str) -> Message | None:
    """What is wrong with names of starts, joined by "+"; None: nothing."""
    for name in names.split("+"):
        if name not in STARTS:
            advice = suggestion(name, list(STARTS)) or message(
                "use one of {names}", names=[*STARTS]
            )
            if name == names:
                return message("is unknown; {advice}", advice=advice)
            return message("is unknown ({name!r}); {advice}", name=name, advice=advice)
    return None
