"""PSNR of a scene in images that are smaller and larger than the photos of its training.

    python benchmarks/scales.py out/fern out/fern_antialiased

Each OUT is the output folder of a training with --eval. Its held-out photos are reduced from their
original files. So for larger images, train on reduced photos: with -r 4, up to four times the size.
"""

import argparse
from pathlib import Path

from snowsplat.evaluation.metrics import evaluate_views
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.output.scene_source import load_trained

SCALES = (0.25, 0.5, 1.0, 2.0, 4.0)


def row(folder: Path) -> list[str]:
    """PSNR and SSIM at each of `SCALES`; "-" where the photos are not large enough."""
    compute = Compute("cpu")
    trained, whole = load_trained(folder, compute=compute), load_trained(folder, resolution=1)
    size, largest = (scene.dataset.test[0].camera.width for scene in (trained, whole))
    cells = [folder.name, f"{len(trained.gaussians):,}"]
    for scale in SCALES:
        width = round(scale * size)
        if width > largest:
            cells.append("-")
            continue
        scene = load_trained(folder, resolution=width, compute=compute)
        result = evaluate_views(
            scene.gaussians, scene.dataset.test, background=list(scene.background)
        )
        cells.append(f"{result.psnr:.2f} / {result.ssim:.3f}")
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT")
    arguments = parser.parse_args()
    print(f"| scene | Gaussians | {' | '.join(f'{scale:g}×' for scale in SCALES)} |")
    print("|---" * (2 + len(SCALES)) + "|")
    for folder in arguments.folders:
        print("|", " | ".join(row(folder)), "|", flush=True)


if __name__ == "__main__":
    main()
