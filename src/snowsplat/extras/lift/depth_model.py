"""Estimates depth with a network that the user has on disk. Nothing is ever downloaded.

Two kinds of models are supported, both given by their path:

- an ONNX file, run by ONNX Runtime: one input (1, 3, H, W), one output with one value per pixel.
  Depth Anything V2 is distributed in this form.
- a folder of the library transformers with a model for depth estimation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from snowsplat.util.errors import UserError

# Mean and standard deviation of ImageNet, which networks for depth expect.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# The shorter side of the input in pixels, and the number of which both sides are multiples, where
# the model does not fix the size: those of Depth Anything V2.
_SHORTER_SIDE, _MULTIPLE = 518, 14


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
