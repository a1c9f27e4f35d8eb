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

from snowsplat._version import __version__ as __version__
from snowsplat.util.lazy import lazy_names

if TYPE_CHECKING:
    from snowsplat.data import Dataset as Dataset
    from snowsplat.data import Points as Points
    from snowsplat.data import View as View
    from snowsplat.data import load_dataset as load_dataset
    from snowsplat.evaluation.metrics import evaluate_views as evaluate_views
    from snowsplat.extras.globe.make_globe import make_globe as make_globe
    from snowsplat.extras.globe.options import GlobeOptions as GlobeOptions
    from snowsplat.extras.image.fit_image import decode_image as decode_image
    from snowsplat.extras.image.fit_image import fit_image as fit_image
    from snowsplat.extras.image.options import FitOptions as FitOptions
    from snowsplat.extras.lift.lift_photo import LiftResult as LiftResult
    from snowsplat.extras.lift.lift_photo import lift_photo as lift_photo
    from snowsplat.extras.lift.options import DepthSource as DepthSource
    from snowsplat.extras.lift.options import LiftOptions as LiftOptions
    from snowsplat.extras.lift.refine_photo import refine_photo as refine_photo
    from snowsplat.formats import read_gaussians as read_gaussians
    from snowsplat.pipeline.benchmark.run import benchmark as benchmark
    from snowsplat.pipeline.blocks.plan import plan_blocks as plan_blocks
    from snowsplat.pipeline.blocks.train import merge_blocks as merge_blocks
    from snowsplat.pipeline.blocks.train import train_blocks as train_blocks
    from snowsplat.pipeline.clean import clean as clean
    from snowsplat.pipeline.compute import Compute as Compute
    from snowsplat.pipeline.convert import convert as convert
    from snowsplat.pipeline.describe import describe as describe
    from snowsplat.pipeline.make import make as make
    from snowsplat.pipeline.observer import Observer as Observer
    from snowsplat.pipeline.options.benchmark import BenchmarkOptions as BenchmarkOptions
    from snowsplat.pipeline.options.benchmark import PlanOptions as PlanOptions
    from snowsplat.pipeline.options.make import MakeOptions as MakeOptions
    from snowsplat.pipeline.options.scene import Edits as Edits
    from snowsplat.pipeline.options.scene import PublishOptions as PublishOptions
    from snowsplat.pipeline.options.train import TrainOptions as TrainOptions
    from snowsplat.pipeline.options.video import VideoOptions as VideoOptions
    from snowsplat.pipeline.output.scene_files import write_gaussians as write_gaussians
    from snowsplat.pipeline.output.scene_source import load_trained as load_trained
    from snowsplat.pipeline.publish import publish as publish
    from snowsplat.pipeline.render import evaluate as evaluate
    from snowsplat.pipeline.render import render_images as render_images
    from snowsplat.pipeline.run.results import TrainingStopped as TrainingStopped
    from snowsplat.pipeline.train import resume as resume
    from snowsplat.pipeline.train import train as train
    from snowsplat.pipeline.videos import render_video as render_video
    from snowsplat.scene.camera import Camera as Camera
    from snowsplat.scene.gaussians import Gaussians as Gaussians
    from snowsplat.scene.rasterization import rasterization as rasterization
    from snowsplat.training.core.trainer import Trainer as Trainer
    from snowsplat.training.parts.list import parts_of as parts_of
    from snowsplat.training.parts.list import register_part as register_part
    from snowsplat.training.parts.part import Part as Part
    from snowsplat.training.settings.config import TrainConfig as TrainConfig
    from snowsplat.training.settings.recipes import recipe as recipe
    from snowsplat.util.errors import UserError as UserError


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

__all__ = sorted([*_MODULES, "__version__"])
__getattr__, __dir__ = lazy_names(__name__, _MODULES)
