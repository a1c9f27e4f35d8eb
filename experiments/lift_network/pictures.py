"""Loss curves, and the photos with the largest errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from measures import Predictor, error_map
from network import DepthNet, with_resampling
from PIL import Image, ImageDraw
from torch import Tensor

from scenes import FOCAL, SIZE, Shots
from snowsplat.pipeline.output.image_files import depth_in_color, to_8bit
from snowsplat.scene.render import render
from training import Curves, Example, examples

_COLORS = ((200, 60, 40), (40, 100, 180), (40, 150, 80))
_WIDTH, _HEIGHT, _MARGIN = 560, 300, 44
_SMOOTHED = 20  # steps
_LOSSES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
_WORST_ERROR = 0.5  # relative, white in a map of errors
_ENLARGED = 2


def draw_curves(curves: dict[str, Curves], path: Path) -> None:
    """The depth loss of each training over its steps, on a logarithmic axis."""
    sheet = Image.new("RGB", (2 * _WIDTH, 2 * _HEIGHT), "white")
    draw = ImageDraw.Draw(sheet)
    left, right, top, bottom = 2 * _MARGIN, 2 * _WIDTH - 30, 30, 2 * _HEIGHT - 2 * _MARGIN
    low, high = np.log(_LOSSES[0]), np.log(_LOSSES[-1])
    most = max(len(curve.depth) for curve in curves.values())

    def place(step: float, loss: float) -> tuple[float, float]:
        share = (np.log(loss) - low) / (high - low)
        return left + step / most * (right - left), bottom - share * (bottom - top)

    for loss in _LOSSES:
        y = place(0, loss)[1]
        draw.line([(left, y), (right, y)], fill=(220, 220, 220), width=2)
        draw.text((left - 12, y), f"{loss:g}", fill="black", font_size=24, anchor="rm")
    for step in range(0, most + 1, 100):
        x = place(step, 1.0)[0]
        draw.text((x, bottom + 12), str(step), fill="black", font_size=24, anchor="mt")
    draw.text(((left + right) / 2, bottom + 46), "step", fill="black", font_size=24, anchor="mt")
    for curve, color in zip(curves.values(), _COLORS, strict=True):
        smooth = np.convolve(curve.depth, np.ones(_SMOOTHED) / _SMOOTHED, "valid")
        points = [
            place(i + _SMOOTHED, max(loss, _LOSSES[0])) for i, loss in enumerate(smooth.tolist())
        ]
        draw.line(points, fill=color, width=4, joint="curve")
    for i, (name, color) in enumerate(zip(curves, _COLORS, strict=False)):
        y = top + 10 + 34 * i
        draw.line([(right - 270, y), (right - 220, y)], fill=color, width=6)
        draw.text((right - 205, y), name, fill="black", font_size=24, anchor="lm")
    sheet = sheet.resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS)
    sheet.save(path, quality=85, method=6)


def draw_failures(net: DepthNet, tests: dict[str, Shots], out: Path) -> None:
    """For each test set, the photo with the largest error. Longer focal lengths are resampled.

    A row has the photo, the true depth, the predicted depth, the error from black (none) to white
    (50% or more), the true second view, and the predicted second view.
    """
    rows = []
    for shots in tests.values():
        predict = net if shots.focal == FOCAL else with_resampling(net, shots.focal)
        errors = [float(error_map(predict, e)[1].mean()) for e in examples([shots])]
        rows.append(_row(predict, Example(shots, int(np.argmax(errors)))))
    sheet = Image.fromarray(np.concatenate(rows))
    size = sheet.width * _ENLARGED, sheet.height * _ENLARGED
    sheet.resize(size, Image.Resampling.NEAREST).save(out / "failures.webp", quality=85, method=6)


def _row(predict: Predictor, example: Example) -> np.ndarray:
    shots, i = example.shots, example.i
    depth, error = error_map(predict, example)
    truth = shots.depths[i]
    near, far = float(truth.min()), float(truth.max())
    with torch.no_grad():
        prediction = predict(shots.image(i)[None])
        gaussians = prediction.gaussians(0, shots.image(i), shots.camera(i))
        second = render(gaussians, shots.camera(example.second)).image
    images = [
        shots.images[i].numpy(),
        depth_in_color(truth.numpy(), near, far),
        depth_in_color(depth.numpy(), near, far),
        _grey(error / _WORST_ERROR),
        shots.images[example.second].numpy(),
        to_8bit(second),
    ]
    gap = np.full((SIZE + 4, 4, 3), 255, np.uint8)
    framed = [np.pad(image, ((0, 4), (0, 0), (0, 0)), constant_values=255) for image in images]
    parts = [part for image in framed for part in (image, gap)]
    return np.concatenate(parts[:-1], axis=1)


def _grey(values: Tensor) -> np.ndarray:
    return np.repeat(to_8bit(values[..., None]), 3, axis=2)
