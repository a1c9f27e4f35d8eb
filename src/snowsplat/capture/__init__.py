"""Photos with known cameras, from whatever describes them, as one `Capture`."""

from snowsplat.capture.capture import Capture, Points, View, scene_extent
from snowsplat.capture.decode import ImageSource, LoadedImage
from snowsplat.capture.images import ImageLoader
from snowsplat.capture.load import load_capture

__all__ = [
    "Capture",
    "ImageLoader",
    "ImageSource",
    "LoadedImage",
    "Points",
    "View",
    "load_capture",
    "scene_extent",
]
