"""The complete pipeline, from photos to a scene, on rendered photos: `make demo`.

    python examples/demo.py [FOLDER]

Renders photos of a procedural still life (ray traced, with lens distortion and noise). Then runs
`snowsplat make` on the photos alone. At the end, the estimated poses are compared with the true
ones.
"""

import subprocess
import sys
import time
from pathlib import Path

from snowsplat.data.colmap import posed_camera, read_model
from snowsplat.synthetic import Truth, write_synthetic_photos
from snowsplat.synthetic.compare_poses import compare_poses

_MINUTES = 2.2  # for `snowsplat make`
_DEGREES = 0.1  # largest accepted rotation error of a photo
_SHARE = 0.002  # largest accepted position error of a photo, relative to the extent of the cameras


def take_photos(folder: Path) -> Truth:
    """Render photos to ``folder``/photos, keeping existing ones; write the poses elsewhere."""

    def report(done: int, total: int, what: str = "") -> None:
        if sys.stdout.isatty() and done < total:
            print(f"\r{what}: {done} of {total}", end="", flush=True)
        elif done == total:
            print(f"\r{what}: {total} of {total}", flush=True)

    truth = write_synthetic_photos(folder / "photos", report=report)
    truth.write(folder / "truth")
    return truth


def snowsplat(*arguments: str | Path) -> None:
    """Print a command, then run it; raises CalledProcessError if it fails."""
    shown = " ".join(str(argument) for argument in arguments)
    print(f"\n$ snowsplat {shown}", flush=True)
    subprocess.run([sys.executable, "-m", "snowsplat", *map(str, arguments)], check=True)


def compare(dataset: Path, truth: Truth) -> bool:
    """Print the errors of a dataset's poses; returns whether they are small enough."""
    model = read_model(dataset / "sparse" / "0")
    found = {image.name: posed_camera(model, image).cam_from_world for image in model.images}
    errors = compare_poses(found, truth.poses)
    degrees, shares = errors.rotations, errors.centres
    print(
        f"""
Estimated poses compared with the true ones ({len(errors.names)} of {len(truth.poses)} photos)
                            median     worst      limit
  rotation                  {degrees.median():.3f}°     {degrees.max():.3f}°     {_DEGREES}°
  position, of the extent   {shares.median():.3%}     {shares.max():.3%}     {_SHARE:.1%}"""
    )
    near = float(degrees.max()) <= _DEGREES and float(shares.max()) <= _SHARE
    return near and not errors.missing


def main(folder: Path) -> int:
    started = time.monotonic()
    truth = take_photos(folder)
    made = folder / "made"
    options = ("--quality", "normal", "--minutes", str(_MINUTES))
    snowsplat("make", folder / "photos", "-o", made, *options)
    near = compare(made / "capture", truth)
    print(
        f"""
Photos:      {folder / "photos"}
True poses:  {folder / "truth"}
Time:        {time.monotonic() - started:.0f} s

To use your own photos or video: snowsplat make YOUR_FOLDER -o out/yours"""
    )
    if not near:
        print("demo: the errors of the poses are too large", file=sys.stderr)
    return 0 if near else 1


if __name__ == "__main__":
    try:
        sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo")))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the command has printed the error
