"""The picture around the Gaussians: background, floor, glass and base, by ray tracing.

`draw` computes it once per camera. `Backdrop.around` puts a rendering of the Gaussians into it. The
page does the same on the GPU (`web/behind.frag`, `web/front.frag`), with the same colours.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from snowsplat.extras.globe.dimensions import BASE, BLEND, FLOOR, FLOOR_RADIUS, GROUND
from snowsplat.scene.camera import Camera
from snowsplat.util.srgb import from_linear, to_linear

# Colours are linear, unless they are called sRGB.
BACKGROUND = ((0.93, 0.95, 0.98), (0.50, 0.60, 0.74))  # in the middle, and at the corners
INSIDE = ((0.14, 0.29, 0.55), (0.74, 0.84, 0.96))  # behind the scene: at the top, at the floor
SNOW = (0.94, 0.96, 1.0)
WOOD = ((0.050, 0.017, 0.008), (0.150, 0.058, 0.024))  # dark and bright grain
BRASS = (0.86, 0.60, 0.26)
# Direction of the main light in the frame of the camera: from the upper left, behind the viewer.
LIGHT = (-0.48, -0.76, -0.44)
# The plate on the base: half its width (radians around the axis) and half its height.
PLATE = (0.40, 0.088)
PLATE_Y = BASE[1].y + 0.005
# Its engraving, as an image.
_PLATE_WIDTH = 1024  # pixels
_PLATE_HEIGHT = round(_PLATE_WIDTH * PLATE[1] / (PLATE[0] * BASE[1].radius))
_LARGEST_LETTERS, _SMALLEST_LETTERS = round(0.5 * _PLATE_HEIGHT), 12  # size of the letters
_PLATE_MARGIN = 0.86  # the text fills at most this share of the width

FRESNEL = 0.045  # reflectance of the glass for perpendicular rays
_STEPS = 70  # of sphere tracing
_NEAR = 2e-3
_FAR = 12.0


@dataclass(frozen=True)
class Backdrop:
    """What is around the Gaussians, for one camera."""

    behind: np.ndarray  # (H, W, 3) sRGB in 0..1, behind the Gaussians
    # (H, W, 1): share of the light that the glass lets through; 0 where the base is in front.
    keep: np.ndarray
    add: np.ndarray  # (H, W, 3) linear light that reflections or the base add

    def around(self, color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8: the complete picture, with the Gaussians over black.

        ``color``: (H, W, 3) of the Gaussians, and ``alpha``: (H, W) their opacity.
        """
        # Gaussians are blended in sRGB, as they were trained; light is added in linear light.
        inside = color + (1.0 - alpha[:, :, None]) * self.behind
        light = to_linear(inside.clip(0, 1)) * self.keep + self.add
        return np.rint(from_linear(light.clip(0, 1)) * 255).astype(np.uint8)


def draw(camera: Camera, plate: np.ndarray | None = None, samples: int = 2) -> Backdrop:
    """The backdrop of the globe for a camera outside of the glass, in the frame of the globe.

    ``plate``: (h, w) in 0..1, 1 where the text on the plate is engraved; None: no plate.
    ``samples``: rays along each side of a pixel.
    """
    parts = [
        _draw_rows(camera, plate, samples, first, min(first + 64, camera.height))
        for first in range(0, camera.height, 64)
    ]
    behind, keep, add = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Backdrop(from_linear(behind.clip(0, 1)), keep, add)


def _draw_rows(
    camera: Camera, plate: np.ndarray | None, samples: int, first: int, last: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    columns = (np.arange(camera.width * samples) + 0.5) / samples
    rows = (np.arange(first * samples, last * samples) + 0.5) / samples
    u, v = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    in_camera = np.stack([u, v, np.ones_like(u)], -1).astype(np.float32)
    in_camera /= np.linalg.norm(in_camera, axis=-1, keepdims=True)
    pose = camera.world_from_cam.detach().cpu().numpy()
    turn, origin = pose[:, :3].astype(np.float32), pose[:, 3].astype(np.float32)
    rays = (in_camera @ turn.T).reshape(-1, 3)
    corner = np.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2
    behind, keep, add = _shade(
        rays, origin, turn, (np.hypot(u, v) / corner).astype(np.float32).reshape(-1), plate
    )

    def mean(values: np.ndarray) -> np.ndarray:
        shape = last - first, samples, camera.width, samples, values.shape[-1]
        return values.reshape(shape).mean((1, 3)).astype(np.float32)

    return mean(behind), mean(keep), mean(add)


def _shade(
    rays: np.ndarray,
    origin: np.ndarray,
    turn: np.ndarray,
    from_middle: np.ndarray,
    plate: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light behind the Gaussians (P, 3), transmittance (P, 1) and added light (P, 3) of rays."""
    light = turn @ np.array(LIGHT, np.float32)
    behind = _mix(*BACKGROUND, _smooth(0.1, 1.05, from_middle))
    behind *= 1.0 - 0.5 * _shadow(rays, origin, light)[:, None]
    keep = np.ones((len(rays), 1), np.float32)
    add = np.zeros_like(rays)

    # Glass: |origin + t ray| = 1.
    along = rays @ origin
    root = along**2 - (origin @ origin - 1.0)
    hits = root > 0
    half = np.sqrt(np.where(hits, root, 0))
    enter, leave = -along - half, -along + half
    entry = origin + enter[:, None] * rays
    glass = hits & (entry[:, 1] < FLOOR)
    facing = np.clip(-(entry * rays).sum(1), 0, 1)
    reflected = rays + 2 * facing[:, None] * entry
    fresnel = FRESNEL + (1 - FRESNEL) * (1 - facing) ** 5
    edge = 1 - facing

    # The inside: the floor, or the back of the glass.
    with np.errstate(divide="ignore", invalid="ignore"):
        to_floor = np.where(rays[:, 1] > 1e-6, (FLOOR - origin[1]) / rays[:, 1], _FAR)
    floor = origin + to_floor[:, None] * rays
    radius = np.hypot(floor[:, 0], floor[:, 2])
    on_floor = hits & (radius < FLOOR_RADIUS) & (to_floor < leave)
    exit_y = (origin + leave[:, None] * rays)[:, 1]
    air = _mix(*INSIDE, _smooth(-1.0, FLOOR, exit_y))
    air = _blend(behind, air, np.full(len(rays), 0.62, np.float32))
    snow = (
        np.array(SNOW, np.float32) * (1 - 0.30 * _smooth(0.45, 1.0, radius / FLOOR_RADIUS))[:, None]
    )
    inside = np.where(on_floor[:, None], snow, air)
    behind = np.where((glass | on_floor)[:, None], inside, behind)

    dim = 1 - 0.38 * edge**3 - 0.35 * _smooth(0.86, 1.0, edge)
    mirror = _environment(reflected @ turn) * fresnel[:, None]
    # The back of the glass reflects the window once more, upside down and weaker.
    back = origin + leave[:, None] * rays
    inner = rays - 2 * (rays * back).sum(1)[:, None] * back
    mirror += 0.006 * _environment(inner @ turn) * (1 - fresnel[:, None])
    keep = np.where(glass[:, None], (dim * (1 - fresnel))[:, None], keep)
    add = np.where(glass[:, None], mirror, add)

    # The base, where it is not behind the glass.
    distance = _trace(rays, origin)
    base = distance < np.where(glass, enter, _FAR)
    base &= ~(on_floor & (to_floor < distance))
    if base.any():
        add[base] = _base_light(rays[base], origin, distance[base], turn, plate)
        keep[base] = 0
    return behind, keep, add


def _environment(directions: np.ndarray) -> np.ndarray:
    """(P, 3): the light from directions (P, 3) in the frame of the camera: a bright room.

    It has a window with four panes at the upper left, and a soft light at the right.
    """
    x, y, z = directions.T
    light = _mix((0.10, 0.11, 0.13), (0.70, 0.74, 0.80), _smooth(0.5, -0.9, y))
    # Coordinates on a plane in front of the window; its panes are separated by a cross.
    toward = -z
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (x / toward + 0.95) / 0.42, (y / toward + 0.95) / 0.52
    pane = (
        _smooth(1.0, 0.93, np.abs(u))
        * _smooth(1.0, 0.93, np.abs(v))
        * _smooth(0.03, 0.08, np.abs(u))
        * _smooth(0.03, 0.08, np.abs(v))
    )
    light += (9.0 * np.where(toward > 0.05, np.nan_to_num(pane), 0))[:, None]
    soft = _smooth(0.82, 1.0, directions @ np.array([0.80, -0.35, -0.49], np.float32))
    return light + 1.6 * soft[:, None] * np.array([1.0, 0.97, 0.92], np.float32)


def _profile(points: np.ndarray) -> np.ndarray:
    """(P,): the signed distance of points (P, 3) to the base."""
    across = np.hypot(points[:, 0], points[:, 2])
    total = np.full(len(points), np.float32(_FAR))
    for ring in BASE:
        dx = across - (ring.radius - ring.edge)
        dy = np.abs(points[:, 1] - ring.y) - (ring.half - ring.edge)
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
        distance = outside + np.minimum(np.maximum(dx, dy), 0) - ring.edge
        # A smooth minimum: the parts are joined by a hollow, as a lathe makes it.
        share = np.clip(0.5 + 0.5 * (total - distance) / BLEND, 0, 1)
        total = total * (1 - share) + distance * share - BLEND * share * (1 - share)
    return total


def _trace(rays: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(P,): the distance along the rays to the base; `_FAR` where a ray misses it."""
    found = np.full(len(rays), np.float32(_FAR))
    # Only rays that pass the sphere around the base.
    centre = np.array([0.0, (BASE[0].y + GROUND) / 2, 0.0], np.float32)
    toward = (centre - origin) @ rays.T
    nearest = np.linalg.norm(origin + toward[:, None] * rays - centre, axis=1)
    rows = np.flatnonzero(nearest < 1.05)
    distance = np.maximum(toward[rows] - 1.1, 0)
    for _ in range(_STEPS):
        step = _profile(origin + distance[:, None] * rays[rows])
        distance = distance + step
        ends = step < _NEAR
        found[rows[ends]] = distance[ends]
        going = ~ends & (distance < toward[rows] + 1.1)
        rows, distance = rows[going], distance[going]
    found[rows] = distance  # rays that pass close to an edge, in many small steps
    return found


def _base_light(
    rays: np.ndarray,
    origin: np.ndarray,
    distance: np.ndarray,
    turn: np.ndarray,
    plate: np.ndarray | None,
) -> np.ndarray:
    points = origin + distance[:, None] * rays
    offsets = np.eye(3, dtype=np.float32) * 2e-3
    normal = np.stack([_profile(points + o) - _profile(points - o) for o in offsets], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    x, y, z = points.T
    # The grain of the wood: a log whose axis is nearly vertical, with slightly uneven rings.
    waves = 0.5 * np.sin(5.1 * y + 3.0 * x) + 0.3 * np.sin(9.7 * z + 4.1 * y)
    rings = np.sin(34.0 * (x * 0.9 + 0.35 * z + 0.06 * y + 0.07 * waves))
    fibres = np.sin(57.0 * x + 9.0 * waves) * np.sin(43.0 * z - 6.0 * y)
    albedo = _mix(*WOOD, np.clip(0.5 + 0.35 * rings + 0.15 * fibres, 0, 1))
    gloss = np.full(len(points), np.float32(0.03))
    if plate is not None:
        around = np.arctan2(x, -z) / PLATE[0]
        up = (y - PLATE_Y) / PLATE[1]
        # A rectangle with round corners.
        aspect = PLATE[0] * BASE[1].radius / PLATE[1]
        corner = np.hypot(
            np.maximum(np.abs(around) * aspect - (aspect - 0.3), 0), np.maximum(np.abs(up) - 0.7, 0)
        )
        metal = _smooth(0.30, 0.26, corner) * (np.abs(around) < 1) * (np.hypot(x, z) > 0.74)
        rows, columns = plate.shape
        i = np.clip(((up + 1) / 2 * rows).astype(int), 0, rows - 1)
        j = np.clip(((around + 1) / 2 * columns).astype(int), 0, columns - 1)
        engraved = np.where(metal > 0, plate[i, j], 0) * 0.85
        frame = _smooth(0.19, 0.21, corner) * _smooth(0.25, 0.23, corner) * 0.5
        brass = np.array(BRASS) * (1 - np.maximum(engraved, frame))[:, None]
        brass *= (0.9 + 0.1 * np.sin(700 * y))[:, None]  # brushed
        albedo = _blend(albedo, brass * 0.75, metal)
        gloss = gloss + 0.45 * metal * (1 - engraved)
    light = turn @ np.array(LIGHT, np.float32)
    diffuse = np.clip(normal @ light, 0, 1) * 1.5
    ambient = 0.22 + 0.20 * np.clip(-normal[:, 1], 0, 1)
    # Less light reaches the hollows, and the part next to the ground.
    open_space = np.clip(_profile(points + 0.09 * normal) / 0.09, 0, 1)
    ambient *= 0.35 + 0.65 * open_space
    ambient *= 0.45 + 0.55 * _smooth(GROUND, GROUND - 0.14, y)
    reflected = rays - 2 * (rays * normal).sum(1)[:, None] * normal
    facing = np.clip(-(rays * normal).sum(1), 0, 1)
    mirror = (gloss + (1 - gloss) * 0.12 * (1 - facing) ** 5) * open_space
    tint = np.where((gloss > 0.3)[:, None], np.array(BRASS), 1.0)
    shine = _environment(reflected @ turn) * mirror[:, None] * tint
    return albedo * (diffuse * (0.4 + 0.6 * open_space) + ambient)[:, None] + 0.8 * shine


def _shadow(rays: np.ndarray, origin: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(P,): the soft shadow of the base and the glass on the ground, 0..1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(rays[:, 1] > 1e-6, (GROUND - origin[1]) / rays[:, 1], 1e6)
    x, z = origin[0] + distance * rays[:, 0], origin[2] + distance * rays[:, 2]
    contact = _smooth(1.25, 0.85, np.hypot(x, z))
    # Opposite to the light, the shadow is longer and softer.
    cast = _smooth(2.3, 0.3, np.hypot(x + 0.55 * light[0], z + 0.55 * light[2]))
    return np.where(distance < 1e5, 1 - (1 - 0.75 * contact) * (1 - 0.55 * cast), 0)


def _smooth(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """The smoothstep function from 0 at ``low`` to 1 at ``high``, which may be below ``low``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _mix(low: tuple[float, ...], high: tuple[float, ...], share: np.ndarray) -> np.ndarray:
    a, b = np.array(low, np.float32), np.array(high, np.float32)
    return a + (b - a) * share[:, None].astype(np.float32)


def _blend(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    return a + (b - a) * share[:, None]


def engraving(name: str) -> np.ndarray:
    """(h, w) float32 in 0..1: 1 where the plate is engraved. A long name has smaller letters.

    Letters that the font of Pillow does not have are drawn as boxes.
    """
    image = Image.new("L", (_PLATE_WIDTH, _PLATE_HEIGHT))
    draw = ImageDraw.Draw(image)
    for points in range(_LARGEST_LETTERS, _SMALLEST_LETTERS - 1, -2):
        font = ImageFont.load_default(points)
        if draw.textlength(name, font) <= _PLATE_MARGIN * _PLATE_WIDTH:
            break
    draw.text((_PLATE_WIDTH / 2, 0.52 * _PLATE_HEIGHT), name, font=font, anchor="mm", fill=255)
    return np.asarray(image, dtype=np.float32) / 255.0
