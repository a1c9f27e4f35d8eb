"""The suffixes of photos and videos that are read: one list, which needs no torch."""

from snowsplat.data.photos.image_file import OPTIONAL_FORMATS


def _suffixes(names: str) -> frozenset[str]:
    return frozenset(f".{name}" for name in names.lower().split())


PHOTO_SUFFIXES = _suffixes(
    "jpg jpeg jpe jfif mpo png webp tif tiff heic heif hif bmp ppm " + " ".join(OPTIONAL_FORMATS)
)
VIDEO_SUFFIXES = _suffixes(
    "mp4 mov m4v mkv avi webm mpg mpeg mts m2ts ts 3gp 3g2 wmv ogv mjpeg flv insv gif"
)
