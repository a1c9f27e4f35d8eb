"""The main job from end to end, on a scene that it makes itself: `make demo`.

    python examples/demo.py [FOLDER]

Writes a small capture (pictures of a procedural scene, with cameras and points, as COLMAP would),
then runs the same four commands that a user types: train, evaluate, render, info.
"""

import shutil
import subprocess
import sys
from pathlib import Path

from snowsplat.capture.synthetic import write_synthetic_capture


def snowsplat(*arguments: str | Path) -> None:
    """Show a command, then run it; the first that fails ends the demo."""
    shown = " ".join(str(argument) for argument in arguments)
    print(f"\n$ snowsplat {shown}", flush=True)
    subprocess.run([sys.executable, "-m", "snowsplat", *map(str, arguments)], check=True)


def main(folder: Path) -> None:
    capture, scene = folder / "capture", folder / "scene"
    shutil.rmtree(capture, ignore_errors=True)
    write_synthetic_capture(capture, n_views=24, width=256, height=192, n_points=3000)
    print(f"Made a capture of 24 pictures: {capture}")

    snowsplat("train", capture, "-o", scene, "--eval", "--iterations", "1500", "--overwrite")
    snowsplat("evaluate", scene)
    snowsplat("render", scene, "--split", "test", "--depth", "color")
    (result,) = scene.glob("point_cloud/iteration_*/point_cloud.ply")
    snowsplat("info", result)

    (pictures,) = scene.glob("test/ours_*")
    print(
        f"""
The scene, for any viewer of Gaussian splats:  {result}
Pictures of views that it never saw:           {pictures / "renders"}
 the pictures that they should look like:      {pictures / "gt"}
 and their depth:                              {pictures / "depth"}
How near they are, each and on average:        {scene / "metrics.json"}

With your own photos and COLMAP's cameras: snowsplat train YOUR_FOLDER -o out/yours --eval"""
    )


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/demo"))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the command has said why
