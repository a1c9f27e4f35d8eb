"""Formats of photos that are not read: the user should learn that such photos are not used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath

from snowsplat.data.image_file import OPTIONAL_FORMATS

# The first line: raw photos.
_NAMES = (
    "dng cr2 cr3 crw nef nrw arw srf sr2 orf rw2 raf pef srw x3f raw iiq 3fr fff gpr rwl "
    "avif jxl jp2 j2k jpx jpf jxr psd psb exr hdr tga"
)
#: Suffixes of these formats.
UNREAD_SUFFIXES = frozenset(
    f".{name}" for name in _NAMES.split() if name.upper() not in OPTIONAL_FORMATS
)


def format_name(name: str) -> str:
    """The name of a format, e.g. DNG, from the name of a file."""
    return PurePosixPath(name).suffix[1:].upper()


def unread_photos(files: Iterable[str], read: Sequence[str]) -> str | None:
    """What to say about the photos among ``files`` that are in such a format; None: there are none.

    Cameras save a raw photo and a JPEG of it. Therefore a photo that is also among those that are
    ``read`` does not count.
    """
    also = {_stem(name) for name in read}
    counts = Counter(
        format_name(name)
        for name in files
        if PurePosixPath(name).suffix.lower() in UNREAD_SUFFIXES and _stem(name) not in also
    )
    if not counts:
        return None
    listed = " and ".join(f"{count:,} {name}" for name, count in counts.most_common())
    noun = "photo" if counts.total() == 1 else "photos"
    return f"has {listed} {noun}, which cannot be read; save them as JPEG or PNG first"


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix("")).casefold()
