"""3D Gaussian Splatting that runs on any computer.

    import snowsplat

    made = snowsplat.make("photos", "garden_scene")
    snowsplat.render_video("garden_scene")

or, to control each step of the training,

    dataset = snowsplat.load_dataset("path/to/dataset")
    trainer = snowsplat.Trainer(dataset, snowsplat.recipe("default", iterations=1000))
    trainer.run()
    snowsplat.write_gaussians("scene.ply", trainer.gaussians)

The public names are listed below; each is imported when it is first used, so that importing the
package does not import torch. `render` is in `snowsplat.scene.render`, the numerical operations are
in `snowsplat.ops`.
"""

from typing import TYPE_CHECKING

from snowsplat._version import __version__
from snowsplat.util.lazy import lazy_names

if TYPE_CHECKING:
    from snowsplat.data import Dataset, Points, View, load_dataset
    from snowsplat.evaluation.metrics import evaluate_views
    from snowsplat.extras.globe.make_globe import make_globe
    from snowsplat.extras.globe.options import GlobeOptions
    from snowsplat.extras.image.fit_image import decode_image, fit_image
    from snowsplat.extras.image.options import FitOptions
    from snowsplat.extras.lift.lift_photo import LiftResult, lift_photo
    from snowsplat.extras.lift.options import DepthSource, LiftOptions
    from snowsplat.extras.lift.refine_photo import refine_photo
    from snowsplat.formats import read_gaussians
    from snowsplat.pipeline.benchmark.run import benchmark
    from snowsplat.pipeline.blocks.plan import plan_blocks
    from snowsplat.pipeline.blocks.train import merge_blocks, train_blocks
    from snowsplat.pipeline.clean import clean
    from snowsplat.pipeline.compute import Compute
    from snowsplat.pipeline.convert import convert
    from snowsplat.pipeline.describe import describe
    from snowsplat.pipeline.make import make
    from snowsplat.pipeline.observer import Observer
    from snowsplat.pipeline.options.benchmark import BenchmarkOptions, PlanOptions
    from snowsplat.pipeline.options.make import MakeOptions
    from snowsplat.pipeline.options.scene import Edits, PublishOptions
    from snowsplat.pipeline.options.train import TrainOptions
    from snowsplat.pipeline.options.video import VideoOptions
    from snowsplat.pipeline.output.scene_files import write_gaussians
    from snowsplat.pipeline.output.scene_source import load_trained
    from snowsplat.pipeline.publish import publish
    from snowsplat.pipeline.render import evaluate, render_images
    from snowsplat.pipeline.run.results import TrainingStopped
    from snowsplat.pipeline.train import resume, train
    from snowsplat.pipeline.videos import render_video
    from snowsplat.scene.camera import Camera
    from snowsplat.scene.gaussians import Gaussians
    from snowsplat.scene.rasterization import rasterization
    from snowsplat.training.core.trainer import Trainer
    from snowsplat.training.parts.list import parts_of, register_part
    from snowsplat.training.parts.part import Part
    from snowsplat.training.settings.config import TrainConfig
    from snowsplat.training.settings.recipes import recipe
    from snowsplat.util.errors import UserError


_MODULES = {
    "Camera": "scene.camera",
    "Compute": "pipeline.compute",
    "Dataset": "data",
    "DepthSource": "extras.lift.options",
    "Edits": "pipeline.options.scene",
    "FitOptions": "extras.image.options",
    "Gaussians": "scene.gaussians",
    "GlobeOptions": "extras.globe.options",
    "LiftOptions": "extras.lift.options",
    "LiftResult": "extras.lift.lift_photo",
    "MakeOptions": "pipeline.options.make",
    "Observer": "pipeline.observer",
    "Part": "training.parts.part",
    "Points": "data",
    "TrainConfig": "training.settings.config",
    "TrainOptions": "pipeline.options.train",
    "Trainer": "training.core.trainer",
    "TrainingStopped": "pipeline.run.results",
    "UserError": "util.errors",
    "VideoOptions": "pipeline.options.video",
    "View": "data",
    "convert": "pipeline.convert",
    "decode_image": "extras.image.fit_image",
    "describe": "pipeline.describe",
    "evaluate": "pipeline.render",
    "evaluate_views": "evaluation.metrics",
    "fit_image": "extras.image.fit_image",
    "load_dataset": "data",
    "clean": "pipeline.clean",
    "lift_photo": "extras.lift.lift_photo",
    "load_trained": "pipeline.output.scene_source",
    "make": "pipeline.make",
    "make_globe": "extras.globe.make_globe",
    "BenchmarkOptions": "pipeline.options.benchmark",
    "benchmark": "pipeline.benchmark.run",
    "PlanOptions": "pipeline.options.benchmark",
    "PublishOptions": "pipeline.options.scene",
    "merge_blocks": "pipeline.blocks.train",
    "parts_of": "training.parts.list",
    "plan_blocks": "pipeline.blocks.plan",
    "train_blocks": "pipeline.blocks.train",
    "publish": "pipeline.publish",
    "rasterization": "scene.rasterization",
    "read_gaussians": "formats",
    "recipe": "training.settings.recipes",
    "register_part": "training.parts.list",
    "refine_photo": "extras.lift.refine_photo",
    "render_images": "pipeline.render",
    "render_video": "pipeline.videos",
    "resume": "pipeline.train",
    "train": "pipeline.train",
    "write_gaussians": "pipeline.output.scene_files",
}

__all__ = [
    "BenchmarkOptions",
    "Camera",
    "Compute",
    "Dataset",
    "DepthSource",
    "Edits",
    "FitOptions",
    "Gaussians",
    "GlobeOptions",
    "LiftOptions",
    "LiftResult",
    "MakeOptions",
    "Observer",
    "Part",
    "PlanOptions",
    "Points",
    "PublishOptions",
    "TrainConfig",
    "TrainOptions",
    "Trainer",
    "TrainingStopped",
    "UserError",
    "VideoOptions",
    "View",
    "__version__",
    "benchmark",
    "clean",
    "convert",
    "decode_image",
    "describe",
    "evaluate",
    "evaluate_views",
    "fit_image",
    "lift_photo",
    "load_dataset",
    "load_trained",
    "make",
    "make_globe",
    "merge_blocks",
    "parts_of",
    "plan_blocks",
    "publish",
    "rasterization",
    "read_gaussians",
    "recipe",
    "refine_photo",
    "register_part",
    "render_images",
    "render_video",
    "resume",
    "train",
    "train_blocks",
    "write_gaussians",
]

__getattr__, __dir__ = lazy_names(__name__, _MODULES)
