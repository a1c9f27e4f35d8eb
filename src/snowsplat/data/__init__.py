"""Posed images: reads COLMAP models and transforms.json files into one type, `Dataset`."""

from snowsplat.data.dataset import Dataset, Points, View, scene_extent
from snowsplat.data.decode import ImageSource, LoadedImage
from snowsplat.data.image_loader import ImageLoader
from snowsplat.data.load import DatasetFiles, load_dataset, read_files

__all__ = [
    "Dataset",
    "DatasetFiles",
    "ImageLoader",
    "ImageSource",
    "LoadedImage",
    "Points",
    "View",
    "load_dataset",
    "read_files",
    "scene_extent",
]
