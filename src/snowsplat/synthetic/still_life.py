"""The scene: a round table with objects on it, in a room with furniture along its walls.

Metres, z up; the centre of the table top is the origin. All textures depend on the seed.
"""

import math

import numpy as np

from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid, Frustum, Ring

FLOOR = -0.72
_CEILING = 2.0
_ROOM = (5.2, 4.8)
LAMP = Lamp(middle=(0.5, -0.4, 1.95), size=(1.1, 0.8), power=2.5, ambient=0.60)
# sRGB colours of wood.
_OAK = (0.62, 0.45, 0.29)
_PINE = (0.78, 0.62, 0.42)
_DARK = (0.42, 0.28, 0.19)


def _size(metres: tuple[float, float], texel: float) -> tuple[int, int]:
    """Texture size in pixels for a surface; multiples of 16, which can be halved exactly."""
    width, height = (max(16, 16 * round(side / texel / 16)) for side in metres)
    return width, height


def still_life(seed: int = 0) -> Scene:
    """The scene with its illumination; equal seeds produce equal scenes."""
    random = np.random.default_rng(seed)
    objects = [*_room(random), *_furniture(random), *_objects_on_the_table(random)]
    return Scene(objects, LAMP)


def _room(random: np.random.Generator) -> list[SceneObject]:
    x, y = _ROOM
    height = _CEILING - FLOOR
    texel = 0.005
    brick = paint.bricks(_size((y, height), texel), 22, 16, random)
    brick = paint.paste(brick, paint.poster((180, 240), random), (0.30, 0.52), 0.16, 2)
    brick = paint.paste(brick, paint.poster((260, 180), random), (0.68, 0.50), 0.22, -1)
    boards = paint.wood(_size((y, height), texel), 9, _OAK, random)
    for u in (0.16, 0.42, 0.76):
        sheet = paint.poster((200, 260), random)
        boards = paint.paste(boards, sheet, (u, 0.52), 0.14, random.normal(0, 3))
    plaster = paint.plain(_size((x, height), texel), (0.72, 0.66, 0.52), random)
    for u in (0.12, 0.36, 0.62, 0.86):
        sheet = paint.poster((240, 200), random)
        frame = np.full((232, 272, 3), random.uniform(0.1, 0.3, 3), np.float32)
        frame[16:-16, 16:-16] = sheet
        plaster = paint.paste(plaster, frame, (u, 0.50 + random.normal(0, 0.03)), 0.17, 0)
    papered = paint.marble(
        _size((x, height), texel), (0.42, 0.50, 0.52), (0.62, 0.66, 0.60), random
    )
    floor = paint.wood(_size(_ROOM, texel), 24, _PINE, random)
    ceiling = np.full((32, 32, 3), 0.86, np.float32)
    room = Box((0, 0, (_CEILING + FLOOR) / 2), (x, y, height), inside=True)
    lamp = np.full((8, 8, 3), 9.0, np.float32)
    return [
        SceneObject(room, [brick, boards, plaster, papered, floor, ceiling]),
        SceneObject(Box(LAMP.middle, (*LAMP.size, 0.04)), [lamp], emissive=True),
    ]


def _furniture(random: np.random.Generator) -> list[SceneObject]:
    objects = []
    rug_colours = [(0.55, 0.20, 0.16), (0.20, 0.28, 0.42), (0.80, 0.70, 0.52), (0.25, 0.35, 0.25)]
    rug = Frustum((0, 0, FLOOR), 0.012, 1.35, 1.35)
    edge = paint.plain((256, 16), (0.5, 0.3, 0.2), random)
    objects.append(SceneObject(rug, [edge, paint.cloth((640, 640), 34, rug_colours, random), edge]))
    shelf = paint.spines(_size((1.7, 1.5), 0.004), 4, random)
    side = paint.wood(_size((0.3, 1.5), 0.005), 2, _DARK, random)
    top = paint.wood(_size((1.7, 0.3), 0.005), 2, _DARK, random)
    shelf_faces = [side, side, shelf, shelf, top, top]
    objects.append(SceneObject(Box((-0.7, 2.24, FLOOR + 0.75), (1.7, 0.3, 1.5)), shelf_faces))
    front = paint.wood(_size((1.3, 0.75), 0.004), 3, _PINE, random)
    side = paint.wood(_size((0.4, 0.75), 0.004), 3, _PINE, random)
    top = paint.wood(_size((1.3, 0.4), 0.004), 2, _PINE, random)
    chest_faces = [side, side, front, front, top, top]
    objects.append(SceneObject(Box((0.9, -2.15, FLOOR + 0.375), (1.3, 0.4, 0.75)), chest_faces))
    vase = paint.marble((256, 160), (0.25, 0.42, 0.45), (0.85, 0.85, 0.75), random)
    bulb = Ellipsoid((1.2, -2.15, 0.22), (0.15, 0.15, 0.2))
    objects.append(SceneObject(bulb, [vase], gloss=0.04))
    for x, y, z, side_length, angle in (
        (2.05, 1.75, FLOOR, 0.62, 0.2),
        (2.10, 1.80, FLOOR + 0.62, 0.45, 0.6),
        (2.15, 1.05, FLOOR, 0.48, -0.3),
        (-2.15, -1.75, FLOOR, 0.7, 0.35),
        (-2.2, -1.0, FLOOR, 0.42, -0.1),
    ):
        faces = []
        for _ in range(6):
            wall = paint.wood(_size((side_length,) * 2, 0.004), 5, _PINE, random)
            label = paint.poster((160, 120), random, lines=7)
            faces.append(paint.paste(wall, label, tuple(random.uniform(0.4, 0.6, 2)), 0.55, 4))
        middle = (x, y, z + side_length / 2)
        objects.append(SceneObject(Box(middle, (side_length,) * 3, angle), faces))
    for angle in (0.5, 2.7, 4.4):
        x, y = 1.0 * math.cos(angle), 1.0 * math.sin(angle)
        seat = paint.wood((192, 192), 3, _OAK, random)
        rim = paint.wood((512, 16), 1, _OAK, random)
        leg = paint.wood((64, 128), 1, _DARK, random)
        objects.append(SceneObject(Frustum((x, y, -0.32), 0.04, 0.18, 0.18), [rim, seat, seat]))
        objects.append(SceneObject(Frustum((x, y, FLOOR), 0.4, 0.12, 0.05), [leg]))
    return objects


def _objects_on_the_table(random: np.random.Generator) -> list[SceneObject]:
    top = paint.wood((960, 960), 7, _OAK, random)
    sheets = [paint.poster((210, 290), random, lines=18) for _ in range(3)]
    for sheet, middle, angle in zip(
        sheets, ((0.62, 0.80), (0.14, 0.50), (0.76, 0.17)), (20.0, -75.0, 130.0), strict=True
    ):
        top = paint.paste(top, sheet, middle, 0.16, angle)
    rim = paint.wood((1536, 16), 1, _DARK, random)
    leg = paint.wood((128, 256), 1, _DARK, random)
    objects = [
        SceneObject(Frustum((0, 0, -0.04), 0.04, 0.72, 0.72), [rim, top, top]),
        SceneObject(Frustum((0, 0, FLOOR), 0.68, 0.22, 0.08), [leg]),
    ]

    world = paint.globe((768, 384), random)
    objects += [
        SceneObject(Ellipsoid((0.06, 0.10, 0.235), (0.175, 0.175, 0.175)), [world], gloss=0.03),
        SceneObject(
            Frustum((0.06, 0.10, 0), 0.07, 0.10, 0.045), [paint.wood((256, 64), 1, _DARK, random)]
        ),
        SceneObject(
            Ring((0.06, 0.10, 0.235), 0.20, 0.010, upright=True, angle=0.9),
            [paint.plain((512, 32), (0.75, 0.6, 0.3), random)],
            gloss=0.08,
        ),
    ]

    z = 0.0
    for width, depth, thick, angle in (
        (0.32, 0.23, 0.050, 0.4),
        (0.29, 0.21, 0.038, 0.75),
        (0.26, 0.19, 0.055, 0.25),
    ):
        cover = paint.poster(_size((width, depth), 0.0015), random)
        spine = paint.poster(_size((width, thick), 0.0015), random, lines=3)
        pages = paint.wood(_size((depth, thick), 0.0015), 9, (0.85, 0.8, 0.68), random)
        box = Box((-0.37, 0.20, z + thick / 2), (width, depth, thick), angle)
        objects.append(SceneObject(box, [pages, pages, spine, spine, cover, cover]))
        z += thick
    for x, y, height, radius in ((-0.10, -0.42, 0.17, 0.055), (0.03, -0.50, 0.11, 0.06)):
        label = paint.poster(_size((2 * math.pi * radius, height), 0.0012), random, lines=9)
        lid = paint.plain((64, 64), (0.6, 0.6, 0.62), random)
        can = Frustum((x, y, 0), height, radius, radius)
        objects.append(SceneObject(can, [label, lid, lid], 0.03))
    for x, y, z, side, angle in (
        (-0.40, -0.18, 0.0, 0.11, 0.5),
        (-0.29, -0.28, 0.0, 0.11, -0.2),
        (-0.35, -0.225, 0.11, 0.10, 0.9),
    ):
        faces = [paint.poster((80, 80), random, lines=3) for _ in range(6)]
        objects.append(SceneObject(Box((x, y, z + side / 2), (side,) * 3, angle), faces))

    glaze = paint.plain((384, 192), (0.50, 0.07, 0.06), random, stains=0.4)
    ball = Ellipsoid((0.40, -0.16, 0.10), (0.10, 0.10, 0.10))
    objects.append(SceneObject(ball, [glaze], gloss=0.10))
    stone = paint.marble((512, 256), (0.80, 0.78, 0.70), (0.28, 0.34, 0.42), random)
    objects += [
        SceneObject(Ellipsoid((-0.02, 0.48, 0.12), (0.11, 0.11, 0.12)), [stone], gloss=0.05),
        SceneObject(
            Frustum((-0.02, 0.48, 0.22), 0.11, 0.045, 0.065),
            [paint.marble((256, 96), (0.80, 0.78, 0.70), (0.28, 0.34, 0.42), random)],
            gloss=0.05,
        ),
    ]
    mug = paint.poster(_size((0.33, 0.11), 0.0012), random, lines=6)
    coffee = paint.plain((64, 64), (0.25, 0.15, 0.09), random)
    handle = paint.plain((128, 32), (0.25, 0.35, 0.55), random)
    objects += [
        SceneObject(
            Frustum((0.42, 0.24, 0), 0.115, 0.05, 0.056), [mug, coffee, coffee], gloss=0.04
        ),
        SceneObject(
            Ring((0.485, 0.275, 0.06), 0.032, 0.008, upright=True, angle=2.07), [handle], 0.04
        ),
    ]
    for x, y, radius in ((0.17, -0.30, 0.055), (0.27, -0.36, 0.052), (0.24, -0.25, 0.050)):
        peel = paint.plain((256, 128), (0.86, 0.48, 0.12), random, stains=0.35)
        objects.append(SceneObject(Ellipsoid((x, y, radius), (radius,) * 3), [peel], gloss=0.02))
    bread = paint.plain((384, 128), (0.70, 0.46, 0.22), random, stains=0.5)
    objects.append(SceneObject(Ring((0.16, 0.42, 0.035), 0.065, 0.035), [bread], gloss=0.03))
    return objects
