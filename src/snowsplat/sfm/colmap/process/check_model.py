"""Check in a child process whether COLMAP can read a model from an unknown source.

    python -m snowsplat.sfm.colmap.process.check_model FOLDER BYTES SECONDS

COLMAP does not check the counts in its files. With a damaged count, it may allocate all memory or
run for hours. Therefore it reads the model in a child process, which has limits of SECONDS of
processor time and of BYTES of additional memory.
"""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

from snowsplat.sfm.colmap.process.child import child_environment

_SECONDS = 10.0  # processor time to start Python and COLMAP
_BYTES_PER_SECOND = 1_000_000  # a low estimate of the reading speed
# The longest time, divided by the processor time: other programs may need most of the processors.
# Elsewhere, the processor time is not limited.
_WAITING = 20 if sys.platform == "linux" else 1
_MEMORY = 1 << 30  # bytes of address space that a model of any size may need
_MEMORY_PER_BYTE = 16  # bytes of address space that are added for each byte of the files


def can_be_read(folder: Path) -> bool:
    """Whether COLMAP can read the model in ``folder``, within limits of time and memory.

    The limits depend on the size of the files.
    """
    size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    limit = _MEMORY + _MEMORY_PER_BYTE * size
    seconds = _SECONDS + size / _BYTES_PER_SECOND
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, str(folder), str(limit), str(math.ceil(seconds))],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=child_environment(1),
            timeout=_WAITING * seconds,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def _main(folder: str, limit: int, seconds: int) -> None:
    import pycolmap

    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        limit += pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    model = pycolmap.Reconstruction(folder)
    model.update_point_3d_errors()
    model.compute_mean_reprojection_error()
    for number in model.reg_image_ids():
        camera = model.cameras[model.images[number].camera_id]
        if not camera.is_spherical():  # a panorama has no such matrix
            camera.calibration_matrix()


if __name__ == "__main__":
    _main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
