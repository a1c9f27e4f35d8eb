"""The parameters of every native operation: the same structs as in `native/params.h`.

The meaning of the fields and the shapes of the tensors are documented there. `ENTRIES` has the
struct of each operation. The layouts are compared when the library is loaded.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from snowsplat.util.native_layout import Params

# ------------------------------------------------------------------- parts of the structs below


@dataclass(slots=True, kw_only=True)
class CameraParams(Params):
    cam_from_world: Tensor
    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    antialiased: bool


@dataclass(slots=True, kw_only=True)
class GaussianTensors(Params):
    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    sh_rest_rows: int
    sh_degree: int
    sh_dc_rows: int


@dataclass(slots=True, kw_only=True)
class GaussianGradients(Params):
    means: Tensor | None = None
    log_scales: Tensor | None = None
    quats: Tensor | None = None
    opacity_logits: Tensor | None = None
    sh_dc: Tensor | None = None
    sh_rest: Tensor | None = None


# ------------------------------------------------------------------------------------- project


@dataclass(slots=True, kw_only=True)
class ProjectCullParams(Params):
    n: int
    gaussians: GaussianTensors
    camera: CameraParams
    ids: Tensor


@dataclass(slots=True, kw_only=True)
class ProjectForwardParams(Params):
    n: int
    ids: Tensor
    gaussians: GaussianTensors
    camera: CameraParams
    packed: Tensor


@dataclass(slots=True, kw_only=True)
class ProjectBackwardParams(Params):
    n: int
    ids: Tensor
    gaussians: GaussianTensors
    camera: CameraParams
    grad_packed: Tensor
    grads: GaussianGradients
    pose: Tensor | None
    rounding: float = 0.0


# ----------------------------------------------------------------------------------- adam_step


@dataclass(slots=True, kw_only=True)
class AdamTensor(Params):
    value: Tensor
    m: Tensor
    v: Tensor
    extra: Tensor | None
    rate: float


@dataclass(slots=True, kw_only=True)
class AdamStepParams(Params):
    n: int
    splats: int
    ids: Tensor
    grad_packed: Tensor | None
    camera: CameraParams
    sh_rest_rows: int
    sh_degree: int
    means: AdamTensor
    log_scales: AdamTensor
    quats: AdamTensor
    opacity_logits: AdamTensor
    sh_dc: AdamTensor
    sh_rest: AdamTensor
    beta1: float
    beta2: float
    inv_correction2: float
    eps2: float
    visible_only: bool
    valid: Tensor | None
    nonfinite_rows: Tensor | None


# ---------------------------------------------------------------- accumulate_screen_statistics


@dataclass(slots=True, kw_only=True)
class ScreenStatisticsParams(Params):
    n: int
    ids: Tensor
    packed: Tensor
    stride: int
    grad_means: Tensor
    grad_stride: int
    width: float
    height: float
    norm_sum: Tensor
    views: Tensor
    max_radii: Tensor | None
    valid: Tensor | None


# ---------------------------------------------------------------- rasterize: splats → tiles


@dataclass(slots=True, kw_only=True)
class SplatsPrepareParams(Params):
    n: int
    packed: Tensor
    stride: int
    width: int
    height: int
    columns: Tensor
    records: Tensor
    keys: Tensor


@dataclass(slots=True, kw_only=True)
class SplatsRecolorParams(Params):
    n: int
    packed: Tensor
    stride: int
    columns: Tensor
    records: Tensor


@dataclass(slots=True, kw_only=True)
class SplatsSortParams(Params):
    n: int
    keys: Tensor
    keys2: Tensor
    order: Tensor
    order2: Tensor


@dataclass(slots=True, kw_only=True)
class TileBinning(Params):
    order: Tensor
    packed: Tensor
    stride: int
    records: Tensor
    tiles_x: int
    tiles_y: int
    parts: int
    workspace: Tensor
    tile_start: Tensor


@dataclass(slots=True, kw_only=True)
class TilesCountParams(Params):
    n: int
    binning: TileBinning
    capacity: int
    required: Tensor


@dataclass(slots=True, kw_only=True)
class TilesFillParams(Params):
    n: int
    binning: TileBinning
    capacity: int
    instance_splat: Tensor
    instance_slot: Tensor | None
    slot_range: Tensor | None


# ---------------------------------------------------------- rasterize: tiles → image and back


@dataclass(slots=True, kw_only=True)
class FrameParams(Params):
    width: int
    height: int
    packed: Tensor
    stride: int
    columns: Tensor
    records: Tensor
    tile_start: Tensor
    tile_end: Tensor
    instance_splat: Tensor
    instance_blocks: Tensor
    additive: bool


@dataclass(slots=True, kw_only=True)
class RasterizeForwardParams(Params):
    n: int
    frame: FrameParams
    channels: int
    background: Tensor
    image: Tensor
    alpha: Tensor | None


@dataclass(slots=True, kw_only=True)
class RasterizeCountParams(Params):
    n: int
    frame: FrameParams
    counts: Tensor


@dataclass(slots=True, kw_only=True)
class RasterizeBackwardParams(Params):
    n: int
    frame: FrameParams
    channels: int
    instance_slot: Tensor | None
    image: Tensor
    grad_image: Tensor
    alpha: Tensor
    grad_alpha: Tensor | None
    slots: Tensor | None
    grad_packed: Tensor
    abs_grad: Tensor | None


@dataclass(slots=True, kw_only=True)
class SplatsReduceParams(Params):
    n: int
    slots: Tensor
    slot_range: Tensor
    packed: Tensor
    stride: int
    channels: int
    columns: Tensor
    add: bool
    grad_packed: Tensor
    abs_grad: Tensor | None


@dataclass(slots=True, kw_only=True)
class BackgroundBackwardParams(Params):
    n: int
    width: int
    channels: int
    grad_image: Tensor
    alpha: Tensor
    rows: Tensor


# -------------------------------------------------------- photometric, neighbours, plane_sweep


@dataclass(slots=True, kw_only=True)
class PhotometricParams(Params):
    n: int
    width: int
    height: int
    image: Tensor
    target: Tensor
    l1_weight: float
    ssim_weight: float
    huber_weight: float
    grad: Tensor | None
    means: Tensor


@dataclass(slots=True, kw_only=True)
class NeighboursParams(Params):
    n: int
    points: Tensor
    k: int
    distances: Tensor


@dataclass(slots=True, kw_only=True)
class PlaneSweepParams(Params):
    n: int
    width: int
    height: int
    source_width: int
    source_height: int
    image: Tensor
    sources: Tensor
    source_from_pixel: Tensor
    centre: Tensor | None
    first: float
    step: float
    planes: int
    radius: int
    inverse_depth: Tensor
    score: Tensor


@dataclass(slots=True, kw_only=True)
class PointsInFrustaParams(Params):
    n: int
    points: Tensor
    views: int
    to_image: Tensor
    size: Tensor
    depths: Tensor
    focal: Tensor
    counts: Tensor
    rates: Tensor


@dataclass(slots=True, kw_only=True)
class FuseDepthParams(Params):
    n: int
    side: int
    spacing: float
    origins: Tensor
    to_image: Tensor
    width: int
    height: int
    depth: Tensor
    weight: Tensor
    channels: int
    image: Tensor | None
    truncation: float
    sums: Tensor


# --------------------------------------------------------------------------------------- sizes


@dataclass(slots=True, kw_only=True)
class SizeQueryParams(Params):
    n: int = 0
    tiles: int = 0
    parts: int = 0


#: The struct of every operation on the CPU. The operations for float64 tensors, with the suffix
#: "_f64", have the same structs. A GPU also has `splats_reduce`.
ENTRIES: dict[str, type[Params]] = {
    "project_cull": ProjectCullParams,
    "project_fwd": ProjectForwardParams,
    "project_bwd": ProjectBackwardParams,
    "project_pose_blocks": SizeQueryParams,
    "adam_step": AdamStepParams,
    "accumulate_screen_statistics": ScreenStatisticsParams,
    "splat_record_bytes": SizeQueryParams,
    "splats_prepare": SplatsPrepareParams,
    "splats_recolor": SplatsRecolorParams,
    "splats_sort": SplatsSortParams,
    "tiles_parts": SizeQueryParams,
    "tiles_workspace_bytes": SizeQueryParams,
    "tiles_count": TilesCountParams,
    "tiles_fill": TilesFillParams,
    "rasterize_block_bytes": SizeQueryParams,
    "rasterize_has_slots": SizeQueryParams,
    "rasterize_fwd": RasterizeForwardParams,
    "rasterize_median": RasterizeForwardParams,
    "rasterize_count": RasterizeCountParams,
    "rasterize_bwd": RasterizeBackwardParams,
    "background_bwd": BackgroundBackwardParams,
    "photometric": PhotometricParams,
    "photometric_u8": PhotometricParams,
    "neighbours": NeighboursParams,
    "plane_sweep": PlaneSweepParams,
    "points_in_frusta": PointsInFrustaParams,
    "fuse_depth": FuseDepthParams,
}
