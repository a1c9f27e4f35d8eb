"""Procedural textures: wood, bricks, prints, cloth, stone.

Every function takes a size (width, height) in pixels and a random generator, and returns sRGB
values (H, W, 3) float32 from 0 to 1. Details are a few pixels wide: finer ones would cause
aliasing, and coarser ones would not yield enough features.
"""

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

Size = tuple[int, int]
Colour = Sequence[float]  # sRGB, 0 to 1
Ink = tuple[int, int, int]  # sRGB, 0 to 255

_LIGHT: Sequence[Ink] = ((238, 228, 205), (222, 212, 190), (205, 218, 220), (236, 214, 170))
_DARK: Sequence[Ink] = ((38, 42, 54), (74, 32, 34), (28, 60, 62), (52, 40, 34), (40, 48, 92))
_BRIGHT: Sequence[Ink] = (
    (196, 62, 46),
    (224, 140, 44),
    (232, 190, 76),
    (112, 142, 62),
    (46, 120, 128),
    (58, 92, 160),
    (150, 84, 120),
    (210, 200, 178),
)


def noise(
    size: Size, cells: tuple[float, float], octaves: int, random: np.random.Generator
) -> np.ndarray:
    """Value noise (H, W) in about -1 to 1, standard deviation about 1/3; periodic in u.

    The first octave has ``cells`` random values across and down. Each further octave has twice as
    many, at 0.6 of the amplitude.
    """
    total, strength, sum2 = np.zeros(size[::-1], np.float32), 1.0, 0.0
    for octave in range(octaves):
        across, down = (max(1, round(count * 2**octave)) for count in cells)
        if across > size[0] / 2 and down > size[1] / 2:
            break  # finer than the pixels
        grid = random.standard_normal((down + 4, across)).astype(np.float32)
        grid = np.pad(grid, ((0, 0), (2, 2)), mode="wrap")
        box = (2, 2, 2 + across, 2 + down)
        total += strength * np.asarray(
            Image.fromarray(grid).resize(size, Image.Resampling.BICUBIC, box)
        )
        sum2 += strength**2
        strength *= 0.6
    return total * np.float32(0.4 / math.sqrt(sum2))


def _grid(size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Pixel centres, u (1, W) and v (H, 1), from 0 to 1."""
    width, height = size
    u = ((np.arange(width) + 0.5) / width).astype(np.float32)
    v = ((np.arange(height) + 0.5) / height).astype(np.float32)
    return u[None, :], v[:, None]


def _shade(colour: Colour, value: np.ndarray) -> np.ndarray:
    """``colour`` made lighter or darker by ``value`` (H, W); 0 leaves it unchanged."""
    return (np.asarray(colour, np.float32) * (1 + value[..., None])).clip(0, 1)


def _mix(a: np.ndarray, b: Colour | np.ndarray, share: np.ndarray) -> np.ndarray:
    """Linear mix: ``a`` where ``share`` (H, W) is 0, ``b`` where it is 1."""
    share = share.clip(0, 1)[..., None]
    return a * (1 - share) + np.asarray(b, np.float32) * share


def plain(
    size: Size, colour: Colour, random: np.random.Generator, stains: float = 0.25
) -> np.ndarray:
    """Plaster, paint, glaze: one colour with stains and specks."""
    base = _shade(colour, stains * noise(size, (4, 4), 5, random))
    specks = noise(size, (size[0] / 10, size[1] / 10), 2, random)
    return _mix(base, 0.45 * np.asarray(colour), 1.2 * (np.abs(specks) - 0.75) / 0.2)


def wood(size: Size, planks: int, colour: Colour, random: np.random.Generator) -> np.ndarray:
    """Planks along u, each with its own tone, grain and rings, and dark joints."""
    u, v = _grid(size)
    row = np.minimum((v * planks).astype(int), planks - 1)
    across = v * planks - row  # 0 to 1 within a plank
    # Each row of planks is cut at two random positions.
    cuts = random.uniform(0, 0.5, planks)[row]
    piece = np.floor((u - cuts) * 2).astype(int)
    tone = random.normal(0, 0.14, (planks, 4))[row, piece % 4]
    drift = random.uniform(0, 20, (planks, 4))[row, piece % 4]
    wave = noise(size, (3, 2 * planks), 3, random)
    rings = np.sin(2 * np.pi * (2.2 * across + drift + 1.3 * wave + 0.7 * u))
    grain = noise(size, (10, 14 * planks), 3, random)
    blotches = noise(size, (12, 3 * planks), 4, random)
    result = _shade(colour, tone + 0.12 * rings + 0.20 * grain + 0.18 * blotches)
    height, width = size[1], size[0]
    joint = np.minimum(across, 1 - across) * (height / planks) < 1.2
    end = np.abs((u - cuts) * 2 - np.round((u - cuts) * 2)) * (width / 2) < 1.2
    return _mix(result, 0.3 * np.asarray(colour), (joint | end).astype(np.float32) * 0.8)


def bricks(size: Size, rows: int, columns: int, random: np.random.Generator) -> np.ndarray:
    """A wall of weathered bricks of different tones, with rough mortar."""
    u, v = _grid(size)
    warp = 0.05 * noise(size, (3 * columns, 2 * rows), 3, random)
    row = np.floor(v * rows + 0 * u).astype(int)
    x = u * columns + 0.5 * (row % 2)
    column = np.floor(x).astype(int)
    edge_x = (0.5 - np.abs(x - column - 0.5)) / columns * size[0]
    edge_y = (0.5 - np.abs(v * rows - row - 0.5)) / rows * size[1]
    edge = np.minimum(edge_x, edge_y) + 40 * warp
    tones = random.normal(0, 1, (rows + 1, columns + 1, 3))[row % rows, column % columns]
    red = np.array([0.60, 0.34, 0.26], np.float32)
    brick = (red * (1 + 0.16 * tones[..., :1]) + 0.03 * tones).clip(0, 1)
    rough = 0.22 * noise(size, (4 * columns, 3 * rows), 3, random)
    brick = brick * (1 + rough + 0.25 * noise(size, (5, 4), 4, random))[..., None]
    mortar = _shade((0.66, 0.63, 0.58), 0.3 * noise(size, (columns, rows), 5, random))
    return _mix(brick, mortar, 1 - (edge - 2.0) / 1.5).clip(0, 1).astype(np.float32)


def cloth(
    size: Size, stripes: int, colours: Sequence[Colour], random: np.random.Generator
) -> np.ndarray:
    """Cloth with horizontal stripes of random widths and colours, and small woven patterns."""
    width, height = size
    edges = np.sort(random.uniform(0, 1, stripes - 1))
    _, v = _grid(size)
    stripe = np.searchsorted(edges, v[:, 0])
    picked = np.asarray(colours, np.float32)[random.integers(0, len(colours), stripes)]
    cloth = np.repeat(picked[stripe][:, None], width, axis=1)
    cell = max(4, width // 48)
    figures = random.random((height // cell + 1, width // cell + 1)) < 0.32
    drawn = np.kron(figures, np.ones((cell, cell)))[:height, :width]
    other = np.asarray(colours, np.float32)[random.integers(0, len(colours), stripes)][stripe]
    cloth = _mix(cloth, other[:, None], drawn)
    return (cloth * (1 + 0.3 * noise(size, (24, 24), 4, random))[..., None]).clip(0, 1)


def _glyph(
    draw: ImageDraw.ImageDraw,
    x: float,
    y: float,
    size: float,
    ink: Ink,
    random: np.random.Generator,
) -> None:
    """A symbol that looks like a letter: a few strokes between the points of a 3 x 3 grid."""
    corners = random.integers(0, 3, (random.integers(3, 6), 2)) * (size * np.array([0.32, 0.45]))
    points = [(float(x + a), float(y + b)) for a, b in corners]
    draw.line(points, fill=ink, width=max(1, round(size * 0.17)), joint="curve")


def _ink(random: np.random.Generator, inks: Sequence[Ink]) -> Ink:
    """A random ink, slightly lighter or darker, so that prints differ."""
    red, green, blue = inks[int(random.integers(len(inks)))]
    change = random.uniform(0.8, 1.15)
    return min(255, int(red * change)), min(255, int(green * change)), min(255, int(blue * change))


def poster(size: Size, random: np.random.Generator, lines: int = 12) -> np.ndarray:
    """A poster, cover or label: coloured shapes, a title and lines of small symbols."""
    scale = 2  # drawn at twice the size, then reduced for smooth edges
    width, height = size[0] * scale, size[1] * scale
    light_paper = random.random() < 0.6
    paper = _ink(random, _LIGHT if light_paper else _DARK)
    image = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(image)
    for _ in range(random.integers(9, 16)):
        x, y = random.uniform(0, width), random.uniform(0, height)
        r = random.uniform(0.06, 0.22) * min(width, height)
        ink = _ink(random, _BRIGHT)
        kind = random.integers(0, 4)
        if kind == 0:
            draw.ellipse((x - r, y - r, x + r, y + r), fill=ink)
        elif kind == 1:
            turn = random.uniform(0, 6.3) + np.arange(3) * 2.1
            draw.polygon([(x + r * math.cos(t), y + r * math.sin(t)) for t in turn], fill=ink)
        elif kind == 2:
            draw.rectangle((x - r, y - r / 2, x + r, y + r / 2), fill=ink)
        else:
            line = max(2, round(0.25 * r))
            draw.ellipse((x - r, y - r, x + r, y + r), outline=ink, width=line)
    ink = _ink(random, _DARK if light_paper else _LIGHT)
    pitch = height / (lines + 2)
    title = min(2.2 * pitch, width / 4)
    for i in range(int(0.9 * width / title)):
        _glyph(draw, (i + 0.1) * title, 0.4 * pitch, title, ink, random)
    for row in range(3, lines + 1):
        if random.random() < 0.35:
            continue
        start, end = sorted(random.uniform(0.04, 0.96, 2) * width)
        for x in np.arange(start, max(end, start + width / 4), 0.8 * pitch):
            _glyph(draw, x, (row + 0.3) * pitch, 0.75 * pitch, ink, random)
    image = image.resize(size, Image.Resampling.BOX)
    sheet = np.asarray(image, np.float32) / 255
    return (sheet * (0.94 + 0.16 * noise(size, (5, 5), 5, random))[..., None]).clip(0, 1)


def spines(size: Size, shelves: int, random: np.random.Generator) -> np.ndarray:
    """Shelves full of books, seen from the front."""
    width, height = size
    sheet = Image.new("RGB", (width * 2, height * 2), (46, 34, 26))
    draw = ImageDraw.Draw(sheet)
    board, shelf = max(3, height // 30), 2 * height / shelves
    for row in range(shelves):
        x, bottom = 0.0, (row + 1) * shelf - 2 * board
        while x < 2 * width:
            thick = random.uniform(0.10, 0.24) * shelf
            top = bottom - random.uniform(0.62, 0.88) * shelf
            if random.random() < 0.93:  # else a gap
                dark_cover = random.random() < 0.5
                cover = _ink(random, _DARK if dark_cover else _BRIGHT)
                ink = _ink(random, _LIGHT if dark_cover else _DARK)
                draw.rectangle((x, top, x + thick - 2, bottom), fill=cover)
                for band in random.uniform(0.05, 0.95, 2):
                    y = top + band * (bottom - top)
                    draw.rectangle((x, y, x + thick - 2, y + 0.02 * shelf), fill=ink)
                for y in np.arange(top + 0.12 * shelf, bottom - 0.2 * shelf, 0.62 * thick):
                    _glyph(draw, x + 0.2 * thick, y, 0.62 * thick, ink, random)
            x += thick
        draw.rectangle((0, bottom, 2 * width, bottom + 2 * board), fill=(150, 108, 66))
    sheet = sheet.resize(size, Image.Resampling.BOX)
    result = np.asarray(sheet, np.float32) / 255
    return (result * (1 + 0.25 * noise(size, (12, 8), 4, random))[..., None]).clip(0, 1)


def paste(
    base: np.ndarray, sheet: np.ndarray, middle: tuple[float, float], width: float, angle: float
) -> np.ndarray:
    """``sheet`` pasted on ``base``: centre (u, v), width relative to ``base``, angle in degrees."""
    target = Image.fromarray(np.rint(255 * base).astype(np.uint8))
    columns = max(2, round(width * target.width))
    size = (columns, max(2, round(columns * sheet.shape[0] / sheet.shape[1])))
    paper = Image.fromarray(np.rint(255 * sheet).astype(np.uint8))
    paper = paper.resize(size, Image.Resampling.LANCZOS).convert("RGBA")
    paper = paper.rotate(angle, Image.Resampling.BICUBIC, expand=True)
    corner = (
        round(middle[0] * target.width - paper.width / 2),
        round(middle[1] * target.height - paper.height / 2),
    )
    target.paste(paper, corner, paper)
    return np.asarray(target, np.float32) / 255


def globe(size: Size, random: np.random.Generator) -> np.ndarray:
    """A map of an invented world, with meridians, parallels and place names."""
    u, v = _grid(size)
    height = noise(size, (5, 3), 6, random)
    land = (height > 0.05).astype(np.float32)
    relief = noise(size, (20, 10), 4, random)
    sea = _shade((0.16, 0.38, 0.56), 0.5 * height + 0.15 * relief)
    green = _shade((0.55, 0.60, 0.28), 0.5 * relief + 0.2)
    ground = _mix(green, (0.74, 0.56, 0.34), 2.5 * (height - 0.3))
    world = _mix(sea, ground, land)
    world = _mix(world, (0.95, 0.92, 0.80), (np.abs(height - 0.05) < 0.02).astype(np.float32))
    for lines, at in ((12, u), (9, v)):
        near = np.abs(at * lines - np.round(at * lines)) / lines
        pixels = near * (size[0] if at is u else size[1]) + 0 * height
        world = _mix(world, (0.10, 0.16, 0.25), 0.7 * (pixels < 1.0))
    image = Image.fromarray(np.rint(255 * world.clip(0, 1)).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    for _ in range(45):
        x, y = random.uniform(0, size[0]), random.uniform(0.15, 0.85) * size[1]
        for i in range(random.integers(3, 7)):
            _glyph(draw, x + i * 9, y, 9, (25, 20, 20), random)
    return np.asarray(image, np.float32) / 255


def marble(size: Size, colour: Colour, vein: Colour, random: np.random.Generator) -> np.ndarray:
    """Stone with veins."""
    fold = noise(size, (3, 3), 5, random) + 0.4 * noise(size, (9, 9), 4, random)
    fine = noise(size, (10, 10), 4, random)
    base = _shade(colour, 0.35 * fine)
    return _mix(base, vein, 1 - np.abs(np.sin(9 * fold)) / 0.28)
