"""3D Gaussian Splatting that runs on any computer.

    import snowsplat

    dataset = snowsplat.load_dataset("path/to/dataset")
    trainer = snowsplat.Trainer(dataset, snowsplat.recipe("default", iterations=1000))
    trainer.run()
    snowsplat.write_gaussians("scene.ply", trainer.gaussians)

The public names are below; each is imported when it is first used, so that `snowsplat --help` does
not wait for torch. `render` is in `snowsplat.scene.render`, the numerical operations are in
`snowsplat.ops`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from snowsplat._version import __version__

if TYPE_CHECKING:
    from snowsplat.data import Dataset, Points, View, load_dataset
    from snowsplat.evaluation.metrics import evaluate_views
    from snowsplat.formats import read_gaussians, write_gaussians
    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians
    from snowsplat.training.config import TrainConfig
    from snowsplat.training.recipes import recipe
    from snowsplat.training.trainer import Trainer
    from snowsplat.util.errors import UserError


_MODULES = {
    "Camera": "scene.camera",
    "Dataset": "data",
    "Gaussians": "scene.gaussians",
    "Points": "data",
    "TrainConfig": "training.config",
    "Trainer": "training.trainer",
    "UserError": "util.errors",
    "View": "data",
    "evaluate_views": "evaluation.metrics",
    "load_dataset": "data",
    "read_gaussians": "formats",
    "recipe": "training.recipes",
    "write_gaussians": "pipeline.scene_files",
}

__all__ = [
    "Camera",
    "Dataset",
    "Gaussians",
    "Points",
    "TrainConfig",
    "Trainer",
    "UserError",
    "View",
    "__version__",
    "evaluate_views",
    "load_dataset",
    "read_gaussians",
    "recipe",
    "write_gaussians",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'snowsplat' has no attribute {name!r}")
    value = getattr(import_module(f"snowsplat.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals().keys() | set(__all__))
