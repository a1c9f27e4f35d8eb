"""`lift_photo`: one photo and its depth map become a scene in an output folder.

Estimates depth with a network that the user has on disk. Nothing is ever downloaded.

Two kinds of models are supported, both given by their path:

- an ONNX file, run by ONNX Runtime: one input (1, 3, H, W), one output with one value per pixel.
  Depth Anything V2 is distributed in this form.
- a folder of the library transformers with a model for depth estimation.
"""

import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from snowsplat.data import read_dataset
from snowsplat.data.maps.depth_alignment import Alignment
from snowsplat.data.maps.map_files import read_depth_file, to_z
from snowsplat.evaluation.metrics import Evaluation, compare
from snowsplat.extras.lift.lift import lift
from snowsplat.extras.lift.options import DepthSource, LiftOptions
from snowsplat.extras.lift.surface import resize_depth
from snowsplat.extras.pictures import write_pictures
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.output.image_files import depth_in_color, write_png
from snowsplat.pipeline.run.training_files import write_beginning, write_scene
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render, to_8bit
from snowsplat.sfm.ingest.photos.photo_files import Unusable, decode, read_header
from snowsplat.training.settings.config import TrainConfig
from snowsplat.trajectory.orbit import swing_path
from snowsplat.trajectory.video_file import video_writer
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.settings import Setting, checked

#: The folder of the dataset that `lift_photo` writes: the photo and its camera.
PHOTO = "photo"
_SIZE = Setting(least=32, most=4096)  # pixels along the longer side
# 35 mm equivalent of the focal length that is assumed without EXIF data: the main camera of phones.
_USUAL_FOCAL = 28.0
_FULL_FRAME_DIAGONAL = 43.2666  # mm, of 36×24
_ASPECT_TOLERANCE = 0.03  # between the aspect ratios of photo and depth map, relative
_SWING_SECONDS, _SWING_FPS = 4, 24
# Mean and standard deviation of ImageNet, which networks for depth expect.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# The shorter side of the input in pixels, and the number of which both sides are multiples, where
# the model does not fix the size: those of Depth Anything V2.
_SHORTER_SIDE, _MULTIPLE = 518, 14


def read_depth(source: DepthSource, photo: Tensor, camera: Camera, edge: float) -> Tensor:
    """The depth of each pixel of the photo: camera z (H, W) float32; NaN where it is unknown.

    Raises:
        UserError: an unusable file, model or range; another aspect ratio than the photo.
    """
    if source.map is not None:
        values = read_depth_file(source.map)
        height, width = values.shape
        aspect = width / height * camera.height / camera.width
        if abs(aspect - 1) > _ASPECT_TOLERANCE:
            raise UserError(
                "{map}: has {width}x{height} pixels, but the upright photo has "
                "{width2}x{height2}; use a depth map of the whole photo",
                map=source.map,
                width=width,
                height=height,
                width2=camera.width,
                height2=camera.height,
            )
    else:
        assert source.model is not None
        values = estimate_depth(source.model, photo)
    z = to_z(values, source.values_are, camera, source.near, source.far)
    return resize_depth(z, camera.width, camera.height, edge)


@dataclass(frozen=True)
class LiftResult:
    """A lifted photo.

    Attributes:
        scene: the PLY file.
        gaussians: their number.
        psnr: of the photo, rendered from its own pose, in dB. After a refinement, this is the
            refined scene.
        focal: the focal length in pixels of the lifted photo, and where it is from.
        depths: percentiles 1 and 99 of the camera z of the photo.
        seconds: duration, without the refinement.
        swing: the video, if it was requested.
        alignment: the fit of the depth to the points of the dataset; None without a dataset.
        evaluation: metrics of the held-out photos of the dataset.
    """

    scene: Path
    gaussians: int
    psnr: float
    focal: tuple[float, str]
    depths: tuple[float, float]
    seconds: float
    swing: Path | None = None
    alignment: Alignment | None = None
    evaluation: Evaluation | None = field(default=None, repr=False)


def lift_photo(
    photo: Path | str,
    output: Path | str,
    depth: DepthSource,
    options: LiftOptions | None = None,
    *,
    size: int = 640,
    focal: float | None = None,
    swing: bool = False,
    threads: int | None = None,
    overwrite: bool = False,
) -> LiftResult:
    """Lift a photo to Gaussians, and write an output folder as `train` does.

    The folder contains the scene after 0 steps, the camera, the photo as a dataset of one view,
    ``rendered.png`` (the scene from the camera of the photo), ``depth.png`` (the depth in colours)
    and ``metrics.json``. The world frame is that of the camera: x right, y down, z forward. The
    computation runs on the CPU.

    Args:
        size: pixels along the longer side, to which a larger photo is scaled down.
        focal: focal length in pixels of the photo as stored. Default: from its EXIF data, or that
            of the main camera of phones.
        swing: also write ``swing.mp4``, a small closed camera path around the photo.
        threads: number of CPU threads; None: all cores.
        overwrite: replace an earlier scene in ``output``.

    Raises:
        UserError: the photo or the depth is missing, damaged or unusable; a setting is out of
            range; ``output`` contains other files.
        OSError: a file cannot be written.
    """
    options, started = options or LiftOptions(), time.monotonic()
    out = TrainingFolder(Path(output))
    out.check_free(resume=False, overwrite=overwrite)
    pixels, camera, source = read_photo(Path(photo), size, focal)
    Compute("cpu", threads).apply()
    z = read_depth(depth, pixels, camera, options.edge)
    gaussians = lift(pixels, z, camera, options)
    settings = DatasetSettings(str((out.path / PHOTO).absolute()))
    write_pictures(out.path / PHOTO, [Path(photo).stem], [pixels], [camera])
    out.remove_results()
    write_beginning(out, read_dataset(settings), settings, TrainConfig(sh_degree=0))
    return finish(out, 0, gaussians, pixels, z, camera, source, swing, started)


def read_photo(path: Path, size: int, focal: float | None) -> tuple[Tensor, Camera, str]:
    """An upright photo (H, W, 3) in 0..1, its camera, and where the focal length is from.

    Transparent photos are composited over white. The pose is the identity.
    Raises: UserError: see `lift_photo`.
    """
    checked("size", size, int, _SIZE)
    if focal is not None and not 0.0 < focal < math.inf:
        raise SettingError(
            "focal", "{focal:g} is not a focal length; use one in pixels", focal=focal
        )
    if not path.is_file():
        raise UserError("{path}: no such photo", path=path)
    try:
        header = read_header(path)
        image = decode(path, header, size)
    except Unusable as error:
        raise UserError("{path}: {error}; use another photo", path=path, error=error) from None
    if image.mode == "RGBA":
        white = Image.new("RGBA", image.size, (255, 255, 255, 255))
        image = Image.alpha_composite(white, image)
    pixels = torch.from_numpy(np.array(image.convert("RGB"))).float() / 255
    width, height = image.size
    source = "set"
    if focal is None:
        focal, source = header.exif.focal, "from EXIF data"
    if focal is None:
        diagonal = math.hypot(header.width, header.height)
        focal, source = _USUAL_FOCAL / _FULL_FRAME_DIAGONAL * diagonal, "assumed"
    focal *= max(width, height) / max(header.width, header.height)
    pose = torch.eye(4, dtype=torch.float64)[:3]
    return pixels, Camera(width, height, focal, focal, width / 2, height / 2, pose), source


def finish(
    out: TrainingFolder,
    step: int,
    gaussians: Gaussians,
    pixels: Tensor,
    z: Tensor,
    camera: Camera,
    source: str,
    swing: bool,
    started: float,
) -> LiftResult:
    """Write the scene, its pictures and metrics."""
    scene = write_scene(out, step, gaussians)
    with torch.no_grad():
        image = render(gaussians, camera).image
    metrics = compare(image, pixels, name="photo")
    out.write_metrics(step, "train", Evaluation([metrics]).as_json())
    write_png(out.path / "rendered.png", to_8bit(image))
    known = z[z.isfinite()].numpy()
    near, far = (float(value) for value in np.percentile(known, [1, 99]))
    depth = torch.nan_to_num(z, nan=0.0).numpy()
    write_png(out.path / "depth.png", depth_in_color(depth, near, max(far, 1.001 * near)))
    seconds = time.monotonic() - started
    video = out.path / "swing.mp4"
    video.unlink(missing_ok=True)  # of an earlier run
    if swing:
        width, height = (side // 2 * 2 for side in (camera.width, camera.height))  # even
        path = swing_path(camera, float(np.median(known)), _SWING_SECONDS * _SWING_FPS)
        with torch.no_grad(), video_writer(video, width, height, _SWING_FPS) as add_frame:
            for pose in path:
                add_frame(to_8bit(render(gaussians, pose).image)[:height, :width])
    return LiftResult(
        scene=scene,
        gaussians=len(gaussians),
        psnr=metrics.psnr,
        focal=(camera.fx, source),
        depths=(near, far),
        seconds=seconds,
        swing=video if swing else None,
    )


def estimate_depth(model: Path, photo: Tensor) -> np.ndarray:
    """The output of a model for a photo, (h, w) float32, at the resolution of the model.

    ``model``: an ONNX file, or a folder that transformers reads. ``photo``: (H, W, 3) in 0..1.
    Raises: UserError: the model is missing, damaged or of another kind, or a package is missing.
    """
    if model.is_dir():
        values = _run_transformers(model, photo)
    elif not model.is_file():
        raise UserError(
            "{model}: no such model; give an ONNX file or a folder of transformers. snowsplat "
            "does not download models",
            model=model,
        )
    elif model.suffix.lower() == ".onnx":
        values = _run_onnx(model, photo)
    else:
        raise UserError("{model}: unknown kind of model; use a .onnx file or a folder", model=model)
    values = np.squeeze(np.asarray(values, np.float32))
    if values.ndim != 2:
        raise UserError(
            "{model}: its output has the shape {shape}; use a model that predicts one value per "
            "pixel",
            model=model,
            shape=values.shape,
        )
    return values


def _run_onnx(model: Path, photo: Tensor) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise UserError(
            "{model}: running an ONNX model needs a package; run pip install onnxruntime",
            model=model,
        ) from None
    onnxruntime.set_default_logger_severity(3)  # errors only; they are raised as well
    try:
        session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
        (given,) = session.get_inputs()
        pixels = _network_input(photo, given.shape)
        return session.run(None, {given.name: pixels.numpy()})[0]
    except Exception as error:  # ONNX Runtime has no common base of its exceptions
        raise _failed(model, error) from None


def _network_input(photo: Tensor, shape: list[Any]) -> Tensor:
    """(1, 3, h, w): normalised, at the fixed size of the model or the size of Depth Anything."""
    if len(shape) != 4 or shape[1] not in (3, "channels", "num_channels", None):
        raise ValueError(f"its input has the shape {shape}, not (1, 3, height, width)")
    height, width = photo.shape[:2]
    scale = _SHORTER_SIDE / min(height, width)
    sizes = [
        fixed if isinstance(fixed, int) else max(1, round(side * scale / _MULTIPLE)) * _MULTIPLE
        for fixed, side in zip(shape[2:], (height, width), strict=True)
    ]
    planes = photo.permute(2, 0, 1)[None]
    planes = F.interpolate(planes, sizes, mode="bicubic", antialias=True)
    mean, std = (torch.tensor(values)[:, None, None] for values in (_MEAN, _STD))
    return ((planes.clamp(0.0, 1.0) - mean) / std).contiguous()


def _run_transformers(model: Path, photo: Tensor) -> Any:
    try:
        from transformers import AutoImageProcessor, AutoModelForDepthEstimation
    except ImportError:
        what = "this model needs a package; run pip install transformers"
        raise UserError("{model}: {what}", model=model, what=what) from None
    try:
        # Only files of this folder are read, and no code in it is executed.
        processor = AutoImageProcessor.from_pretrained(model, local_files_only=True)
        network = AutoModelForDepthEstimation.from_pretrained(
            model, local_files_only=True, use_safetensors=True
        )
        pixels = (photo * 255).round().byte().numpy()
        with torch.no_grad():
            output = network(**processor(images=pixels, return_tensors="pt"))
        return output.predicted_depth.numpy()
    except Exception as error:  # as above
        raise _failed(model, error) from None


def _failed(model: Path, error: Exception) -> UserError:
    reason = " ".join(str(error).split())[:160] or type(error).__name__
    return UserError(
        "{model}: the model cannot be used ({reason}); use another file", model=model, reason=reason
    )
