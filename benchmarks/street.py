"""A street: façades with windows and shops, trees, lamps, planters, a road and a sky.

Metres; x is along the street, z is up, and the middle of the road is y = 0. All textures depend on
the seed. The sky and a distant skyline are painted on a dome.
"""

import math
from collections.abc import Sequence

import numpy as np

from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid, Frustum

#: From the middle of the road to the façades.
HALF_WIDTH = 6.0
#: The road continues by this distance behind its ends.
BEYOND = 60.0
_ROAD = 3.4  # from the middle of the road to the kerb
_SIDE = 11.0  # from the middle of the road to the edge of the ground, behind the houses
_DOME = 3000.0  # its radius
_PANORAMA = (2048, 1024)  # pixels
_TEXEL = 0.03
_DEPTH = 4.0  # of a house
_PLANE_LEAVES = ((0.28, 0.42, 0.16), (0.36, 0.46, 0.18), (0.22, 0.36, 0.17))
_METAL = (0.16, 0.19, 0.20)


def street(length: float, seed: int = 0, more: Sequence[SceneObject] = ()) -> Scene:
    """The scene with its illumination, and ``more``; equal arguments produce equal scenes."""
    random = np.random.default_rng(seed)
    objects = [*more, _surroundings(length, random), _ground_box(length, random)]
    for side in (-1, 1):
        objects += _houses(length, side, random)
        objects += _pavement(length, side, random)
    sun = Lamp(middle=(length / 2, -3.0, 60.0), size=(0.6 * length, 6.0), power=3400.0, ambient=0.5)
    return Scene(objects, sun)


def _size(metres: tuple[float, float], texel: float = _TEXEL) -> tuple[int, int]:
    """Texture size in pixels for a surface; multiples of 16, which can be halved exactly."""
    width, height = (max(16, 16 * round(side / texel / 16)) for side in metres)
    return width, height


def _ground_box(length: float, random: np.random.Generator) -> SceneObject:
    """The road and the pavements, on the upper face of a flat box."""
    along, across = length + 2 * BEYOND, 2 * _SIDE
    other = np.full((16, 16, 3), 0.3, np.float32)
    box = Box((length / 2, 0, -0.5), (along, across, 1.0))
    return SceneObject(box, [other] * 5 + [_ground(along, across, random)])


def _surroundings(length: float, random: np.random.Generator) -> SceneObject:
    """Fields, a distant skyline and the sky: a dome so large that its parallax is not visible."""
    box = (_DOME, _DOME, _DOME)
    dome = Ellipsoid((length / 2, 0, 0), box, inside=True)
    return SceneObject(dome, [_panorama(_PANORAMA, random)], emissive=True)


def _ground(along: float, across: float, random: np.random.Generator) -> np.ndarray:
    """Asphalt with a dashed line and patches, between two pavements of slabs."""
    size = _size((along, across), 0.04)
    width, height = size
    ground = paint.plain(size, (0.36, 0.36, 0.37), random, stains=0.3)
    y = np.abs((np.arange(height) + 0.5) / height - 0.5) * across
    x = (np.arange(width) + 0.5) / width * along
    slabs = paint.bricks(size, round(across / 0.8), round(along / 0.9), random)
    slabs = (slabs.mean(axis=2, keepdims=True) * np.array([1.35, 1.32, 1.25])).clip(0, 1)
    ground[y > _ROAD] = slabs[y > _ROAD]
    ground[np.abs(y - _ROAD) < 0.12] = (0.72, 0.71, 0.68)
    dashes = (y < 0.09)[:, None] & ((x % 4.0) < 2.2)[None]
    ground[dashes] = (0.86, 0.86, 0.82)
    for _ in range(round(along / 4)):  # repaired asphalt
        left, low = random.uniform(0, along - 2), random.uniform(-_ROAD, _ROAD - 1.0)
        wide, high = random.uniform(0.6, 2.0), random.uniform(0.4, 1.0)
        columns = slice(round(left / along * width), round((left + wide) / along * width))
        rows = slice(
            round((0.5 + low / across) * height), round((0.5 + (low + high) / across) * height)
        )
        ground[rows, columns] *= random.uniform(0.6, 1.25)
    return ground.clip(0, 1).astype(np.float32)


def _panorama(size: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """All directions, the zenith in the first row: clouds, roofs and hills at the horizon, fields.

    Its left and right sides fit.
    """
    width, height = size
    elevation = np.radians(90 - 180 * (np.arange(height) + 0.5) / height)[:, None]
    blue, white = np.array([0.55, 0.72, 0.92]), np.array([0.95, 0.96, 0.97])
    # Clouds become smaller towards the horizon, as on a plane; haze hides the most distant ones.
    azimuth = 2 * math.pi * (np.arange(width) + 0.5) / width
    reach = np.minimum(1 / np.tan(np.maximum(elevation, 0.02)), 12.0)
    plane = paint.noise((1024, 1024), (24, 24), 5, random)
    x, y = (((reach * turn(azimuth) / 24 + 0.5) * 1024).astype(int) for turn in (np.cos, np.sin))
    haze = np.exp(-np.maximum(elevation, 0) / 0.12)
    share = ((1.6 * plane[y, x] + 0.3).clip(0, 1) * (1 - haze) + 0.8 * haze)[..., None]
    sky = blue + share * (white - blue)
    step = width // 128
    roofs = np.repeat(random.uniform(0.0, 0.05, 128), step)
    hills = 0.02 + 0.015 * np.sin(3 * azimuth + 1.0) + 0.01 * np.sin(8 * azimuth)
    houses = paint.bricks(size, 200, 256, random) * 0.5 + 0.25
    fields = paint.plain(size, (0.38, 0.42, 0.28), random, stains=0.3)
    town = np.where((elevation < hills + roofs)[..., None], houses, sky)
    return np.where((elevation < 0)[..., None], fields, town).clip(0, 1).astype(np.float32)


def _houses(length: float, side: int, random: np.random.Generator) -> list[SceneObject]:
    """A row of houses of different widths, heights and façades, and their awnings and balconies."""
    objects, x = [], -6.0
    while x < length + 6.0:
        wide, floors = random.uniform(6.0, 9.5), int(random.integers(2, 5))
        height = 3.1 * floors + random.uniform(0.4, 1.2)
        front = facade(_size((wide, height)), (wide, height), floors, random)
        other = paint.plain((64, 64), (0.45, 0.42, 0.40), random)
        setback = random.uniform(0.0, 0.35)
        middle = (x + wide / 2, side * (HALF_WIDTH + setback + _DEPTH / 2), height / 2)
        house = Box(middle, (wide, _DEPTH, height))
        wall = paint.plain(_size((_DEPTH, height), 0.1), (0.5, 0.46, 0.42), random)
        objects.append(SceneObject(house, [wall, wall, front, front, other, other]))
        face = side * (HALF_WIDTH + setback)
        cloth = paint.cloth(
            (160, 48), 14, [(0.7, 0.2, 0.15), (0.85, 0.8, 0.7), (0.2, 0.35, 0.5)], random
        )
        if random.random() < 0.6:
            at = (x + wide * random.uniform(0.3, 0.7), face - side * 0.5, 2.75)
            objects.append(SceneObject(Box(at, (2.6, 1.0, 0.16)), [cloth]))
        for floor in range(1, floors):
            if random.random() < 0.45:
                at = (x + wide * random.uniform(0.2, 0.8), face - side * 0.3, 3.1 * floor + 0.6)
                rail = paint.wood((96, 48), 3, (0.30, 0.26, 0.24), random)
                objects.append(SceneObject(Box(at, (1.7, 0.6, 0.9)), [rail]))
        x += wide
    return objects


def facade(
    size: tuple[int, int], metres: tuple[float, float], floors: int, random: np.random.Generator
) -> np.ndarray:
    """A façade (H, W, 3) sRGB with windows, and on the ground floor a door, a shop and its sign."""
    width, height = size
    colour = np.array([0.72, 0.66, 0.56]) * random.uniform(0.75, 1.2) + random.normal(0, 0.07, 3)
    colour = colour.clip(0.15, 0.9)
    if random.random() < 0.5:
        wall = paint.bricks(size, round(metres[1] / 0.28), round(metres[0] / 0.5), random)
        wall = wall * (0.6 + 0.7 * colour)
    else:
        wall = paint.plain(size, colour.tolist(), random, stains=0.35)
    storey = height * 3.1 / metres[1]
    columns = max(2, round(metres[0] / random.uniform(1.7, 2.4)))
    pitch = width / columns
    trim = np.array([0.86, 0.84, 0.80]) * random.uniform(0.5, 1.0)
    tall, wide = random.uniform(0.45, 0.62), random.uniform(0.45, 0.6)
    for floor in range(1, floors):
        for column in range(columns):
            middle = ((column + 0.5) * pitch, height - (floor + 0.5) * storey)
            _window(wall, middle, (wide * pitch, tall * storey), trim, random)
    ledge = round(height - storey)
    wall[max(0, ledge - 3) : ledge + 3] = trim
    shop = (0.36 * width if random.random() < 0.5 else 0.64 * width, height - 0.42 * storey)
    _window(wall, shop, (0.5 * width, 0.56 * storey), trim, random)
    door = 0.86 * width if shop[0] < width / 2 else 0.14 * width
    leaf = paint.wood((48, 96), 3, random.uniform(0.15, 0.6, 3).tolist(), random)
    wall = wall.clip(0, 1).astype(np.float32)
    wall = paint.paste(wall, leaf, (door / width, 1 - 0.34 * storey / height), 1.1 / metres[0], 0)
    sign = paint.poster((240, 36), random, lines=2)
    return paint.paste(wall, sign, (shop[0] / width, 1 - 0.83 * storey / height), 0.5, 0)


def _window(
    wall: np.ndarray,
    middle: tuple[float, float],
    size: tuple[float, float],
    trim: np.ndarray,
    random: np.random.Generator,
) -> None:
    """Paint a window with a frame, a sill, and glass that shows curtains and the sky."""
    left, right = round(middle[0] - size[0] / 2), round(middle[0] + size[0] / 2)
    top, bottom = round(middle[1] - size[1] / 2), round(middle[1] + size[1] / 2)
    wall[top - 2 : bottom + 2, left - 2 : right + 2] = trim
    wall[bottom + 1 : bottom + 4, left - 4 : right + 4] = 0.8 * trim
    high, wide = bottom - top, right - left
    if min(high, wide) < 8:
        return
    fall = np.linspace(0.42, 0.16, high)[:, None, None]
    clouds = 1 + 0.4 * paint.noise((wide, high), (3, 3), 3, random)
    glass = fall * np.array([0.85, 1.0, 1.2]) * clouds[..., None]
    curtain = random.uniform(0.0, 0.45)
    glass[:, : round(curtain * wide)] = random.uniform(0.4, 0.9, 3)
    wall[top:bottom, left:right] = glass.clip(0, 1)
    bar = left + wide // 2
    wall[top:bottom, bar - 1 : bar + 1] = trim


def _pavement(length: float, side: int, random: np.random.Generator) -> list[SceneObject]:
    """Trees, lamps and planters along the kerb."""
    objects, x = [], random.uniform(0.0, 3.0)
    kerb = side * (_ROAD + 0.7)
    while x < length:
        kind = random.random()
        if kind < 0.4:
            objects += _tree((x, kerb, 0.0), random)
        elif kind < 0.7:
            post = paint.plain((32, 128), _METAL, random)
            globe = np.full((16, 32, 3), 0.93, np.float32)
            objects.append(SceneObject(Frustum((x, kerb, 0), 3.4, 0.09, 0.06), [post]))
            objects.append(SceneObject(Ellipsoid((x, kerb, 3.6), (0.24, 0.24, 0.26)), [globe]))
        else:
            side_face = paint.wood((96, 48), 4, (0.45, 0.33, 0.22), random)
            leaves = _leaves((96, 64), random)
            box = Box((x, kerb, 0.3), (1.3, 0.55, 0.6))
            objects.append(SceneObject(box, [side_face]))
            objects.append(SceneObject(Ellipsoid((x, kerb, 0.75), (0.6, 0.28, 0.32)), [leaves]))
        x += random.uniform(3.2, 5.5)
    return objects


def _tree(base: tuple[float, float, float], random: np.random.Generator) -> list[SceneObject]:
    x, y, z = base
    height = random.uniform(1.9, 2.6)
    bark = paint.wood((64, 128), 2, (0.36, 0.28, 0.22), random)
    parts = [SceneObject(Frustum(base, height, 0.16, 0.11), [bark])]
    for turn in random.uniform(0, 2 * math.pi) + np.arange(3) * 2.1:
        reach, radius = random.uniform(0.25, 0.5), random.uniform(0.6, 0.85)
        middle = (
            x + reach * math.cos(turn),
            y + reach * math.sin(turn),
            z + height + random.uniform(0.2, 0.9),
        )
        crown = Ellipsoid(middle, (radius, radius, 0.85 * radius))
        parts.append(SceneObject(crown, [_leaves((192, 96), random)]))
    return parts


def _leaves(size: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Foliage: dark gaps between light leaves, a few centimetres large."""
    colour = _PLANE_LEAVES[random.integers(0, len(_PLANE_LEAVES))]
    grain = paint.noise(size, (size[0] / 9, size[1] / 9), 2, random)
    return (np.asarray(colour) * (1.1 + 1.2 * grain)[..., None]).clip(0.02, 1).astype(np.float32)
