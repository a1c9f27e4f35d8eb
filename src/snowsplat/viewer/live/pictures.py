"""`draw`: renders an image of Gaussians for the display settings and the camera of a browser."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.splats import COLORS, CONICS, OPACITIES, Splats2D
from snowsplat.scene.camera import NEAR, Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import invert_rigid, rotation_from_quat
from snowsplat.scene.render import project
from snowsplat.util.process import single_threaded

_DOT = 0.8  # pixels: standard deviation of the dot that represents a Gaussian as a point
_ELLIPSOID_END = 1.5  # semi-axes of the ellipsoids, in standard deviations
_ELLIPSOID_OPACITY = 0.1  # Gaussians below this opacity are not shown as ellipsoids
# A Gaussian with the opacity exp(_DISC) looks like a disc. With its scaled conic, d is the
# Mahalanobis distance from its centre: α has its maximum up to ½ d² = _DISC and is 0 from
# ½ d² = _DISC + 5.5 on. The radii at these distances differ by 3%.
_DISC = 80.0
_MAX_ERROR = 0.25  # mean absolute colour difference at the end of the palette
_MAX_COUNT = 256.0  # number of Gaussians at the end of the palette
_MIN_ALPHA = 0.5  # pixels of lower opacity have neither depth nor normal
_BRIGHTNESS_AROUND = 0.35  # factor for the rendering outside of the rectangle of a photo
Mode = Literal["color", "depth", "alpha", "normals", "points", "ellipsoids", "cost", "error"]
Vector = tuple[float, float, float]
_NARROWEST = math.radians(1.0)  # field of view
_WIDEST = math.radians(170.0)
_MAX_SIDE = 16384  # pixels of a window
_LONGEST = 320, 2560  # limits of the longer side of an image, in pixels
_SCALE = 0.02, 1.0  # limits of the size of the Gaussians
# The norm of a quaternion is above this value and below its inverse.
_SMALL = 1e-9
_MAX_COORDINATE = 1e15  # computations in float32 are finite below it


def _table(*anchors: tuple[int, int, int]) -> Tensor:
    places = np.linspace(0.0, 255.0, len(anchors))
    columns = [np.interp(np.arange(256), places, column) for column in zip(*anchors, strict=True)]
    return torch.from_numpy(np.rint(np.stack(columns, 1)).astype(np.uint8))


# Colour maps: (256, 3) uint8 tables. The lightness of both increases monotonically.
# DEPTH: from far (violet) through blue and green to near (yellow).
DEPTH = _table(
    (68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81), (253, 231, 37)
)
# HEAT: from small (black) through violet and orange to large (pale yellow).
HEAT = _table(
    (0, 0, 0), (51, 10, 95), (136, 34, 106), (211, 67, 67), (251, 140, 20), (252, 255, 164)
)


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo with which a rendering is compared."""

    pixels: Tensor  # (h, w, 3) uint8, at the size of ``placed``
    placed: PhotoRectangle  # the rectangle of the photo in the image


@torch.no_grad()
def draw(
    gaussians: Gaussians,
    camera: Camera,
    display: Display,
    background: Tensor | None = None,
    photo: Photo | None = None,
) -> np.ndarray:
    """(H, W, 3) uint8: the Gaussians with these display settings, from ``camera``.

    ``background`` (3,) is in 0..1, black by default. The mode "error" needs a photo; without one
    it shows colours.
    """
    with single_threaded():
        image = _in_mode(gaussians, camera, display, background, photo)
        if photo is not None:
            image = _with_photo(image, photo, display)
        return image.contiguous().numpy()  # on the CPU, for Gaussians on any device


def _in_mode(
    gaussians: Gaussians,
    camera: Camera,
    display: Display,
    background: Tensor | None,
    photo: Photo | None,
) -> Tensor:
    """(H, W, 3) uint8, on the CPU: the rendering in the display mode, without the photo."""
    if background is not None:
        background = background.to(gaussians.means.device)
    if display.scale != 1.0 and display.mode != "points":
        log_scales = gaussians.log_scales + math.log(display.scale)
        gaussians = dataclasses.replace(gaussians, log_scales=log_scales)
    splats = project(gaussians, camera, display.degree).without_empty_rows()
    if display.crop is not None:
        splats = _cropped(splats, gaussians, display.crop)
    size = camera.width, camera.height
    if display.mode == "depth":
        _, alpha, depth = ops.rasterize(splats, *size, background, with_depth=True)
        assert depth is not None
        return _depth(depth, alpha)
    if display.mode == "alpha":
        _, alpha, _ = ops.rasterize(splats, *size)
        return _bytes(alpha)[:, :, None].expand(-1, -1, 3)
    if display.mode == "normals":
        return _normals(splats, gaussians, camera)
    if display.mode == "points":
        splats = _as_points(splats)
    elif display.mode == "ellipsoids":
        splats = _as_ellipsoids(splats, gaussians, camera)
    elif display.mode == "cost":
        counts = ops.count_blended(splats, *size)
        return HEAT[_palette_indices(torch.log1p(counts) / math.log1p(_MAX_COUNT))]
    image, _, _ = ops.rasterize(splats, *size, background)
    if display.mode == "error" and photo is not None:
        return _error(image.cpu(), photo)
    return _bytes(image)


def _bytes(values: Tensor) -> Tensor:
    """0..1 to uint8, rounded to the nearest, on the CPU."""
    return values.clamp(0.0, 1.0).mul_(255.0).add_(0.5).to(torch.uint8).cpu()


def _palette_indices(values: Tensor) -> Tensor:
    """0..1 to indices into a palette."""
    return _bytes(values.nan_to_num()).long()


def _cropped(
    splats: Splats2D,
    gaussians: Gaussians,
    crop: tuple[tuple[float, float, float], tuple[float, float, float]],
) -> Splats2D:
    """The splats whose Gaussians have their centres in the box."""
    low, high = (gaussians.means.new_tensor(corner) for corner in crop)
    assert splats.ids is not None
    means = gaussians.means[splats.ids.long()]
    inside = ((means >= low) & (means <= high)).all(1).nonzero()[:, 0]
    return Splats2D(splats.packed[inside], splats.ids[inside], splats.channels)


def _depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Colours that are linear in the disparity, 1/z, between its 1% and 99% quantiles."""
    shown = alpha >= _MIN_ALPHA
    disparity = alpha / depth.clamp_min(1e-9)
    some = disparity[::4, ::4][shown[::4, ::4]]
    if not len(some):
        return torch.zeros(*depth.shape, 3, dtype=torch.uint8)
    far, near = torch.quantile(some[:: 1 + len(some) // 10_000], some.new_tensor([0.01, 0.99]))
    share = (disparity - far) / (near - far).clamp_min(1e-6 * float(near))
    return DEPTH[_palette_indices(share)] * shown[:, :, None].cpu()


def _axes(splats: Splats2D, gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """The shortest axes (M, 3) of the Gaussians of splats, and the cosines (M,) of their angles.

    An axis is a unit vector in the camera frame, towards the camera. The angle is between the axis
    and the direction from the Gaussian to the camera, so the cosine is in 0..1.
    """
    assert splats.ids is not None
    ids = splats.ids.long()
    unit = torch.eye(3, dtype=gaussians.quats.dtype, device=gaussians.quats.device)
    shortest = unit[gaussians.log_scales[ids].argmin(1)]
    w, q = gaussians.rotations[ids].split([1, 3], 1)
    # v + 2 q × (q × v + w v)
    axes = shortest + 2.0 * torch.linalg.cross(q, torch.linalg.cross(q, shortest) + w * shortest)
    to_camera = camera.position.to(axes) - gaussians.means[ids]
    facing = (axes * to_camera).sum(1)
    axes = torch.where(facing[:, None] < 0, -axes, axes)
    straight = facing.abs() / to_camera.norm(dim=1).clamp_min(1e-9)
    return axes @ camera.cam_from_world[:, :3].T.to(axes), straight


def _normals(splats: Splats2D, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Red: right, green: up, blue: towards the camera."""
    axes, _ = _axes(splats, gaussians, camera)
    # The axes are blended as colours, then normalised: this gives the direction of the mean axis.
    packed = splats.packed.clone()
    packed[:, COLORS : COLORS + 3] = axes
    coloured = Splats2D(packed, splats.ids, splats.channels)
    image, alpha, _ = ops.rasterize(coloured, camera.width, camera.height)
    length = image.permute(2, 0, 1).square().sum(0).sqrt_().clamp_min_(1e-9)  # plane by plane
    normals = image / length[:, :, None] * image.new_tensor([0.5, -0.5, -0.5])
    return _bytes((normals + 0.5) * (alpha >= _MIN_ALPHA)[:, :, None])


def _as_points(splats: Splats2D) -> Splats2D:
    """Shows each Gaussian as a dot of its colour."""
    packed = splats.packed.clone()
    packed[:, CONICS] = packed.new_tensor([1.0, 0.0, 1.0]) / _DOT**2
    packed[:, OPACITIES] = 1.0
    return Splats2D(packed, splats.ids, splats.channels)


def _as_ellipsoids(splats: Splats2D, gaussians: Gaussians, camera: Camera) -> Splats2D:
    """Shows each Gaussian as an opaque disc with a sharp edge; oblique surfaces are darker."""
    assert splats.ids is not None
    _, straight = _axes(splats, gaussians, camera)
    shortest, middle = gaussians.log_scales[splats.ids.long()].sort(1).values[:, :2].unbind(1)
    roundness = torch.exp(shortest - middle)  # a round Gaussian has no shortest axis
    light = 0.4 + 0.6 * (straight + (1.0 - straight) * roundness)
    packed = splats.packed.clone()
    packed[:, COLORS : COLORS + 3] *= light[:, None]
    opaque = (packed[:, OPACITIES] >= _ELLIPSOID_OPACITY).nonzero()[:, 0]
    packed = packed[opaque]
    packed[:, CONICS] *= 2.0 * _DISC / _ELLIPSOID_END**2
    packed[:, OPACITIES] = math.exp(_DISC)
    return Splats2D(packed, splats.ids[opaque], splats.channels)


def _error(image: Tensor, photo: Photo) -> Tensor:
    """The colour difference inside the rectangle of the photo; the rendering around it."""
    image = _bytes(image)
    at = photo.placed
    rows, columns = slice(at.top, at.top + at.height), slice(at.left, at.left + at.width)
    rendered, real = image[rows, columns].to(torch.float32), photo.pixels.to(torch.float32)
    error = (rendered - real).abs_().mean(2) / (255.0 * _MAX_ERROR)
    image[rows, columns] = HEAT[_palette_indices(error)]
    return image


def _with_photo(image: Tensor, photo: Photo, display: Display) -> Tensor:
    """Put the photo over the left part of its rectangle, up to ``display.wipe``.

    A white line divides it from the rendering. Outside of the rectangle, the rendering is darkened.
    """
    at = photo.placed
    rows, columns = slice(at.top, at.top + at.height), slice(at.left, at.left + at.width)
    inside = image[rows, columns].clone()
    edge = round(display.wipe * at.width)
    inside[:, :edge] = photo.pixels[:, :edge]
    if 0 < edge < at.width:
        inside[:, max(0, edge - 1) : edge + 1] = 255
    whole = (image.to(torch.float32) * _BRIGHTNESS_AROUND).to(torch.uint8)
    whole[rows, columns] = inside
    return whole


def within(value: float, low: float, high: float) -> float:
    """The nearest number from ``low`` to ``high``."""
    return min(max(value, low), high)


@dataclass(frozen=True)
class Display:
    """How Gaussians are displayed; numbers are limited to their ranges.

    Attributes:
        mode: what is displayed: colours, depth … "error" is the difference from a photo.
        degree: of the spherical harmonics that are used for colours.
        scale: factor on the size of every Gaussian.
        wipe: fraction of the width, from the left, in which the photo covers the rendering.
        longest: pixels of the longer side of an image while the camera does not move.
        crop: lower and upper corner (x, y, z) of a box in the world; Gaussians outside are hidden.
    """

    mode: Mode = "color"
    degree: int = 3
    scale: float = 1.0
    wipe: float = 0.0
    longest: int = 1280
    crop: tuple[Vector, Vector] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", within(self.degree, 0, 3))
        object.__setattr__(self, "scale", within(self.scale, *_SCALE))
        object.__setattr__(self, "wipe", within(self.wipe, 0.0, 1.0))
        object.__setattr__(self, "longest", within(self.longest, *_LONGEST))


@dataclass(frozen=True)
class View:
    """The camera of a browser, in the world, and the size of its window.

    Attributes:
        number: counted by the page; an image has the number of the view that it shows.
        quat: wxyz of world_from_cam; x right, y down, z forward.
        position: camera centre, world units.
        fov: vertical field of view, radians.
        width, height: of the window in pixels.
        photo: index of the photo from whose position it looks, if there is one.

    Raises: ValueError: a value is not possible.
    """

    number: int
    quat: tuple[float, float, float, float]
    position: Vector
    fov: float
    width: int
    height: int
    photo: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.number < 1 << 32:
            raise ValueError("the number of a view is out of range")
        if not _SMALL < math.hypot(*self.quat) < 1.0 / _SMALL:
            raise ValueError("the quaternion of a view is not a rotation")
        if not math.hypot(*self.position) < _MAX_COORDINATE or not self.fov > 0.0:
            raise ValueError("the position or the field of view is out of range")
        if not (1 <= self.width <= _MAX_SIDE and 1 <= self.height <= _MAX_SIDE):
            raise ValueError("the size of a window is out of range")

    def camera(self, width: int, height: int, near: float = NEAR) -> Camera:
        """The camera of an image of this size, with the near plane ``near`` (world units)."""
        focal = 0.5 * height / math.tan(0.5 * within(self.fov, _NARROWEST, _WIDEST))
        rotation = rotation_from_quat(torch.tensor(self.quat, dtype=torch.float64))
        position = torch.tensor(self.position, dtype=torch.float64)
        pose = torch.cat([rotation, position[:, None]], 1)
        cx, cy = 0.5 * width, 0.5 * height
        return Camera(width, height, focal, focal, cx, cy, invert_rigid(pose), near)


@dataclass(frozen=True)
class PhotoRectangle:
    """The rectangle of a photo in an image of any aspect ratio: centred, as large as possible.

    The unit is a pixel of the image.
    """

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def within(cls, camera: Camera, width: int, height: int) -> PhotoRectangle:
        """The rectangle of the photo of ``camera`` in an image of ``width`` × ``height``."""
        scale = min(width / camera.width, height / camera.height)
        w = min(width, max(1, round(camera.width * scale)))
        h = min(height, max(1, round(camera.height * scale)))
        return cls((width - w) // 2, (height - h) // 2, w, h)

    def camera(self, camera: Camera, width: int, height: int) -> Camera:
        """The camera of the whole image, ``width`` × ``height``; ``camera``: of the photo."""
        inner = camera.scaled(self.width, self.height)
        cx, cy = inner.cx + self.left, inner.cy + self.top
        return replace(inner, width=width, height=height, cx=cx, cy=cy)
