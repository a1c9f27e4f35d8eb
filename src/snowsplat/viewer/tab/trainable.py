"""`write_trainable`: a single HTML page with the photos of a dataset, which trains in a browser.

The page runs the kernels of `native/wgsl` with WebGPU, and makes no network requests: it contains
photos, cameras and the first Gaussians. It can be opened from disk.
"""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data import Dataset, View
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.scene.geometry import quat_from_rotation
from snowsplat.scene.render import to_8bit
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import AdaptiveDensity
from snowsplat.training.settings.recipes import changed, recipe
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.starts.init import initial_gaussians
from snowsplat.trajectory.focus import focus_of, up_of, viewing_distance
from snowsplat.util.files import write_text
from snowsplat.util.html import THEME

#: The longer side of the photos of a page in pixels, at most.
LONGER_SIDE = 512
_MOST_GAUSSIANS = 50_000  # at the start
_QUALITY = 92  # of the photos as JPEG
_PAGE = Path(__file__).parent / "page"
_LIVE = _PAGE.parents[1] / "live" / "page"
_KERNELS = Path(__file__).parents[2] / "native" / "wgsl"
# In an order in which each one only uses those before it.
_MODULES = (
    *(_LIVE / f"{name}.js" for name in ("vectors", "camera", "input", "elements", "curves")),
    *(_PAGE / f"{name}.js" for name in ("words", "gpu", "renderer", "density", "trainer", "ply")),
    _PAGE / "main.js",
)
_SHADERS = (
    *("project", "sort", "tiles", "rasterize"),
    *("photometric", "statistic", "adam"),
)
_IMPORT = re.compile(r"^import [^;]*;\n", re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)


@dataclass(frozen=True)
class Trainable:
    """What a page is made of.

    Attributes:
        photos: their number; ``masked``: how many of them have a mask, which the page ignores.
        gaussians: at the start.
        bytes: the size of the page.
    """

    photos: int
    masked: int
    gaussians: int
    bytes: int


def write_trainable(
    path: Path,
    dataset: Dataset,
    title: str,
    steps: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Trainable:
    """Write the page, atomically.

    Args:
        path: an HTML file.
        dataset: with photos whose longer side is at most `LONGER_SIDE`.
        steps: of the training.
        progress: called after each photo with the number of photos, and that of all.

    Raises:
        UserError: a photo is missing or damaged.
        OSError: the file cannot be written.
    """
    views = [*dataset.train, *dataset.test]
    masked = 0
    photos: list[dict[str, Any]] = []
    config = changed(recipe("classic"), iterations=steps)
    first = replace(config, density=AdaptiveDensity(max_gaussians=_MOST_GAUSSIANS))
    generator = torch.Generator().manual_seed(0)
    with ImageLoader(views, background=(0.0, 0.0, 0.0)) as images:
        images.prefetch(views)
        for index, view in enumerate(views):
            loaded = images.get(view)
            masked += loaded.mask is not None
            photos.append(_photo(view, loaded.over(torch.zeros(3)), index >= len(dataset.train)))
            progress(index + 1, len(views))
        gaussians = initial_gaussians(dataset, first, images, generator, torch.device("cpu"))
    opacity = config.initial_opacity
    data = {
        "file": path.stem,
        "recipe": _recipe(config),
        "near": views[0].camera.near,
        "logit": math.log(opacity / (1 - opacity)),
        "scene": _scene(dataset, views),
        "views": photos,
        "gaussians": {
            "means": _base64(gaussians.means),
            "sizes": _base64(gaussians.log_scales[:, 0]),
            "colors": _base64(gaussians.sh_dc),
        },
        "shaders": {name: _shader(_KERNELS / f"{name}.wgsl") for name in _SHADERS}
        | {"show": _shader(_PAGE / "show.wgsl")},
        "plan": json.loads((_KERNELS / "plan.json").read_text("utf-8")),
    }
    text = page(title, data)
    write_text(path, text)
    return Trainable(len(views), masked, len(gaussians), len(text.encode()))


def page(title: str, data: dict[str, Any]) -> str:
    """The page with this data; its content security policy forbids all network requests."""
    script = "\n".join(
        _EXPORT.sub("", _IMPORT.sub("", module.read_text("utf-8"))) for module in _MODULES
    )
    assert not re.search(r"</script|<!--|<script", script, re.IGNORECASE)
    style = THEME.read_text("utf-8") + (_PAGE / "style.css").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    parts = {
        "policy": html.escape(
            f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
            "img-src data: blob:; base-uri 'none'; form-action 'none'"
        ),
        "title": html.escape(title),
        "style": style,
        "script": script,
        # "<" could end the script element or begin a comment in it.
        "data": json.dumps(data).replace("<", "\\u003c"),
    }
    template = (_PAGE / "index.html").read_text("utf-8")
    return re.sub(r"\{(\w+)\}", lambda found: parts[found[1]], template)


def _recipe(config: TrainConfig) -> dict[str, Any]:
    """What the page needs of the settings; moments are steps."""
    rates, density = config.learning_rates, config.density
    schedule = Schedule(config.iterations)
    assert isinstance(density, AdaptiveDensity)
    names = ("log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
    quarter, half = (schedule.step_of(moment) for moment in config.coarse_to_fine)
    return {
        "steps": config.iterations,
        "means": [rates.means, rates.means_final],
        "rates": {name: getattr(rates, name) for name in names},
        "degreeEvery": config.sh_interval,
        "refineEvery": density.densify_interval,
        "refineFrom": schedule.step_of(density.densify_from),
        "refineUntil": schedule.step_of(density.densify_until),
        "threshold": density.grad_threshold,
        "dense": density.percent_dense,
        "least": density.prune_opacity,
        "most": density.max_gaussians,
        "smaller": [[4, quarter], [2, half]],
        "ssim": config.ssim_weight,
        "visibleOnly": config.visible_only,
    }


def _photo(view: View, image: Tensor, held_out: bool) -> dict[str, Any]:
    """A photo and its camera; ``image``: (H, W, 3), 0..1."""
    camera = view.camera
    file = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(file, "JPEG", quality=_QUALITY, subsampling=0)
    return {
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "near": camera.near,
        "pose": camera.cam_from_world.detach().flatten().tolist(),
        "heldOut": held_out,
        "jpeg": base64.b64encode(file.getvalue()).decode("ascii"),
    }


def _scene(dataset: Dataset, views: list[View]) -> dict[str, Any]:
    """What the camera of the page has to know: see `Scene` in camera.js."""
    cameras = [view.camera for view in views]
    points = torch.zeros(0, 3) if dataset.points is None else dataset.points.xyz
    photos = []
    for index, view in enumerate(views):
        pose = view.camera.world_from_cam.detach().to(torch.float64)
        half = [0.5 * view.camera.width / view.camera.fx, 0.5 * view.camera.height / view.camera.fy]
        photos.append(
            {
                "name": view.name,
                "heldOut": index >= len(dataset.train),
                "half": half,
                "quat": quat_from_rotation(pose[:, :3]).tolist(),
                "position": pose[:, 3].tolist(),
            }
        )
    return {
        "up": up_of(cameras).tolist(),
        "focus": focus_of(cameras, viewing_distance(cameras, points)).tolist(),
        "bounds": dataset.bounds.tolist(),
        "extent": dataset.extent,
        "photos": photos,
    }


def _base64(numbers: Tensor) -> str:
    return base64.b64encode(numbers.detach().numpy().astype(np.float32).tobytes()).decode("ascii")


def _shader(file: Path) -> str:
    """A kernel without its comments, which the page does not need."""
    return re.sub(r"\s*//[^\n]*", "", file.read_text("utf-8"))
