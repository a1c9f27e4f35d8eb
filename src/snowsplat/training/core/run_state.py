"""The state of a training run as named tensors, for checkpoints.

The names of the tensors of a part begin with the name of the part. So a state tells which parts it
needs, and a run that has other parts is told which one is missing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat.training.parts.list import parts_of
from snowsplat.training.step.finite import check_state
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Before the names of the user's own parts and loss. The tensors have no elements: they only tell
#: that a run without them would continue differently.
_PART, _LOSS, _WITHOUT = "part.", "loss.", "without."
#: Names that a part cannot have, because other tensors of a state begin with them.
RESERVED = ("gaussians", "optimizer", "rows", "random", "step", "order", "part", "loss", "without")


def state_tensors(run: Run) -> dict[str, Tensor]:
    """See `Run.state_tensors`."""
    return run.shards.collected(row_tensors(run)) | _common_tensors(run)


def row_tensors(run: Run) -> dict[str, Tensor]:
    """The part of the state with one row for each Gaussian of this process."""
    groups = {
        "gaussians": run.gaussians.parameters(),
        "optimizer": run.optimizer.state_tensors(),
        "rows": run.rows,
    }
    groups |= {part.name: part.row_state() for part in run.parts}
    return {f"{group}.{name}": t for group, named in groups.items() for name, t in named.items()}


def _common_tensors(run: Run) -> dict[str, Tensor]:
    """The other part of the state, which is the same in all processes."""
    tensors = {f"random.{name}": g.get_state() for name, g in run.generators.items()}
    order = torch.tensor(run.queue.order, dtype=torch.int64)
    tensors |= {"step": torch.tensor(run.step), "order": order}
    tensors |= {name: torch.zeros(0) for name in _own(run)}
    for part in run.parts:
        tensors |= {f"{part.name}.{name}": tensor for name, tensor in part.state().items()}
    return tensors


def _own(run: Run) -> list[str]:
    """The names of what the configuration does not tell: the user's own parts and loss, and the
    parts of the configuration that the user left out.
    """
    usual = {part.name: type(part) for part in parts_of(run.config)}
    own = [_PART + part.name for part in run.parts if usual.get(part.name) is not type(part)]
    own += [_WITHOUT + name for name in usual.keys() - {part.name for part in run.parts}]
    if run.has_own_loss:
        own.append(_LOSS + getattr(run.loss, "__name__", type(run.loss).__name__))
    return own


def load_state(run: Run, tensors: dict[str, Tensor]) -> None:
    """See `Run.load_state`."""
    own = set(_own(run))
    _check_own(own, {name for name in tensors if name.startswith((_PART, _LOSS, _WITHOUT))})
    # What the user's own parts have saved is checked by themselves.
    unchecked = tuple(name.removeprefix(_PART) + "." for name in own)
    present = row_tensors(run)
    rows, common, given = (
        {name: tensor for name, tensor in state.items() if not name.startswith(unchecked)}
        for state in (present, _common_tensors(run), tensors)
    )
    check_state(rows, common, given, len(run.dataset.train))
    saved = present.keys() & tensors.keys()
    tensors = tensors | {name: run.shards.own_rows(tensors[name]) for name in sorted(saved)}

    def of(prefix: str) -> dict[str, Tensor]:
        return {n[len(prefix) :]: t for n, t in tensors.items() if n.startswith(prefix)}

    run.gaussians = run.gaussians.with_parameters(of("gaussians.")).clone().to(run.device)
    run.optimizer.load_state(of("optimizer."))
    for name, tensor in of("rows.").items():
        run.rows[name] = tensor.to(run.device, copy=True)
    run.runner.reset()
    for name, random in run.generators.items():
        try:
            random.set_state(tensors[f"random.{name}"])
        except RuntimeError:  # torch rejects an invalid state
            raise UserError(
                "the checkpoint: random state {name!r} is damaged; resume from an earlier one",
                name=name,
            ) from None
    run.step = int(tensors["step"])
    run.within_step = False
    for part in run.parts:
        try:
            part.load(of(f"{part.name}."))
        except (KeyError, RuntimeError, ValueError) as error:
            raise UserError(
                "the checkpoint: the state of the part {name!r} cannot be loaded ({name__}: "
                "{error}); use the part that wrote it",
                name=part.name,
                name__=type(error).__name__,
                error=error,
            ) from error
    run.queue.continue_with(tensors["order"].tolist(), run.step)


def _check_own(present: set[str], saved: set[str]) -> None:
    """Raises UserError unless a state was saved with the same parts and loss of the user."""
    for name in sorted(saved - present):
        what, _, key = name.partition(".")
        if what == "without":
            raise UserError(
                "the checkpoint: was made without the part {name!r}; leave it out again: parts=[…]",
                name=key,
            )
        how = "parts=[…], --import FILE" if what == "part" else "loss=…"
        raise UserError(
            "the checkpoint: was made with the {what} {name!r}, which is not part of the "
            "package; pass it again: {how}",
            what=what,
            name=key,
            how=how,
        )
    for name in sorted(present - saved):
        what, _, key = name.partition(".")
        if what == "without":
            raise UserError(
                "the checkpoint: was made with the part {name!r} of the package; use it again: "
                "parts_of(config)",
                name=key,
            )
        raise UserError(
            "the checkpoint: was made without the {what} {name!r}; resume without it, or start "
            "anew",
            what=what,
            name=key,
        )
