"""The whole way, from photos to a scene, on photos that it takes itself: `make demo`.

    python examples/demo.py [FOLDER]

Takes photos of a still life that exists in numbers only (ray traced, with lens distortion and
noise), then runs what a user types, `snowsplat make`, which gets the photos and nothing else. Since
it is known where they were taken from, it then tells how near the found places are.
"""

import subprocess
import sys
import time
from pathlib import Path

from snowsplat.data.colmap import posed_camera, read_model
from snowsplat.synthetic import Truth, write_synthetic_photos
from snowsplat.synthetic.compare_poses import compare_poses

_MINUTES = 2.2  # for all that `snowsplat make` does
_DEGREES, _SHARE = 0.1, 0.002  # what is demanded of each photo


def take_photos(folder: Path) -> Truth:
    """Photos in ``folder``/photos; those that are there are kept. Their poses are kept aside."""

    def report(done: int, total: int, what: str = "") -> None:
        if sys.stdout.isatty() and done < total:
            print(f"\r{what}: {done} of {total}", end="", flush=True)
        elif done == total:
            print(f"\r{what}: {total} of {total}", flush=True)

    truth = write_synthetic_photos(folder / "photos", report=report)
    truth.write(folder / "truth")
    return truth


def snowsplat(*arguments: str | Path) -> None:
    """Show a command, then run it; where it fails the demo ends."""
    shown = " ".join(str(argument) for argument in arguments)
    print(f"\n$ snowsplat {shown}", flush=True)
    subprocess.run([sys.executable, "-m", "snowsplat", *map(str, arguments)], check=True)


def compare(dataset: Path, truth: Truth) -> bool:
    """Print how near the poses of a dataset are to the true ones; whether that is near enough."""
    model = read_model(dataset / "sparse" / "0")
    found = {image.name: posed_camera(model, image).cam_from_world for image in model.images}
    errors = compare_poses(found, truth.poses)
    degrees, shares = errors.rotations, errors.centres
    print(
        f"""
The poses that were found, against the true ones ({len(errors.names)} of {len(truth.poses)} photos)
                        median     worst      demanded
  orientation           {degrees.median():.3f}°     {degrees.max():.3f}°     {_DEGREES}°
  place, of the extent  {shares.median():.3%}     {shares.max():.3%}     {_SHARE:.1%}"""
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
The photos:      {folder / "photos"}
The true poses:  {folder / "truth"}
This took:       {time.monotonic() - started:.0f} s

With photos or a video of your own: snowsplat make YOUR_FOLDER -o out/yours"""
    )
    if not near:
        print("The poses are farther off than they may be.", file=sys.stderr)
    return 0 if near else 1


if __name__ == "__main__":
    try:
        sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo")))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the command has said why
