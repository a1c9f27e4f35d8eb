"""COLMAP's text files: cameras.txt, images.txt, points3D.txt."""

import logging
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from snowsplat.data.colmap.types import (
    TRACKS,
    ColmapImage,
    PointFile,
    check_count,
    checked_camera,
    damaged_model,
    track_rows,
)
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.models import COLMAP_MODELS
from snowsplat.util.errors import UserError
from snowsplat.util.files import reading, shown
from snowsplat.util.safe_json import encoding_of, lenient

logger = logging.getLogger(__name__)

# More words of a line are not split, to limit the memory for a damaged one. A camera has at most
# 4 + 16 words; a frame has 10, and three for each of its images.
_MAX_FRAME_WORDS = 10 + 3 * 1000
_MAX_CAMERA_WORDS = 20
# Characters of the name of an image.
_LONGEST_NAME = 1000
# Lines of points3D.txt that are parsed at once.
_LINES_PER_BLOCK = 50_000
# Characters of a long line whose words are counted at once.
_CHARACTERS_PER_BLOCK = 1 << 20
# Characters of a track; a longer one is not used, as its line may be damaged.
_LONGEST_TRACK = 1 << 16


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text file, without comments."""
    with reading(path), _open(path) as file:
        for line in file:
            if not line.startswith("#"):
                yield line.strip()


def _open(path: Path) -> TextIO:
    with open(path, "rb") as file:
        encoding, errors = lenient(encoding_of(file.read(2)))
    return open(path, encoding=encoding, errors=errors)


def _count_words(line: str) -> int:
    """Number of words in a line, block by block: `str.split` takes 60 bytes of memory per word."""
    count = 0
    for start in range(0, len(line), _CHARACTERS_PER_BLOCK):
        block = line[start : start + _CHARACTERS_PER_BLOCK]
        continues_word = start > 0 and not line[start - 1].isspace() and not block[0].isspace()
        count += len(block.split()) - continues_word
    return count


def _warn_if_fewer(path: Path, kind: str, count: int) -> None:
    # COLMAP writes the number into a comment. It may be outdated if somebody edited the file, so
    # a difference is only a warning.
    with _open(path) as file:
        head = file.read(1000)
    declared = re.search(rf"^#.*Number of {kind}: (\d{{1,12}})\b", head, re.MULTILINE)
    if declared and int(declared[1]) > count:
        logger.warning(
            "%s: has %d %s, but its comment declares %s; the file may be truncated",
            path,
            count,
            kind,
            declared[1],
        )


def read_cameras(path: Path) -> dict[int, Lens]:
    """Read a cameras.txt: cameras by id.

    Raises:
        UserError: the file is unreadable or damaged.
    """
    models = {model.name: model for model in COLMAP_MODELS}
    cameras = {}
    for line in filter(None, _lines(path)):
        words = line.split(maxsplit=_MAX_CAMERA_WORDS)
        try:
            camera_id, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            params = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError):
            raise damaged_model(path, f"not a camera: line {shown(line[:60])!r}") from None
        if model not in models:
            raise UserError(
                "{path}: unknown camera model {model!r}; undistort the images with the program "
                "that made it",
                path=path,
                model=shown(model[:40]),
            )
        if len(params) != len(models[model].parameters):
            raise damaged_model(path, f"{len(params)} parameters for camera model {model[:40]}")
        cameras[camera_id] = checked_camera(path, models[model], width, height, params)
        check_count(path, "cameras", len(cameras))
    _warn_if_fewer(path, "cameras", len(cameras))
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    """Read an images.txt, in the order of the file. Observations are skipped.

    Raises: UserError: the file is unreadable or damaged.
    """
    images = [image for image, _ in _images(path)]
    _warn_if_fewer(path, "images", len(images))
    return images


def read_observations(path: Path, wanted: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """As `binary.read_observations`, of an images.txt."""
    found = {}
    for image, line in _images(path):
        if image.number in wanted:
            words = line.split() if len(line) <= _CHARACTERS_PER_BLOCK * 4 else []
            rows = [words[3 * i : 3 * i + 3] for i in wanted[image.number].tolist()]
            try:
                values = np.array([row or ["nan"] * 3 for row in rows], np.float64)
            except ValueError:
                raise damaged_model(path, f"the observations of image {image.name[:80]}") from None
            found[image.number] = values.reshape(-1, 3)
    return found


def _images(path: Path) -> Iterator[tuple[ColmapImage, str]]:
    """The images of an images.txt, and the lines of their observations."""
    image: ColmapImage | None = None
    count = 0
    # Each image has a second line: x, y and point id of each observation. It may be empty. Some
    # programs do not write it.
    for line in _lines(path):
        if image is not None and not _is_image(line):
            if _count_words(line) % 3:
                name = image.name[:80]
                raise damaged_model(
                    path, f"the line after image {name} should hold its observations"
                )
            yield image, line
            image = None
        elif line:
            if image is not None:
                yield image, ""
            words = line.split(maxsplit=9)
            try:
                pose = tuple(map(float, words[1:8]))
                image = ColmapImage(words[9], int(words[8]), pose, int(words[0]))
            except (ValueError, IndexError):
                raise damaged_model(path, f"not an image: line {shown(line[:60])!r}") from None
            check_count(path, "images", count := count + 1)
    if image is not None:
        yield image, ""


def _is_image(line: str) -> bool:
    """Whether a line is an image: a rotation and a name. Observations are numbers, in threes."""
    words = line.split(maxsplit=9)
    if len(words) < 10 or len(words[9]) > _LONGEST_NAME:
        return False
    try:
        _, _ = int(words[0]), int(words[8])
        norm = math.hypot(*map(float, words[1:5]))
    except ValueError:
        return False
    if not (0.5 < norm < 2.0 and all(map(_is_number, words[5:8]))):
        return False
    return not all(map(_is_number, words[9].split())) or _count_words(line) % 3 != 0


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_frames(path: Path) -> list[tuple[int, list[int]]]:
    """Read a frames.txt: the id of each frame and the ids of its images.

    Raises: UserError: the file is unreadable or damaged.
    """
    frames = []
    for line in filter(None, _lines(path)):
        words = line.split(maxsplit=_MAX_FRAME_WORDS)
        try:
            data = zip(words[10::3], words[12::3], strict=True)
            frames.append((int(words[0]), [int(image) for kind, image in data if kind == "CAMERA"]))
        except (ValueError, IndexError):
            raise damaged_model(path, f"not a frame: line {shown(line[:60])!r}") from None
        check_count(path, "frames", len(frames))
    return frames


def read_points(path: Path) -> PointFile:
    """Read a points3D.txt. Raises: UserError: the file is unreadable or damaged."""
    # Rows end with tracks of different lengths. numpy's reader is fast, but it would split the
    # complete track into words, so it gets only the columns that are used. The error, which is
    # not, and the track may be missing.
    tracks: dict[int, str] = {}
    lines = _points_without_tracks(path, tracks)
    ids, xyz, rgb = [np.empty(0, np.int64)], [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    while block := list(islice(lines, _LINES_PER_BLOCK)):
        try:
            values = np.loadtxt(
                block, np.float64, comments=None, usecols=(0, 1, 2, 3, 4, 5, 6), ndmin=2
            )
        except (ValueError, IndexError) as error:
            raise damaged_model(path, f"not points ({' '.join(str(error).split())[:90]})") from None
        colours = values[:, 4:7]
        if not ((colours >= 0) & (colours <= 255)).all():
            raise damaged_model(path, "a colour is outside 0..255")
        ids.append(values[:, 0].astype(np.int64))
        xyz.append(values[:, 1:4].copy())
        rgb.append(colours.astype(np.uint8))
    _warn_if_fewer(path, "points", sum(map(len, xyz)))
    return PointFile(
        np.concatenate(xyz),
        np.concatenate(rgb),
        np.concatenate(ids),
        track_rows({row: _pairs(track) for row, track in tracks.items()}),
    )


def _pairs(track: str) -> np.ndarray:
    """(N, 2) int64; none of a track that is damaged, because no point needs its track."""
    try:
        return np.array(track.split(), np.int64).reshape(-1, 2)
    except (ValueError, OverflowError):
        return np.empty((0, 2), np.int64)


def _points_without_tracks(path: Path, tracks: dict[int, str]) -> Iterator[str]:
    """The lines of a points3D.txt without their ends, the tracks; some of these go to ``tracks``,
    by row."""
    every = 1
    for row, line in enumerate(filter(None, _lines(path))):
        words = line.split(maxsplit=8)
        if row % every == 0:
            track = "".join(words[8:])
            tracks[row] = track if len(track) <= _LONGEST_TRACK else ""
            if len(tracks) > TRACKS:
                every *= 2
                for odd in [row for row in tracks if row % every]:
                    del tracks[odd]
        yield " ".join(words[:7])


# str() of a float is the shortest text that reads back as the same number.


def camera_record(number: int, camera: Lens) -> str:
    return " ".join(map(str, (number, camera.model, camera.width, camera.height, *camera.params)))


def image_record(number: int, image: ColmapImage) -> str:
    """Of an image without observations: their line is empty."""
    return " ".join(map(str, (number, *image.pose, image.camera_id, image.name))) + "\n"


def point_record(
    number: int, position: list[float], colour: list[int], track: Sequence[tuple[int, int]]
) -> str:
    return " ".join(map(str, (number, *position, *colour, 0.0, *sum(track, ()))))


def write_records(path: Path, records: list[str]) -> None:
    """Write cameras.txt, images.txt or points3D.txt."""
    kind = path.stem.removesuffix("3D")
    text = "\n".join([f"# Number of {kind}: {len(records)}", *records, ""])
    path.write_text(text, encoding="utf-8")
