"""Posed images: reads COLMAP models and transforms.json files into one type, `Dataset`.

The names below are imported when they are first used: `snowsplat.data.points_ply` and other modules
can be imported without torch.
"""

from typing import TYPE_CHECKING

from snowsplat.util.lazy import lazy_names

if TYPE_CHECKING:
    from snowsplat.data.dataset import Dataset, Points, View
    from snowsplat.data.frame.bounds import scene_extent
    from snowsplat.data.load import (
        DatasetFiles,
        load_dataset,
        read_dataset,
        read_files,
        read_undamaged,
    )
    from snowsplat.data.photos.decode import ImageSource, LoadedImage
    from snowsplat.data.photos.image_loader import ImageLoader

__all__ = [
    "Dataset",
    "DatasetFiles",
    "ImageLoader",
    "ImageSource",
    "LoadedImage",
    "Points",
    "View",
    "load_dataset",
    "read_dataset",
    "read_files",
    "read_undamaged",
    "scene_extent",
]

_MODULES = {
    "Dataset": "dataset",
    "DatasetFiles": "load",
    "ImageLoader": "photos.image_loader",
    "ImageSource": "photos.decode",
    "LoadedImage": "photos.decode",
    "Points": "dataset",
    "View": "dataset",
    "load_dataset": "load",
    "read_dataset": "load",
    "read_files": "load",
    "read_undamaged": "load",
    "scene_extent": "frame.bounds",
}
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
