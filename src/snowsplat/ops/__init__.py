"""The numerical operations on tensors: native kernels, and a PyTorch reference in `reference`.

Forward: `project(gaussians, view)` → `Splats2D` → `rasterize` → `photometric_loss`.
`adam_step(gaussians, moments, gradient, view, rates)` propagates the gradient of the splats to the
parameters and updates them.
"""

from snowsplat.ops.activated import project_activated, with_centres
from snowsplat.ops.adam import AdamRates, Moments, adam_step
from snowsplat.ops.camera_gradient import camera_gradient
from snowsplat.ops.capacity import Capacity
from snowsplat.ops.devices import default_device, device_name, resolve_device
from snowsplat.ops.frusta import Frusta, points_in_frusta, points_in_spheres
from snowsplat.ops.fusion import fuse_depth
from snowsplat.ops.gaussian_parameters import GaussianParameters, View
from snowsplat.ops.native import get_num_threads, set_num_threads
from snowsplat.ops.nearest_neighbours import neighbours
from snowsplat.ops.noise import add_noise
from snowsplat.ops.photometric import photometric_loss, ssim
from snowsplat.ops.projection import add_project_gradients, project
from snowsplat.ops.rasterizer import count_blended, rasterize, rasterize_median
from snowsplat.ops.splats import SplatGradient, Splats2D
from snowsplat.ops.statistic import accumulate_screen_statistics
from snowsplat.ops.sweep import plane_sweep

__all__ = [
    "AdamRates",
    "Capacity",
    "Frusta",
    "GaussianParameters",
    "Moments",
    "SplatGradient",
    "Splats2D",
    "View",
    "accumulate_screen_statistics",
    "adam_step",
    "add_noise",
    "add_project_gradients",
    "camera_gradient",
    "count_blended",
    "default_device",
    "device_name",
    "fuse_depth",
    "get_num_threads",
    "neighbours",
    "photometric_loss",
    "plane_sweep",
    "points_in_frusta",
    "points_in_spheres",
    "project",
    "project_activated",
    "rasterize",
    "rasterize_median",
    "resolve_device",
    "set_num_threads",
    "ssim",
    "with_centres",
]
