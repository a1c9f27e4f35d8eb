"""`parts_of`: which parts take part in a training; `hints`: which ones it could use."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, TypeVar

from snowsplat.training.parts.decay import Decay
from snowsplat.training.parts.densification import Densification
from snowsplat.training.parts.depth_supervision import DepthSupervision
from snowsplat.training.parts.exposure import Exposure, exposure_hint
from snowsplat.training.parts.limits import NearLimit, ScaleLimit, SmoothingFilter
from snowsplat.training.parts.misalignment import PoseCheck
from snowsplat.training.parts.normal_supervision import NormalSupervision
from snowsplat.training.parts.part import Part
from snowsplat.training.parts.pose_refinement import PoseRefinement
from snowsplat.training.parts.sky import SkyPart
from snowsplat.training.parts.surfaces import Surfaces
from snowsplat.training.parts.transients import Transients
from snowsplat.training.parts.unexplained import Unexplained
from snowsplat.training.settings.config import TrainConfig
from snowsplat.util.messages import Message

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

_Factory = TypeVar("_Factory", bound=Callable[[], Part])
_REGISTERED: list[Callable[[], Part]] = []


def register_part(make: _Factory) -> _Factory:
    """Let a part take part in the trainings of `train` and `make`; also a decorator of a class.

    ``make``: called without arguments for each training.
    """
    _REGISTERED.append(make)
    return make


def all_parts_of(config: TrainConfig) -> list[Part]:
    """Those of `parts_of`, and after them new objects of the parts of `register_part`."""
    return [*parts_of(config), *(make() for make in _REGISTERED)]


def parts_of(config: TrainConfig) -> list[Part]:
    """What takes part in a training with these settings, in order. This is the only list of parts.

    A new option is a field of `TrainConfig`, a part in its own file, and a line here.
    """
    parts: list[tuple[bool, Part]] = [
        (config.leave_out_after > 0, Unexplained(config.leave_out_after)),
        (config.refine_poses, PoseRefinement()),
        (not config.refine_poses, PoseCheck()),
        (config.exposure != "off", Exposure(config.exposure)),
        (config.transients != "off", Transients(config.transients)),
        (config.depth_weight > 0, DepthSupervision(config.depth_weight)),
        (config.depth_weight > 0, NormalSupervision(config.depth_weight)),
        (config.near_limit > 0, NearLimit(config.near_limit)),
        (config.sky, SkyPart(config.sky_distance)),
        (True, Densification(late=config.transients == "on")),
        (True, Decay(config.decay)),
        (config.relative_scale > 0, ScaleLimit(config.relative_scale)),
        (config.antialias, SmoothingFilter()),
        (config.surfaces, Surfaces()),
    ]
    return [part for used, part in parts if used]


def hints(run: Run, settings: Collection[str]) -> list[Message]:
    """Lines about parts that the photos need, but that are off in a training.

    ``settings``: names of those that the user has chosen.
    """
    off = run.config.exposure == "off" and "exposure" not in settings
    hint = exposure_hint(run) if off else None
    return [] if hint is None else [hint]
