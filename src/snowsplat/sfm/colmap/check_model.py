"""Check in a child process whether COLMAP can read a model from an unknown source.

    python -m snowsplat.sfm.colmap.check_model FOLDER BYTES

COLMAP does not check the counts in its files. With a damaged count it may allocate all memory or
run for hours. Therefore the child process has a time limit and a limit of BYTES of additional
memory, and only the child process fails.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from snowsplat.sfm.colmap.child import child_environment

_SECONDS = 10.0  # time to start Python and COLMAP
_BYTES_A_SECOND = 1_000_000  # a low estimate of the reading speed
_MEMORY = 1 << 30  # bytes of address space, for a model of any size
_RATIO = 16  # additional bytes of address space per byte of the files


def can_be_read(folder: Path) -> bool:
    """Whether COLMAP reads the model in ``folder`` within limits that depend on its size."""
    size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    limit = _MEMORY + _RATIO * size
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, str(folder), str(limit)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=child_environment(1),
            timeout=_SECONDS + size / _BYTES_A_SECOND,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def _main(folder: str, limit: int) -> None:
    import pycolmap

    if sys.platform == "linux":
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        limit += pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    model = pycolmap.Reconstruction(folder)
    model.update_point_3d_errors()
    model.compute_mean_reprojection_error()
    for number in model.reg_image_ids():
        model.cameras[model.images[number].camera_id].calibration_matrix()


if __name__ == "__main__":
    _main(sys.argv[1], int(sys.argv[2]))
