"""Procedural scenes with known camera poses for `sfm.py`. Photos are ray traced once and then kept.

    room     a furnished room; the camera path has several loops
    around   the still life of `snowsplat demo`; the camera goes around the table
    plain    the room with walls of one colour and less furniture; all loops look across the room
    carpet   a room with a worn carpet that repeats; the camera looks down at it, across the room
    twins    two identical objects in a hall with pictures; a figure of eight around the objects
    rooms    two identical rooms, and the passage from one to the other
    ahead    a street; the camera walks and looks ahead
    side     a street; the camera looks at the façades of the other side
    turns    a street; the camera walks ahead and turns from side to side
    fisheye  the photos of "room" at the same places, with a fisheye lens of 150°
    panorama the room; 360° panoramas on the loops of "room", of twice the width
    brackets the still life, three exposures at each place
    devices  the photos of "around", of three cameras with other sizes and distortions
    zoom     as "around", with a zoom of 1 to 2 in the middle third; a video, as EXIF has one zoom

Lengths are in metres, and z is up. The floor is at z = 0, except in "around". Textures depend on
the seed.
"""

import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from sfm_paths import (
    ahead,
    around_corners,
    around_two,
    in_between,
    level_loops,
    looking_across,
    looking_down,
    loops,
    street_length,
    through_two_rooms,
    to_the_side,
)
from sfm_shots import GAINS, Shoot, brackets, devices, zoom
from torch import Tensor

from snowsplat.sfm.progress import Report, silent
from snowsplat.synthetic import Truth
from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.photographer import CentredLens, phone_lens, take_photos, walk
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid, Frustum
from snowsplat.synthetic.still_life import still_life
from snowsplat.trajectory.video_file import video_writer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from street import street
from tests.scenes.lenses import Equirectangular, fisheye_lens

#: Part of the folder names of the photos. Increase it with every change that affects the photos.
VERSION = 5
CACHE_VARIABLE = "SNOWSPLAT_SFM_SCENES"
SIZE = (800, 600)
FRAMES_PER_SECOND = 10

_HEIGHT = 2.6  # metres, of all rooms
_TEXEL = 0.005  # metres per pixel of a texture
_OAK, _PINE, _DARK = (0.62, 0.45, 0.29), (0.78, 0.62, 0.42), (0.42, 0.28, 0.19)
_PLASTER = (0.72, 0.70, 0.64)
# The two identical rooms, in metres:
_ROOM_SIZE = (4.2, 3.8)  # width, depth
MIDDLES = (-2.16, 2.16)  # x of the middle of each room
_DOOR, _DOOR_WIDTH, _DOOR_HEIGHT = 0.9, 0.95, 2.1  # _DOOR: x relative to the middle of the room
_WALL, _PASSAGE = 0.12, 1.5  # thickness of the walls, width of the passage
_TWIN_DISTANCE = 4.4  # between the two identical objects


@dataclass(frozen=True)
class Kind:
    """The functions that make a scene and a camera path through it."""

    build: Callable[[int, int], Scene]  # arguments: the seed, the number of photos
    path: Callable[[int, int], list[Tensor]]  # arguments: the number of photos, the seed
    lens: Callable[[int, int], CentredLens] = phone_lens  # arguments: width, height
    # How each photo is taken, if they differ. Arguments: the lens, the poses.
    shoot: Callable[[CentredLens, Sequence[Tensor]], Shoot] | None = None


def cache_folder() -> Path:
    """The folder for the photos: `CACHE_VARIABLE`, or a folder in the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE, "")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "snowsplat-sfm-scenes"


def photos_of(
    kind: str,
    count: int,
    cache: Path,
    size: tuple[int, int] = SIZE,
    seed: int = 0,
    report: Report = silent,
) -> tuple[Path, Truth]:
    """The folder with ``count`` photos of a scene of `KINDS`, and their true poses.

    Photos that are not in ``cache`` are rendered: 1 to 2 seconds of processor time each at 800×600.
    """
    chosen = KINDS[kind]
    folder = cache / f"{kind}-{count}-{size[0]}x{size[1]}-seed{seed}-v{VERSION}"
    lens, poses = chosen.lens(*size), chosen.path(count, seed)
    build, shoot = partial(chosen.build, seed, count), chosen.shoot and chosen.shoot(lens, poses)
    return folder, take_photos(folder, build, lens, poses, seed, report, shoot)


def video_of(
    kind: str,
    seconds: int,
    cache: Path,
    size: tuple[int, int] = SIZE,
    seed: int = 0,
    report: Report = silent,
) -> tuple[Path, Truth]:
    """A video of a scene of `KINDS`, and the true poses of its frames.

    The frames ``IMG_0001.jpg`` … are in the folder ``frames`` beside the video. Frames that are not
    in ``cache`` are rendered, as in `photos_of`.
    """
    chosen = KINDS[kind]
    folder = cache / f"{kind}-{seconds}s-{size[0]}x{size[1]}-seed{seed}-v{VERSION}"
    poses = in_between(chosen.path(seconds, seed), seconds * FRAMES_PER_SECOND)
    lens = chosen.lens(*size)
    build, shoot = partial(chosen.build, seed, seconds), chosen.shoot and chosen.shoot(lens, poses)
    truth = take_photos(folder / "frames", build, lens, poses, seed, report, shoot)
    video = folder / "video.mp4"
    if not video.exists():
        with video_writer(video, lens.width, lens.height, FRAMES_PER_SECOND) as add:
            for name in truth.poses:
                with Image.open(folder / "frames" / name) as frame:
                    add(np.asarray(frame.convert("RGB")))
    return video, truth


# The scenes


def _room(seed: int) -> Scene:
    random = np.random.default_rng(seed)
    x, y = 6.0, 5.0
    long, short = _pixels(x, _HEIGHT), _pixels(y, _HEIGHT)
    walls = [
        paint.bricks(short, 24, 18, random),
        paint.wood(short, 10, _OAK, random),
        paint.plain(long, _PLASTER, random),
        paint.marble(long, (0.42, 0.50, 0.52), (0.62, 0.66, 0.60), random),
    ]
    walls = [_with_pictures(wall, 4, random) for wall in walls]
    floor = paint.wood(_pixels(x, y), 26, _PINE, random)
    objects = [_shell((x, y), [*walls, floor, _plain((0.86, 0.86, 0.84))])]
    objects += [
        _bookcase(random, (-1.4, 2.33), (1.8, 0.3, 1.7)),
        _bookcase(random, (1.6, -2.33), (1.4, 0.3, 1.2)),
        *_crates(random, (2.6, 1.9), 0.6),
        *_crates(random, (-2.6, -1.9), 0.5),
        *_crates(random, (2.6, -1.0), 0.45),
        *_table(random, (0.0, 0.0)),
    ]
    return Scene(objects, _lamp((1.6, 1.2)))


def _plain_room(seed: int) -> Scene:
    random = np.random.default_rng([seed, 1])
    x, y = 6.0, 5.0
    floor = paint.wood(_pixels(x, y), 26, _PINE, random)
    colours = [_plain((0.78, 0.77, 0.72)), _plain((0.70, 0.74, 0.74))] * 2
    objects = [
        _shell((x, y), [*colours, floor, _plain((0.86, 0.86, 0.84))]),
        _bookcase(random, (-1.4, 2.33), (1.2, 0.3, 0.9)),
        *_crates(random, (2.6, -1.0), 0.5),
        *_table(random, (0.0, 0.0)),
    ]
    return Scene(objects, _lamp((1.6, 1.2)))


def _carpeted_room(seed: int) -> Scene:
    random = np.random.default_rng([seed, 2])
    x, y = 6.0, 4.8
    across, down, tile = 5, 4, 0.6  # numbers of tiles, and the side of a tile in metres
    shades = [(0.55, 0.20, 0.16), (0.20, 0.28, 0.42), (0.80, 0.70, 0.52), (0.25, 0.35, 0.25)]
    carpet = np.tile(paint.cloth(_pixels(tile, tile), 5, shades, random), (down, across, 1))
    carpet = _worn(carpet, random)
    floor = paint.wood(_pixels(x, y), 26, _PINE, random)
    top, left = ((np.array(floor.shape[:2]) - carpet.shape[:2]) // 2).tolist()
    floor[top : top + carpet.shape[0], left : left + carpet.shape[1]] = carpet
    colours = [(0.78, 0.77, 0.72), (0.70, 0.74, 0.74)] * 2
    walls = [
        _with_pictures(paint.plain(_pixels(side, _HEIGHT), colour, random), 3, random)
        for side, colour in zip((y, y, x, x), colours, strict=True)
    ]
    objects = [
        _shell((x, y), [*walls, floor, _plain((0.86, 0.86, 0.84))]),
        *_crates(random, (2.6, 1.9), 0.5),
        *_crates(random, (-2.6, -1.8), 0.5),
    ]
    return Scene(objects, _lamp((1.6, 1.2)))


def _twins(seed: int) -> Scene:
    random = np.random.default_rng([seed, 3])
    x, y = 9.4, 5.4
    floor = paint.plain(_pixels(x, y), (0.50, 0.46, 0.40), random, stains=0.1)
    colours = [(0.78, 0.77, 0.72), (0.70, 0.74, 0.74)] * 2
    walls = [
        _with_pictures(paint.plain(_pixels(side, _HEIGHT), colour, random), 4, random)
        for side, colour in zip((y, y, x, x), colours, strict=True)
    ]
    objects = [_shell((x, y), [*walls, floor, _plain((0.86, 0.86, 0.84))])]
    for side in (-1, 1):
        objects += _monument(np.random.default_rng([seed, 4]), (side * _TWIN_DISTANCE / 2, 0.0))
    return Scene(objects, _lamp((6.0, 2.0)))


def _two_rooms(seed: int) -> Scene:
    random = np.random.default_rng([seed, 5])
    width, depth = _ROOM_SIZE
    x, y = 2 * width + 3 * _WALL, depth + _PASSAGE + 2 * _WALL
    middle = (0.0, -(_PASSAGE + _WALL) / 2)
    walls = [
        _with_pictures(paint.plain(_pixels(side, _HEIGHT), colour, random), 5, random)
        for side, colour in ((y, _PLASTER), (y, _OAK), (x, (0.55, 0.62, 0.66)), (x, _PLASTER))
    ]
    floor = paint.wood(_pixels(x, y), 26, _DARK, random)
    objects = [_shell((x, y), [*walls, floor, _plain((0.86, 0.86, 0.84))], middle)]
    for at in MIDDLES:
        objects += identical_room(np.random.default_rng([seed, 6]), at)
    return Scene(objects, _lamp((7.0, 3.0)))


def identical_room(random: np.random.Generator, middle: float) -> list[SceneObject]:
    """One of the two rooms: walls, floor and furniture. Equal generators make equal rooms."""
    width, depth = _ROOM_SIZE
    size = {"side": _pixels(depth, _HEIGHT), "back": _pixels(width, _HEIGHT)}
    left = _with_pictures(paint.bricks(size["side"], 24, 14, random), 2, random)
    right = _with_pictures(paint.wood(size["side"], 10, _OAK, random), 3, random)
    back = _with_pictures(paint.plain(size["back"], _PLASTER, random), 3, random)
    front = paint.marble(size["back"], (0.42, 0.50, 0.52), (0.62, 0.66, 0.60), random)
    floor = paint.wood(_pixels(width, depth), 18, _PINE, random)
    thick, z = _WALL / 2, _HEIGHT / 2
    # The walls of the room have half the thickness; the other half belongs to the neighbour. The
    # outer faces cannot be seen.
    objects = [
        _board((middle - width / 2 - thick / 2, 0, z), (thick, depth, _HEIGHT), left),
        _board((middle + width / 2 + thick / 2, 0, z), (thick, depth, _HEIGHT), right),
        _board((middle, depth / 2 + thick / 2, z), (width, thick, _HEIGHT), back),
        _board((middle, 0, 0.005), (width, depth, 0.01), floor),
    ]
    # The front wall has a door: a piece on its left, one on its right and one above it.
    edges = (-width / 2, _DOOR - _DOOR_WIDTH / 2, _DOOR + _DOOR_WIDTH / 2, width / 2)
    for i, bottom in enumerate((0.0, _DOOR_HEIGHT, 0.0)):
        low, high = edges[i], edges[i + 1]
        columns = [round((edge / width + 0.5) * front.shape[1]) for edge in (low, high)]
        rows = front.shape[0] - round(bottom / _HEIGHT * front.shape[0])
        piece = np.ascontiguousarray(front[:rows, columns[0] : columns[1]])
        centre = (middle + (low + high) / 2, -depth / 2 - _WALL / 2, (bottom + _HEIGHT) / 2)
        objects.append(_board(centre, (high - low, _WALL, _HEIGHT - bottom), piece))
    objects += [
        _bookcase(random, (middle - 0.8, depth / 2 - 0.16), (1.4, 0.3, 1.5)),
        *_crates(random, (middle + 1.7, 1.4), 0.5),
        *_crates(random, (middle - 1.75, -1.4), 0.45),
    ]
    return objects


# Parts of scenes


def _pixels(*metres: float) -> tuple[int, int]:
    """Size of a texture in pixels; multiples of 16, which can be halved exactly."""
    width, height = (max(16, 16 * round(side / _TEXEL / 16)) for side in metres)
    return width, height


def _plain(colour: Sequence[float]) -> np.ndarray:
    """A surface without any detail."""
    return np.full((32, 32, 3), colour, np.float32)


def _lamp(size: tuple[float, float]) -> Lamp:
    # A larger lamp needs more power, because it is on average farther away from a surface.
    power = 3.0 * math.sqrt(size[0] * size[1])
    return Lamp((0.0, 0.0, _HEIGHT - 0.02), size, power=power, ambient=0.55)


def _shell(
    size: tuple[float, float],
    faces: Sequence[np.ndarray],
    middle: tuple[float, float] = (0.0, 0.0),
) -> SceneObject:
    """The inside of a building: walls −x, +x, −y, +y, floor, ceiling."""
    centre = (*middle, _HEIGHT / 2)
    return SceneObject(Box(centre, (*size, _HEIGHT), inside=True), faces)


def _board(
    centre: tuple[float, float, float], size: tuple[float, float, float], face: np.ndarray
) -> SceneObject:
    """A thin box with one texture on its large faces, and plain edges."""
    thin = int(np.argmin(size))
    edge = _plain((0.6, 0.58, 0.52))
    return SceneObject(Box(centre, size), [face if i // 2 == thin else edge for i in range(6)])


def _worn(cloth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """``cloth`` with different shading at each place; the standard deviation is 1/30."""
    size = (cloth.shape[1], cloth.shape[0])
    shading = 0.1 * paint.noise(size, (size[0] / 10, size[1] / 10), 4, random)
    return (cloth * (1 + shading)[..., None]).clip(0, 1).astype(np.float32)


def _with_pictures(wall: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """The wall with framed prints side by side."""
    width = wall.shape[1]
    for i in range(count):
        portrait = random.random() < 0.5
        size = (180, 240) if portrait else (240, 180)
        frame = np.full((size[1] + 24, size[0] + 24, 3), random.uniform(0.1, 0.3, 3), np.float32)
        frame[12:-12, 12:-12] = paint.poster(size, random)
        at = ((i + random.uniform(0.35, 0.65)) / count, 0.45 + random.normal(0, 0.03))
        metres = random.uniform(0.45, 0.75)
        wall = paint.paste(wall, frame, at, metres / _TEXEL / width, random.normal(0, 1.5))
    return wall


def _bookcase(
    random: np.random.Generator, at: tuple[float, float], size: tuple[float, float, float]
) -> SceneObject:
    width, depth, height = size
    front = paint.spines(_pixels(width, height), max(2, round(height / 0.38)), random)
    side = paint.wood(_pixels(depth, height), 2, _DARK, random)
    top = paint.wood(_pixels(width, depth), 2, _DARK, random)
    return SceneObject(Box((*at, height / 2), size), [side, side, front, front, top, top])


def _crate(
    random: np.random.Generator, centre: tuple[float, float, float], side: float, angle: float
) -> SceneObject:
    faces = []
    for _ in range(6):
        wall = paint.wood(_pixels(side, side), 4, _PINE, random)
        label = paint.poster((160, 120), random, lines=7)
        middle = (random.uniform(0.4, 0.6), random.uniform(0.4, 0.6))
        faces.append(paint.paste(wall, label, middle, 0.6, random.normal(0, 4)))
    return SceneObject(Box(centre, (side,) * 3, angle), faces)


def _crates(random: np.random.Generator, at: tuple[float, float], side: float) -> list[SceneObject]:
    """Two crates on top of each other."""
    x, y = at
    upper = 0.7 * side
    return [
        _crate(random, (x, y, side / 2), side, random.uniform(-0.3, 0.3)),
        _crate(random, (x, y, side + upper / 2), upper, random.uniform(0, 1.5)),
    ]


def _table(random: np.random.Generator, at: tuple[float, float]) -> list[SceneObject]:
    """A low round table with a globe and a box on it."""
    x, y = at
    top = paint.wood((320, 320), 5, _OAK, random)
    rim = paint.wood((640, 16), 1, _DARK, random)
    leg = paint.wood((128, 128), 1, _DARK, random)
    return [
        SceneObject(Frustum((x, y, 0.5), 0.04, 0.55, 0.55), [rim, top, top]),
        SceneObject(Frustum((x, y, 0), 0.5, 0.2, 0.08), [leg]),
        SceneObject(
            Ellipsoid((x + 0.12, y + 0.1, 0.74), (0.2, 0.2, 0.2)), [paint.globe((512, 256), random)]
        ),
        _crate(random, (x - 0.22, y - 0.18, 0.66), 0.24, 0.5),
    ]


def _monument(random: np.random.Generator, at: tuple[float, float]) -> list[SceneObject]:
    """A crate, a drum and a globe on top of each other, 1.4 m high."""
    x, y = at
    drum = paint.poster(_pixels(1.5, 0.4), random, lines=9)
    lid = paint.wood((96, 96), 2, _DARK, random)
    return [
        _crate(random, (x, y, 0.3), 0.6, 0.3),
        SceneObject(Frustum((x, y, 0.6), 0.35, 0.25, 0.22), [drum, lid, lid]),
        SceneObject(Ellipsoid((x, y, 1.17), (0.22, 0.22, 0.22)), [paint.globe((512, 256), random)]),
    ]


def _through_two_rooms(count: int, seed: int) -> list[Tensor]:
    corridor = -_ROOM_SIZE[1] / 2 - _WALL - _PASSAGE / 2
    return through_two_rooms(count, seed, MIDDLES, _DOOR, corridor)


def _street(seed: int, count: int) -> Scene:
    return street(street_length(count), seed)


def _indoors(build: Callable[[int], Scene]) -> Callable[[int, int], Scene]:
    """A scene whose size does not depend on the number of photos."""
    return lambda seed, _: build(seed)


KINDS = {
    "room": Kind(_indoors(_room), loops),
    "around": Kind(_indoors(still_life), walk),
    "plain": Kind(_indoors(_plain_room), looking_across),
    "carpet": Kind(_indoors(_carpeted_room), looking_down),
    "twins": Kind(_indoors(_twins), around_two),
    "rooms": Kind(_indoors(_two_rooms), _through_two_rooms),
    "ahead": Kind(_street, ahead),
    "side": Kind(_street, to_the_side),
    "turns": Kind(_street, around_corners),
    "panorama": Kind(
        _indoors(_room), level_loops, lambda width, _: Equirectangular(2 * width, width)
    ),
    "fisheye": Kind(
        _indoors(_room), loops, lambda width, height: fisheye_lens(width, height, 150.0)
    ),
    "brackets": Kind(
        _indoors(still_life),
        lambda count, seed: [pose for pose in walk(-(-count // 3), seed) for _ in GAINS][:count],
        shoot=brackets,
    ),
    "devices": Kind(_indoors(still_life), walk, shoot=devices),
    "zoom": Kind(_indoors(still_life), walk, shoot=zoom),
}
