"""COLMAP at its defaults, for `sfm.py`: exhaustive matching and the incremental mapper.

    python benchmarks/sfm_plain.py PHOTOS FOLDER one|each

"one": all photos share a camera; "each": each photo has its own. Writes the largest model to
FOLDER/sparse, and one line of JSON to standard output: wall time, processor time, and the numbers
of photos of all models.
"""

import json
import shutil
import sys
import time
from pathlib import Path

import pycolmap

MODES = {"one": pycolmap.CameraMode.SINGLE, "each": pycolmap.CameraMode.PER_IMAGE}


def main(photos: Path, folder: Path, mode: str) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    database = folder / "database.db"
    begin = time.perf_counter(), time.process_time()
    device = pycolmap.Device.cpu
    pycolmap.extract_features(database, photos, camera_mode=MODES[mode], device=device)
    pycolmap.match_exhaustive(database, device=device)
    models = pycolmap.incremental_mapping(database, photos, folder / "models")
    wall, cpu = time.perf_counter() - begin[0], time.process_time() - begin[1]
    found = sorted(models.values(), key=lambda model: -model.num_reg_images())
    if found:
        (folder / "sparse").mkdir()
        found[0].write(folder / "sparse")
    sizes = [model.num_reg_images() for model in found]
    print(json.dumps({"wall": wall, "cpu": cpu, "models": sizes}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
