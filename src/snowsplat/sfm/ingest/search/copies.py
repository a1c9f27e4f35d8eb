"""Leaves out the photos that show the same picture as another one.

A copy of a photo is no second view, and a copy of a held-out photo in the training falsifies the
evaluation. Copies are equal files, and files whose names say that they may be copies (IMG_1.HEIC
and IMG_1.JPG, "IMG_1 (1).jpg", images_4/IMG_1.jpg) and whose pixels agree.
"""

import hashlib
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from snowsplat.data.files.listing import fold_name
from snowsplat.data.maps.mask_pixels import has_shape, looks_like_mask
from snowsplat.sfm.ingest.photos.photo_files import Unusable, open_image, read_header
from snowsplat.util.components import components

# What programs add to the name of a copy: "IMG (1)", "IMG - Copy (2)", "IMG copy", "IMG-edited".
_COPY = re.compile(
    r"(.+?)(?:(?: -)?[ _-](?:copy|kopie|copie|copia|副本|コピー))?(?: ?\(\d{1,3}\)| \d)?"
    r"(?:[._-](?:edited|bearbeitet|thumb|thumbnail|small|preview))?"
)
# The edited photo IMG_E0001 of IMG_0001, as phones call it.
_EDITED = re.compile(r"^img_e(?=\d)")
# Photos are compared at this size. Photos from different places have a correlation below 0.99; a
# copy of another size and quality has more than 0.998, even of a picture with much fine detail.
_SIDE = 32
_SAME = 0.996
# A share of opaque pixels that tells something.
_FEWEST_OPAQUE = 0.02
# More names than this that differ only as copies do are numbers: "photo (1)" to "photo (300)".
_MOST_COPIES = 8
# Pairs of two kinds of files (two folders, two suffixes) that are compared before the others.
_SAMPLE = 5


@dataclass(frozen=True)
class _Kind:
    """What the names of files have in common that were copied in one way."""

    folder: str
    suffix: str
    added: str  # to the name


def find_copies(root: Path, names: Sequence[str]) -> dict[str, str]:
    """The photos that can be left out, in the order of ``names``, and those that are used instead.

    Of the photos of one picture, that with a transparent background is used, else the largest one.

    ``names``: files relative to ``root``, with "/".
    """
    same = list(_equal_files(root, names))
    by_stem: dict[str, list[str]] = {}
    for name in names:
        by_stem.setdefault(_stem_and_kind(name)[0], []).append(name)
    pairs: dict[tuple[_Kind, _Kind], list[tuple[str, str]]] = {}
    for alike in by_stem.values():
        if 2 <= len(alike) <= _MOST_COPIES:
            for one, other in itertools.combinations(alike, 2):
                kinds = _stem_and_kind(one)[1], _stem_and_kind(other)[1]
                pairs.setdefault(kinds, []).append((one, other))
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="copies") as pool:

        def compare(some: Sequence[tuple[str, str]]) -> dict[tuple[str, str], bool]:
            return dict(zip(some, pool.map(lambda p: _show_same(root, *p), some), strict=True))

        for of_kind in pairs.values():
            chosen = np.unique(np.linspace(0, len(of_kind) - 1, min(len(of_kind), _SAMPLE)))
            is_same = compare([of_kind[round(i)] for i in chosen])
            if all(is_same.values()) and len(is_same) == _SAMPLE:
                is_same = dict.fromkeys(of_kind, True)
            elif any(is_same.values()):
                is_same |= compare([pair for pair in of_kind if pair not in is_same])
            same += [pair for pair, value in is_same.items() if value]
    index = {name: i for i, name in enumerate(names)}
    links = np.array([(index[one], index[other]) for one, other in same], np.int64).reshape(-1, 2)
    groups: dict[int, list[str]] = {}
    for name, label in zip(names, components(links.T, len(names)).tolist(), strict=True):
        groups.setdefault(label, []).append(name)
    best = {label: _best(root, group) for label, group in groups.items() if len(group) > 1}
    used = {name: best[label] for label in best for name in groups[label]}
    return {name: used[name] for name in names if used.get(name, name) != name}


def _stem_and_kind(name: str) -> tuple[str, _Kind]:
    path = PurePosixPath(name)
    stem = fold_name(path.stem)
    match = _COPY.fullmatch(stem)
    base = match[1] if match else stem
    kind = _Kind(str(path.parent), path.suffix.lower(), stem[len(base) :])
    return _EDITED.sub("img_", base), kind


def _equal_files(root: Path, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Pairs of files with the same bytes. Masks and plain pictures may be equal by chance."""
    by_size: dict[int, list[str]] = {}
    for name in names:
        by_size.setdefault((root / name).stat().st_size, []).append(name)
    for alike in by_size.values():
        first: dict[bytes, str] = {}
        for name in alike if len(alike) > 1 else ():
            digest = _digest(root / name)
            if digest not in first:
                first[digest] = name
            elif _is_readable(root / name) and not looks_like_mask(root / name):
                yield first[digest], name


def _is_readable(path: Path) -> bool:
    try:
        read_header(path)
    except Unusable:
        return False
    return True


def _digest(path: Path) -> bytes:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.digest()


def _show_same(root: Path, one: str, other: str) -> bool:
    """Whether two photos show the same picture: up to size, compression, brightness, contrast."""
    a, b = _small(root / one), _small(root / other)
    if a is None or b is None or not has_shape(a[0], b[0]):
        return False
    weight = a[2] * b[2]
    if weight.mean() < _FEWEST_OPAQUE:
        return False
    x, y = (values - np.average(values, weights=weight) for values in (a[1], b[1]))
    scale = np.sqrt((weight * x * x).sum() * (weight * y * y).sum())
    return bool(scale > 0 and (weight * x * y).sum() >= _SAME * scale)


def _small(path: Path) -> tuple[tuple[int, int], np.ndarray, np.ndarray] | None:
    """Width and height of a photo, and its brightness and opacity, ``_SIDE`` × ``_SIDE`` float."""
    try:
        with open_image(path) as opened:
            width, height = opened.size
            opened.draft("RGB", (8 * _SIDE, 8 * _SIDE))
            image = ImageOps.exif_transpose(opened).convert("RGBA")
    except Exception:  # Pillow raises many kinds of exceptions for damaged files
        return None
    if (image.width > image.height) != (width > height):  # rotated
        width, height = height, width
    small = np.asarray(image.resize((_SIDE, _SIDE), Image.Resampling.BOX), np.float64)
    return (width, height), small[..., :3].mean(axis=2), small[..., 3] / 255


def _best(root: Path, names: Sequence[str]) -> str:
    """The photo to use of those that show the same picture."""

    def value(name: str) -> tuple[bool, int, bool, bool, int]:
        added = len(_stem_and_kind(name)[1].added)
        try:
            header = read_header(root / name)
        except Unusable:
            return False, 0, False, False, -added
        return (
            header.transparent,
            header.width * header.height,
            header.exif.focal is not None,
            header.format in ("JPEG", "MPO"),  # needs no conversion
            -added,
        )

    return max(names, key=value)
