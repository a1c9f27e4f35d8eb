"""The native functions on the device: which kernels each of them runs, and in which order.

Most functions are listed in `native/wgsl/plan.json`, which a page with WebGPU reads, too. It has
for each function its ``scratch`` memory and its ``steps``, one for each kernel. A step has

    file, entry   the kernel
    of, plus, items   the number of work groups: ceil((product of these fields + plus) / items);
                  by default, the field is n. ``groups``: this number itself
    bind          the field of a variable with another name
    set           numbers that are not fields; a text is the name of a field
    needs         the step is left out if this field is null or 0
    over          the step is left out if the image has no more tiles than this
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import torch

from snowsplat.ops.gaussian_parameters import PARAMETERS
from snowsplat.ops.webgpu.adapter import gpu
from snowsplat.ops.webgpu.kernels import run
from snowsplat.ops.webgpu.shaders import FOLDER
from snowsplat.ops.webgpu.tensor import DeviceTensor, empty
from snowsplat.util import native_library
from snowsplat.util.errors import UserError
from snowsplat.util.native_layout import TILE, Fields

_PIECE = 1 << 18  # splats whose gradients are in memory at the same time
_CHUNK = 32  # points of a chunk of `neighbours`; also chunks of a group
_MAPS_BYTES = 64 << 20  # of the maps of derivatives, if at least one channel fits


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
    if fields.get("camera.intrinsics") is not None:
        numbers = fields["camera.intrinsics"].tolist()
        names = ("camera.fx", "camera.fy", "camera.cx", "camera.cy")
        fields = {**fields, **dict(zip(names, numbers, strict=True))}
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
        count = _count(needs, values) if "items" in needs else 1
        values[scratch] = empty(max(4, count * needs["bytes"]), torch.uint8)
    for step in plan["steps"]:
        if "needs" in step and not _is_given(values[step["needs"]]):
            continue
        if "over" in step and values["binning_tiles_x"] * values["binning_tiles_y"] <= step["over"]:
            continue
        given = dict(values)
        for number, value in step.get("set", {}).items():
            given[number] = values[value] if isinstance(value, str) else value
        for variable, field in step.get("bind", {}).items():
            given[variable] = values[field]
        groups = step["groups"] if "groups" in step else _count(step, values)
        run(step["file"], step["entry"], groups, given)


def _count(needs: dict[str, Any], values: dict[str, Any]) -> int:
    items = math.prod(int(values[field]) for field in needs.get("of", ["n"]))
    return -(-(items + needs.get("plus", 0)) // needs["items"])


def _is_given(value: Any) -> bool:
    return value is not None and (isinstance(value, torch.Tensor) or value != 0)


def _capacity(p: Fields) -> int:
    return int(p["required"].item()) if p["capacity"] < 0 else int(p["capacity"])


def _project_bwd(p: Fields) -> int:
    if p["pose"] is not None:
        return _project_bwd_on_cpu(p)
    for piece in _pieces(p, p["n"], p["gaussians.sh_degree"]):
        follow("project_rows", {**p, **piece})
        follow("project_add", {**p, **piece})
    return 0


def _project_bwd_on_cpu(p: Fields) -> int:
    """Also the gradient of the pose: its sums need float64, which WGSL has not."""
    visible = p["ids"].cpu() >= 0
    fields = {name: _on_host(value) for name, value in p.items()}
    fields["ids"], fields["grad_packed"] = fields["ids"][visible], fields["grad_packed"][visible]
    fields["n"] = len(fields["ids"])
    blocks = native_library.call("project_pose_blocks", {"n": fields["n"], "tiles": 0, "parts": 0})
    fields["pose"] = fields["pose"].zero_()[:blocks]
    native_library.call("project_bwd", fields)
    for name, value in p.items():
        if value is not None and (name == "pose" or name.startswith("grads.")):
            value.memory.changed_on_host()
    return 0


def _on_host(value: Any) -> Any:
    return value.on_host() if isinstance(value, DeviceTensor) else value


def _pieces(p: Fields, splats: int, sh_degree: int) -> Iterator[dict[str, Any]]:
    """Memory for the gradients of some of the splats, as fields of the kernels."""
    width = 11 + 3 * (sh_degree + 1) ** 2
    rows = empty((min(splats, _PIECE), width), torch.float32)
    for first in range(0, splats, _PIECE):
        count = min(_PIECE, splats - first)
        yield {"n": count, "first": first, "rows": rows, "count": count, "width": width}


def _adam_step(p: Fields) -> int:
    n, splats, splat_of, degree = p["n"], p["splats"], p["ids"], p["sh_degree"]
    if splats != n:  # the rows of the splats are compacted
        splat_of = torch.full((n,), -1, dtype=torch.int32, device=splat_of.device)
        follow("adam_splat_of", {"n": n, "splats": splats, "ids": p["ids"], "found": splat_of})
    columns = 3 * ((degree + 1) ** 2 - 1)
    rule = dict(p) | {
        "splat_of": splat_of,
        "gain1": 1 - p["beta1"],
        "gain2": 1 - p["beta2"],
        "sh_columns": columns,
        "sh_stride": 3 * p["sh_rest_rows"],
    }
    if p["grad_packed"] is None or splats == 0:
        follow("adam_update", rule, first=0, rows=None, count=0, width=0)
        return 0
    gaussians = {f"gaussians.{name}": p[f"{name}.value"] for name in PARAMETERS}
    gaussians |= {f"gaussians.{name}": p[name] for name in ("sh_rest_rows", "sh_degree")}
    for piece in _pieces(p, splats, degree):
        follow("project_rows", {**p, **gaussians, **piece}, gaussians_sh_dc_rows=1)
        follow("adam_update", rule | piece | {"n": n})
    return 0


def _photometric(p: Fields, *, of_bytes: bool) -> int:
    channels, width, height, grad = p["n"], p["width"], p["height"], p["grad"]
    tiles, values = -(-width // TILE) * -(-height // TILE), channels * width * height
    sums = empty((channels * tiles, 3), torch.float32)
    size = 12 * width * height  # bytes of the derivatives of a channel
    at_once = channels if grad is None else max(1, min(channels, _MAPS_BYTES // size))
    weights = {name: p[name] / values for name in ("l1_weight", "ssim_weight", "huber_weight")}
    parts = {"tiles": tiles, "parts": channels * tiles, "sums": sums, "values": values}
    fields = dict(p) | weights | parts | {"bytes": int(of_bytes)}
    fields["maps"] = None if grad is None else empty(at_once * size // 4, torch.float32)
    for first in range(0, channels, at_once):
        follow("photometric", fields | {"n": min(at_once, channels - first)}, first=first)
    follow("photometric_means", fields)
    return 0


def _add_noise(p: Fields) -> int:
    numbers = {}
    for name in ("seed", "first"):
        numbers[f"{name}_low"], numbers[f"{name}_high"] = p[name] & 0xFFFFFFFF, p[name] >> 32
    follow("add_noise", p, **numbers)
    return 0


def _plane_sweep(p: Fields) -> int:
    follow("plane_sweep", p, tiles=-(-p["width"] // TILE) * -(-p["height"] // TILE))
    return 0


def _neighbours(p: Fields) -> int:
    n, points = p["n"], p["points"]
    if n == 0:
        return 0
    half_low, half_high = (0.5 * end for end in torch.aminmax(points, dim=0))
    box = dict(zip(("half_low_x", "half_low_y", "half_low_z"), half_low.tolist(), strict=True))
    box["half_extent"] = float((half_high - half_low).max())
    codes, codes2, order, order2 = (empty(n, torch.int32) for _ in range(4))
    follow("neighbours_codes", p, codes=codes, **box)
    sort = {"n": n, "keys": codes, "keys2": codes2, "order": order, "order2": order2}
    follow("splats_sort", sort)
    chunks = -(-n // _CHUNK)
    follow("neighbours_search", p, order=order, chunks=chunks, groups=-(-chunks // _CHUNK))
    return 0


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
    "project_pose_blocks": lambda p: native_library.call("project_pose_blocks", p),
    "project_bwd": _project_bwd,
    "adam_step": _adam_step,
    "photometric": functools.partial(_photometric, of_bytes=False),
    "photometric_u8": functools.partial(_photometric, of_bytes=True),
    "add_noise": _add_noise,
    "neighbours": _neighbours,
    "plane_sweep": _plane_sweep,
}
