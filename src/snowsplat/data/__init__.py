"""Posed images: reads COLMAP models and transforms.json files into one type, `Dataset`.

The names below are imported when they are first used: `snowsplat.data.points_ply` and other modules
can be imported without torch.
"""

from typing import TYPE_CHECKING

from snowsplat.util.lazy import lazy_names

if TYPE_CHECKING:
    from snowsplat.data.dataset import Dataset as Dataset
    from snowsplat.data.dataset import Points as Points
    from snowsplat.data.dataset import View as View
    from snowsplat.data.frame.bounds import scene_extent as scene_extent
    from snowsplat.data.load import DatasetFiles as DatasetFiles
    from snowsplat.data.load import load_dataset as load_dataset
    from snowsplat.data.load import read_dataset as read_dataset
    from snowsplat.data.load import read_files as read_files
    from snowsplat.data.load import read_undamaged as read_undamaged
    from snowsplat.data.photos.decode import ImageSource as ImageSource
    from snowsplat.data.photos.decode import LoadedImage as LoadedImage
    from snowsplat.data.photos.image_loader import ImageLoader as ImageLoader

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
__all__ = sorted(_MODULES)
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
