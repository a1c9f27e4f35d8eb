"""Which 2D primitive approximates a photo best, with equal time and equally many numbers?

    python experiments/primitives_2d.py PHOTO PHOTO … --tuning PHOTO -o OUT

Each method gets the same pixels, the same number of parameters and the same processor time, on one
thread. Gaussians, rectangles and triangles are rendered by the same code in PyTorch (`shapes2d`),
so only the primitive differs. Beside them: a small network with sine activations (`siren`), and
the Gaussians of `snowsplat image`, whose kernels are written in C++ and therefore take more steps.

The number of steps is the processor time divided by that of a step, which a short fit of the same
photo measures. The factor of the learning rates of a method is the best of three on the photo of
`--tuning`, which should not be one of the others. The program writes primitives_2d.json beside this
file (one row for each photo, method and seed) and OUT/primitives.webp (seed 0). The guide "A photo
as Gaussians" has the results.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image, ImageDraw
from shapes2d import NUMBERS, Kind, fit_shapes
from siren import fit_siren, hidden_size
from torch import Tensor

from snowsplat.evaluation.metrics import compare
from snowsplat.extras.image.fit import Fitter
from snowsplat.extras.image.fit_image import load_photo
from snowsplat.extras.image.options import FitOptions

RATES = (0.4, 1.0, 2.5)
_TRIAL = 60  # steps of the fit that measures the time of a step
_GAUSSIAN = 9  # numbers of a Gaussian of `snowsplat image`: it has an opacity, too


@dataclass(frozen=True)
class Method:
    """A way to approximate an image.

    Attributes:
        fit: takes the image (H, W, 3), the steps, the seed and the factor of the learning rates;
            returns the image (H, W, 3), and the number of its parameters.
        rates: the factors that are tried.
    """

    fit: Callable[[Tensor, int, int, float], tuple[Tensor, int]]
    rates: tuple[float, ...] = RATES


def methods(parameters: int) -> dict[str, Method]:
    def shapes(kind: Kind) -> Method:
        def fit(photo: Tensor, steps: int, seed: int, rate: float) -> tuple[Tensor, int]:
            result = fit_shapes(photo, parameters // NUMBERS[kind], kind, steps, seed, rate)
            return result.image, result.parameters

        return Method(fit)

    def network(photo: Tensor, steps: int, seed: int, rate: float) -> tuple[Tensor, int]:
        result = fit_siren(photo, hidden_size(parameters), steps, seed, rate)
        return result.image, result.parameters

    def program(photo: Tensor, steps: int, seed: int, rate: float) -> tuple[Tensor, int]:
        fitter = Fitter(photo, FitOptions(parameters // _GAUSSIAN, steps=steps, seed=seed))
        while not fitter.finished:
            fitter.step()
        gaussians = fitter.gaussians
        return gaussians.render(), gaussians.rows.numel() + gaussians.background.numel()

    found = {kind: shapes(kind) for kind in NUMBERS}
    return {**found, "siren": Method(network), "snowsplat image": Method(program, rates=(1.0,))}


@dataclass(frozen=True)
class Row:
    photo: str
    method: str
    rate: float  # the factor of the learning rates
    seed: int
    parameters: int
    steps: int
    cpu_seconds: float
    psnr: float  # dB


def steps_in(seconds: float, method: Method, photo: Tensor) -> int:
    """The steps that take this much processor time."""
    method.fit(photo, 2, 0, 1.0)  # the first call is slower
    start = time.process_time()
    method.fit(photo, _TRIAL, 0, 1.0)
    return max(1, round(seconds * _TRIAL / (time.process_time() - start)))


def sheet(columns: dict[str, list[Tensor]], scale: int) -> Image.Image:
    """One row for each photo, one column for each method, with the names of the columns above."""
    heights = [scale * image.shape[0] for image in next(iter(columns.values()))]
    width = scale * max(image.shape[1] for images in columns.values() for image in images)
    gap, top = 6, 20
    size = ((width + gap) * len(columns) - gap, top + sum(heights) + gap * (len(heights) - 1))
    page = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(page)
    for column, (name, images) in enumerate(columns.items()):
        x, y = column * (width + gap), top
        draw.text((x + 2, 4), name, fill="black")
        for image, height in zip(images, heights, strict=True):
            pixels = (image.clamp(0, 1) * 255).round().byte().contiguous().numpy()
            shown = Image.fromarray(pixels)
            shown = shown.resize((scale * shown.width, height), Image.Resampling.NEAREST)
            page.paste(shown, (x, y))
            y += height + gap
    return page


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--tuning", type=Path, required=True, help="photo for the learning rates")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the picture")
    parser.add_argument("--size", type=int, default=128, help="pixels along the longer side")
    parser.add_argument("--parameters", type=int, default=3000)
    parser.add_argument("--seconds", type=float, default=2.0, help="processor time of a fit")
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.output.mkdir(parents=True, exist_ok=True)
    tuning = load_photo(args.tuning, args.size)
    photos = {path.stem: load_photo(path, args.size) for path in args.photos}
    columns = {"photo": list(photos.values())}
    rows: list[Row] = []
    for name, method in methods(args.parameters).items():
        steps = steps_in(args.seconds, method, tuning)

        def tuned(rate: float, method: Method = method, steps: int = steps) -> float:
            return compare(method.fit(tuning, steps, args.seeds, rate)[0], tuning).psnr

        rate = method.rates[0] if len(method.rates) == 1 else max(method.rates, key=tuned)
        columns[name] = []
        for photo_name, photo in photos.items():
            steps = steps_in(args.seconds, method, photo)
            for seed in range(args.seeds):
                start = time.process_time()
                image, parameters = method.fit(photo, steps, seed, rate)
                seconds = round(time.process_time() - start, 2)
                psnr = round(compare(image, photo).psnr, 3)
                rows.append(Row(photo_name, name, rate, seed, parameters, steps, seconds, psnr))
                if seed == 0:
                    columns[name].append(image)
            last = [row.psnr for row in rows[-args.seeds :]]
            print(f"{name:16} {photo_name:18} {steps:5} steps  {statistics.mean(last):.2f} dB")
    text = ",\n ".join(json.dumps(vars(row)) for row in rows)
    Path(__file__).with_suffix(".json").write_text(f"[\n {text}\n]\n")
    sheet(columns, 2).save(args.output / "primitives.webp", quality=80, method=6)


if __name__ == "__main__":
    main()
