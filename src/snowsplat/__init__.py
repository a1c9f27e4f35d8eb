"""3D Gaussian Splatting that runs on any computer.

    import snowsplat

    capture = snowsplat.load_capture("path/to/capture")
    trainer = snowsplat.Trainer(capture, snowsplat.recipe("default", iterations=1000))
    trainer.run()
    snowsplat.write_gaussians("scene.ply", trainer.gaussians)

The public names are below; each is imported when it is first used, so that `snowsplat --help` does
not wait for torch. `render` is in `snowsplat.render`, the numerical operations are in
`snowsplat.ops`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from snowsplat.camera import Camera
    from snowsplat.capture import Capture, Points, View, load_capture
    from snowsplat.config import TrainConfig
    from snowsplat.errors import UserError
    from snowsplat.evaluate import evaluate_views
    from snowsplat.formats import read_gaussians, write_gaussians
    from snowsplat.gaussians import Gaussians
    from snowsplat.recipes import recipe
    from snowsplat.trainer import Trainer

__version__ = "0.1.0"

_MODULES = {
    "Camera": "camera",
    "Capture": "capture",
    "Gaussians": "gaussians",
    "Points": "capture",
    "TrainConfig": "config",
    "Trainer": "trainer",
    "UserError": "errors",
    "View": "capture",
    "evaluate_views": "evaluate",
    "load_capture": "capture",
    "read_gaussians": "formats",
    "recipe": "recipes",
    "write_gaussians": "formats",
}

__all__ = [
    "Camera",
    "Capture",
    "Gaussians",
    "Points",
    "TrainConfig",
    "Trainer",
    "UserError",
    "View",
    "evaluate_views",
    "load_capture",
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
