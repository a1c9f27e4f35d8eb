"""What the operations read: the six tensors of Gaussians, and the `View` of an image."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from snowsplat.ops.check import check_float, check_size, check_tensor
from snowsplat.ops.native import Struct

#: Their names, in the order of the native functions.
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


class GaussianParameters(Protocol):
    """N Gaussians, for example a `snowsplat.Gaussians`; all tensors are float32, or all float64."""

    means: Tensor  # (N, 3), in world units
    log_scales: Tensor  # (N, 3)
    quats: Tensor  # (N, 4) wxyz, not necessarily normalised; zero means no rotation
    opacity_logits: Tensor  # (N,)
    sh_dc: Tensor  # (N, 1, 3)
    sh_rest: Tensor  # (N, K, 3)


def checked_parameters(op: str, gaussians: GaussianParameters, sh_degree: int) -> dict[str, Tensor]:
    """The tensors by name.

    Raises ValueError unless they are the parameters of the same Gaussians, and `sh_rest` has the
    rows of the degree.
    """
    means = gaussians.means
    check_float(op, "means", means)
    n = means.shape[0] if means.dim() else None
    shapes = ((n, 3), (n, 3), (n, 4), (n,), (n, 1, 3), (n, None, 3))
    tensors = {name: getattr(gaussians, name) for name in PARAMETERS}
    for (name, tensor), shape in zip(tensors.items(), shapes, strict=True):
        check_tensor(op, name, tensor, shape, means)
    rows = tensors["sh_rest"].shape[1]
    if rows < (sh_degree + 1) ** 2 - 1:
        raise ValueError(f"{op}: sh_rest has too few rows ({rows}) for degree {sh_degree}")
    return tensors


def check_each(
    op: str, what: str, given: Mapping[str, Tensor], tensors: Mapping[str, Tensor]
) -> None:
    """Raises ValueError unless `given` has a tensor of the same shape for each of `tensors`."""
    missing = [name for name in tensors if name not in given]
    if missing:
        raise ValueError(f"{op}: {what} has no {', '.join(missing)}")
    for name, tensor in tensors.items():
        check_tensor(op, f"{what}[{name!r}]", given[name], tuple(tensor.shape), tensor)


def gaussian_tensors(tensors: Mapping[str, Tensor], sh_degree: int) -> Struct:
    """The parameters, contiguous, as a parameter of native functions."""
    contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    rows = {"sh_rest_rows": tensors["sh_rest"].shape[1], "sh_degree": sh_degree, "sh_dc_rows": 1}
    return contiguous | rows


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera, its pose, and the options of the projection: an argument of `project`.

    A world point p with R p + t = (x, y, z), z > 0, is seen at (fx·x/z + cx, fy·y/z + cy), in
    pixels from the upper left corner of the image. Pixel (i, j) has its centre at
    (i + 0.5, j + 0.5). `scene.render.view_of` makes the view of a `Camera`.

    Attributes:
        cam_from_world: (3, 4): [R | t], with the axes of OpenCV (x right, y down, z forward), of
            any floating dtype and device; it may require grad.
        width, height: of the image, in pixels.
        fx, fy, cx, cy: focal lengths and principal point, in pixels.
        sh_degree: 0 to 3, the degree of the spherical harmonics.
        near: > 0, in world units. Gaussians that are nearer are not visible.
        intrinsics: (4,) float64 on the device of the Gaussians: fx, fy, cx and cy, which the
            kernels read in place of the four numbers when they run; not checked. None: the numbers.
        antialiased: multiply opacities by √(det(J W Σ Wᵀ Jᵀ) / det Σ'), and use d = 0.1 for the
            low-pass filter: the 2D mip filter of Yu et al. 2024. See `project`.

    Raises:
        ValueError: the image has no pixels, an intrinsic is not finite, a focal length or `near` is
            not positive, `sh_degree` is not 0 to 3, or the pose is not (3, 4).
    """

    cam_from_world: Tensor
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    sh_degree: int = 0
    near: float = 0.2
    antialiased: bool = False
    intrinsics: Tensor | None = None

    def __post_init__(self) -> None:
        check_size("View", self.width, self.height)
        if self.cam_from_world.shape != (3, 4):
            raise ValueError(
                f"View: cam_from_world must be (3, 4), got {tuple(self.cam_from_world.shape)}"
            )
        for name in ("fx", "fy", "near"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"View: {name} must be positive and finite, got {value}")
        for name in ("cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"View: {name} must be finite, got {getattr(self, name)}")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"View: sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")


def camera_params(view: View, like: Tensor) -> Struct:
    """The camera as a parameter of native functions, its pose in the dtype of `like`."""
    pose = view.cam_from_world.to(like.device, like.dtype, non_blocking=True)
    names = ("width", "height", "fx", "fy", "cx", "cy", "near")
    numbers = {name: float(getattr(view, name)) for name in names}
    return {
        "cam_from_world": pose.contiguous(),
        **numbers,
        "intrinsics": view.intrinsics,
        "antialiased": view.antialiased,
    }
