"""The native functions on the device: which kernels each of them runs, and in which order.

Most functions are listed in `native/wgsl/plan.json`, which a page with WebGPU reads, too. It has
for each function its ``scratch`` memory and its ``steps``, one for each kernel. The number of work
groups of a step is ceil(value of the field ``of`` / ``items``); ``set`` has further numbers;
``bind`` tells which field a variable gets if their names differ; ``when`` tells for which values of
fields the step is run.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from typing import Any

import torch

from snowsplat.ops.webgpu.adapter import gpu
from snowsplat.ops.webgpu.kernels import run
from snowsplat.ops.webgpu.shaders import FOLDER
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import Fields


@functools.cache
def _plan() -> dict[str, Any]:
    plan: dict[str, Any] = json.loads((FOLDER / "plan.json").read_text(encoding="utf-8"))
    return plan


def launch(name: str, fields: Fields) -> int:
    """Queue the kernels of a native function, and submit them.

    Raises: UserError: the function has no kernels for this device.
    """
    with gpu().lock:
        result = _launched(name, fields)
        gpu().submit()
    return result


def _launched(name: str, fields: Fields) -> int:
    if name in SEQUENCES:
        return SEQUENCES[name](fields)
    if name not in _plan():
        raise UserError("webgpu has no kernels for {name}; use device cpu or cuda", name=name)
    follow(name, fields)
    return RESULTS[name](fields) if name in RESULTS else 0


def follow(name: str, fields: Fields, **more: Any) -> None:
    """Queue the steps of a function in the plan; ``more``: values that are not fields."""
    plan = _plan()[name]
    values = {field.replace(".", "_"): value for field, value in fields.items()} | more
    for scratch, needs in plan.get("scratch", {}).items():
        count = -(-values[needs["of"]] // needs["items"])
        values[scratch] = torch.empty(
            count * needs["bytes"], dtype=torch.uint8, device=torch.device("webgpu", 0)
        )
    for step in plan["steps"]:
        if any(values[field] != value for field, value in step.get("when", {}).items()):
            continue
        given = values | step.get("set", {})
        given |= {variable: values[field] for variable, field in step.get("bind", {}).items()}
        run(step["file"], step["entry"], -(-int(given[step["of"]]) // step["items"]), given)


def _capacity(p: Fields) -> int:
    return int(p["required"].item()) if p["capacity"] < 0 else int(p["capacity"])


def _size(value: int) -> Callable[[Fields], int]:
    return lambda p: value


#: The results of functions in the plan; the others return 0.
RESULTS: dict[str, Callable[[Fields], int]] = {
    "project_cull": lambda p: int(p["n"]),
    "tiles_count": _capacity,
}

#: The functions that are more than a list of kernels.
SEQUENCES: dict[str, Callable[[Fields], int]] = {
    "splat_record_bytes": _size(0),
    "splats_recolor": _size(0),
    "tiles_parts": _size(0),
    "tiles_workspace_bytes": lambda p: 16 + 16 * int(p["n"]),
    "rasterize_block_bytes": _size(4),
    "rasterize_has_slots": _size(1),
    "rasterize_boundaries": _size(0),
}
