"""Compares Gaussians with JPEG files of the same size, and with the program `primitive`.

    python experiments/image_comparison.py PHOTO -o OUT
    python experiments/image_comparison.py PHOTO PHOTO -o OUT --size 512 \\
        --methods front-to-back jpeg --counts 200 1000 5000 20000

Every method gets the same pixels: the photo, scaled down so that its longer side has `--size`
pixels. The JPEG file has at most as many bytes as the compact file of the Gaussians before it.
OUT/comparison.csv and the printed table have one row per photo, count and method. OUT/PHOTO.png
shows the photo and the images of all methods side by side.

`primitive` (Fogleman, github.com/fogleman/primitive) is an outside program in Go. It is skipped if
it is neither on the PATH nor named with --primitive.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from snowsplat.evaluation.metrics import compare
from snowsplat.extras.image.compact_file import decode, encode
from snowsplat.extras.image.fit import Fitter
from snowsplat.extras.image.fit_image import load_photo
from snowsplat.extras.image.options import Blending, FitOptions

METHODS = ("front-to-back", "additive", "jpeg", "primitive")


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    photo: str
    width: int
    height: int
    method: str
    count: int  # Gaussians or ellipses; 0 for JPEG
    steps: int
    seconds: float
    cpu_seconds: float  # of all threads
    psnr: float  # dB
    ssim: float
    bytes: int  # of the compact file, or of the JPEG file; 0: there is no file
    file_psnr: float  # dB, of the image in this file

    @property
    def bits_per_pixel(self) -> float:
        return 8 * self.bytes / (self.width * self.height)


@dataclass
class Result:
    """What a method returns."""

    image: Tensor  # (H, W, 3)
    count: int
    steps: int = 0
    data: int = 0  # bytes
    decoded: Tensor | None = None  # (H, W, 3), the image in the file


def gaussians(photo: Tensor, blending: Blending, count: int, steps: int) -> Result:
    fitter = Fitter(photo, FitOptions(count, blending, steps))
    while not fitter.finished:
        fitter.step()
    data = encode(fitter.gaussians)
    image = fitter.gaussians.render()
    return Result(image, count, steps, len(data), decode(data).render())


def jpeg(photo: Tensor, most_bytes: int) -> Result | None:
    """The best JPEG file with at most this many bytes, with or without chroma subsampling.

    None: all files are larger.
    """
    pixels = Image.fromarray((photo * 255).round().byte().contiguous().numpy())
    found: list[tuple[float, bytes, Tensor]] = []
    for subsampling in ("4:4:4", "4:2:0"):
        best = b""
        for quality in range(1, 101):
            file = io.BytesIO()
            pixels.save(file, "JPEG", quality=quality, subsampling=subsampling, optimize=True)
            if len(best) < len(file.getvalue()) <= most_bytes:
                best = file.getvalue()
        if best:
            decoded = np.asarray(Image.open(io.BytesIO(best))).copy()
            image = torch.from_numpy(decoded).float() / 255
            found.append((compare(image, photo).psnr, best, image))
    if not found:
        return None
    _, data, image = max(found, key=lambda each: each[0])
    return Result(image, 0, 0, len(data), image)


def primitive(program: str, photo: Tensor, count: int) -> Result:
    """`count` ellipses, rendered by the program at the size of the photo."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "photo.png"), Path(folder, "image.png")
        Image.fromarray((photo * 255).round().byte().contiguous().numpy()).save(source)
        side = str(max(photo.shape[:2]))
        command = [program, "-i", str(source), "-o", str(target), "-n", str(count), "-m", "3"]
        subprocess.run([*command, "-r", side, "-s", side], check=True, capture_output=True)
        image = torch.from_numpy(np.asarray(Image.open(target).convert("RGB")).copy())
    return Result(image.float() / 255, count)


def measured(
    name: str, method: str, photo: Tensor, count: int, file_bytes: int, args: argparse.Namespace
) -> tuple[Row, Tensor] | None:
    """Run a method; its row and its image. None: there is no such image."""
    start, cpu = time.perf_counter(), _cpu_seconds()
    result = run_method(method, photo, count, file_bytes, args)
    seconds, cpu = time.perf_counter() - start, _cpu_seconds() - cpu
    if result is None:
        return None
    metrics = compare(result.image, photo)
    file_psnr = 0.0 if result.decoded is None else compare(result.decoded, photo).psnr
    row = Row(
        name,
        *(photo.shape[1], photo.shape[0], method, result.count, result.steps),
        *(round(seconds, 2), round(cpu, 2), round(metrics.psnr, 3), round(metrics.ssim, 4)),
        *(result.data, round(file_psnr, 3)),
    )
    return row, result.image


def _cpu_seconds() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def side_by_side(path: Path, images: list[tuple[str, Tensor]]) -> None:
    """Write the images in one row, each with its caption."""
    scale = max(1, 512 // max(images[0][1].shape[:2]))
    height, width = (side * scale for side in images[0][1].shape[:2])
    sheet = Image.new("RGB", ((width + 8) * len(images) - 8, height + 20), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (caption, image) in enumerate(images):
        pixels = (image.clamp(0, 1) * 255).round().byte().contiguous().numpy()
        shown = Image.fromarray(pixels).resize((width, height), Image.Resampling.NEAREST)
        sheet.paste(shown, (i * (width + 8), 20))
        draw.text((i * (width + 8), 4), caption, fill="black")
    sheet.save(path)


def write_rows(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def print_table(rows: list[Row]) -> None:
    print(
        "| photo | method | count | PSNR | SSIM | s | CPU s | bytes | bits/pixel | PSNR of file |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        file = f"{row.bytes:,} | {row.bits_per_pixel:.2f} | {row.file_psnr:.2f}"
        print(
            f"| {row.photo} {row.width}×{row.height} | {row.method} | {row.count:,} | "
            f"{row.psnr:.2f} | {row.ssim:.4f} | {row.seconds:.1f} | {row.cpu_seconds:.1f} | "
            + (f"{file} |" if row.bytes else "– | – | – |")
        )


def run_method(
    method: str, photo: Tensor, count: int, file_bytes: int, args: argparse.Namespace
) -> Result | None:
    """The result of a method. `file_bytes` is the largest size of a JPEG file."""
    if method in ("front-to-back", "additive"):
        return gaussians(photo, method, count, args.steps)
    if method == "jpeg":
        return jpeg(photo, file_bytes)
    return primitive(args.primitive, photo, count)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="output folder")
    parser.add_argument("--size", type=int, default=256, help="pixels along the longer side")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument(
        "--counts", nargs="+", type=int, default=[1000], help="Gaussians or ellipses"
    )
    parser.add_argument("--steps", type=int, default=3000, help="of the Gaussians")
    parser.add_argument("--primitive", default="primitive", help="the program of that name")
    args = parser.parse_args()
    methods = [method for method in METHODS if method in args.methods]
    if "jpeg" in methods and not {"front-to-back", "additive"} & set(methods):
        parser.error("jpeg needs a method with Gaussians, for the size of its file")
    if "primitive" in methods and shutil.which(args.primitive) is None:
        print("primitive is not installed; skipped", file=sys.stderr)
        methods.remove("primitive")
    args.output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for path in args.photos:
        photo = load_photo(path, args.size)
        images: list[tuple[str, Tensor]] = [("photo", photo)]
        for count in args.counts:
            file_bytes = 0
            for method in methods:
                found = measured(path.stem, method, photo, count, file_bytes, args)
                if found is None:
                    print(f"{path.stem} {method} {count}: no file is so small", flush=True)
                    continue
                row, image = found
                file_bytes = file_bytes or row.bytes
                rows.append(row)
                images.append((f"{method} {row.psnr:.2f} dB", image))
                write_rows(args.output / "comparison.csv", rows)
                print(f"{path.stem} {method} {count}: {row.psnr:.2f} dB", flush=True)
        side_by_side(args.output / f"{path.stem}.png", images)
    print_table(rows)


if __name__ == "__main__":
    main()
