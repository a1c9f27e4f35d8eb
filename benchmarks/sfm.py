"""Structure from motion: time of each stage, photos with correct poses, memory.

    python benchmarks/sfm.py                                  real datasets, scenes of 60 photos
    python benchmarks/sfm.py room twins --photos 60 150       scenes of 60 and of 150 photos
    python benchmarks/sfm.py fern rooms-300 --json sfm.json
    python benchmarks/sfm.py panorama --photos 40             360° panoramas, 1600×800
    python benchmarks/sfm.py room-120s                        a video of two minutes
    python benchmarks/sfm.py room --versus ../before/src      compare another build with this one
    python benchmarks/sfm.py ahead-30 --plain                 beside COLMAP at its defaults

A workload is a real dataset (a folder of photos or a video; skipped if absent), or a procedural
scene of `sfm_scenes.py`: a number of photos, or a video. The photos of a scene and the frames of a
video are rendered once, into the folder that --cache or the environment variable
SNOWSPLAT_SFM_SCENES names.

The estimated poses are aligned with the true ones by the similarity transform that agrees with the
most photos (`sfm_placed.py`). A photo is placed correctly if the error of its rotation is then less
than 3°, and that of its centre less than 3% of the largest distance between two true centres.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from sfm_placed import placed
from sfm_plain import MODES
from sfm_scenes import CACHE_VARIABLE, KINDS, SIZE, cache_folder, photos_of, video_of
from torch import Tensor

from snowsplat.data.colmap.model import read_model
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.sfm.gps import east_north_up, middle_of
from snowsplat.sfm.ingest.photos.exif import read_exif
from snowsplat.util.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
#: Name -> the photos or the video, and a COLMAP model with the true poses, relative to --datasets.
DATASETS: dict[str, tuple[str, str | None]] = {
    "fern": ("fern/images", "fern/sparse/0"),
    "kitchen25": ("kitchen25/images", "kitchen25/sparse/0"),
    "tree_photos": ("tree_photos", None),
    "fox_photos": ("fox_photos", "fox/sparse/0"),
    "walkaround.mp4": ("walkaround.mp4", None),
    "bonsai_photos": ("bonsai_photos", None),
    "street_photos": ("street_photos", None),
    "drone_photos": ("drone_photos", None),
}
_SHARE = 0.95  # of the correct photos: the errors of the poses are those of this share
_LONG = ("bonsai_photos",)  # not measured by default
_STAGES = ("start", "decode", "features", "choose pairs", "match", "map", "undistort", "report")


@dataclass(frozen=True)
class Workload:
    """Photos or a video, and the true poses if they are known."""

    name: str
    source: Path
    true: Mapping[str, Tensor] | None  # photo name -> cam_from_world (3, 4)


def poses_in(model: Path) -> dict[str, Tensor]:
    """``cam_from_world`` (3, 4) float64 of each photo in a COLMAP model."""
    poses = {}
    for image in read_model(model).images:
        pose = torch.tensor(image.pose, dtype=torch.float64)
        poses[image.name] = torch.cat([rotation_from_quat(pose[:4]), pose[4:, None]], 1)
    return poses


def workload(name: str, datasets: Path, cache: Path, size: tuple[int, int]) -> Workload | None:
    """The workload of a name; None if it is a real dataset that is not in the folder ``datasets``.

    ``size``: width and height of the photos of a procedural scene.
    """
    if name in DATASETS:
        photos, model = DATASETS[name]
        if not (datasets / photos).exists():
            return None
        known = model is not None and (datasets / model).is_dir()
        return Workload(name, datasets / photos, poses_in(datasets / str(model)) if known else None)
    kind, _, count = name.partition("-")

    def report(done: int, total: int, what: str = "") -> None:
        print(f"\r{name}: {what} {done}/{total}  ", end="", file=sys.stderr, flush=True)
        if done == total:
            print(file=sys.stderr)

    if count.endswith("s"):
        video, truth = video_of(kind, int(count[:-1]), cache, size, report=report)
        return Workload(name, video, truth.poses)
    folder, truth = photos_of(kind, int(count), cache, size, report=report)
    return Workload(name, folder, truth.poses)


def frames_shown(photos: Path, frames: Path) -> dict[str, str]:
    """The name of each photo -> the name of the frame in the folder ``frames`` that it shows.

    Empty if the folder ``photos`` does not exist, because the decoding of the video failed.
    """

    def thumbnails(folder: Path) -> tuple[list[str], Tensor]:
        names = sorted(path.name for path in folder.glob("*.jpg"))
        rows = []
        for name in names:
            with Image.open(folder / name) as image:
                small = image.convert("L").resize((32, 24), Image.Resampling.BOX)
            rows.append(torch.tensor(np.asarray(small, np.float32)).flatten())
        return names, torch.stack(rows) if rows else torch.zeros(0, 32 * 24)

    (names, some), (all_names, every) = thumbnails(photos), thumbnails(frames)
    nearest = torch.cdist(some, every).argmin(1).tolist()
    return {name: all_names[i] for name, i in zip(names, nearest, strict=True)}


def measure(work: Workload, folder: Path, options: Mapping[str, Any], source: Path) -> dict:
    """Make a dataset in ``folder`` with the package in the folder ``source``; measure time, memory
    and quality.

    Returns a row of the tables, with all values that --json writes.
    """
    job = {"inputs": [str(work.source)], "folder": str(folder), "options": dict(options)}
    run = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("sfm_worker.py"))],
        input=json.dumps(job) + "\n",
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(source)},
        text=True,
    )
    if run.returncode:
        raise UserError(f"{work.name}: the worker ended with status {run.returncode}; see above")
    answer = json.loads(run.stdout.splitlines()[-1])
    result = answer.get("result")
    row: dict[str, Any] = {
        "workload": work.name,
        "source": str(source),
        "error": answer.get("error"),
        "stages": answer["stages"],
        "wall": sum(times["wall"] for times in answer["stages"].values()),
        "cpu": sum(times["cpu"] for times in answer["stages"].values()),
        "peak_mb": answer["peak_mb"],
    }
    if result is not None:
        row |= {
            "photos": len(result["registered"]) + len(result["unregistered"]),
            "models": result["sub_models"],
            "points": result["points"],
            "reprojection_error": result["reprojection_error"],
            "attempts": result["attempts"],
        }
    return row | judged(work, folder / "input", folder / "distorted" / "sparse" / "0")


def measure_plain(work: Workload, photos: Path, folder: Path, mode: str) -> dict[str, Any]:
    """As `measure`, with COLMAP at its defaults; ``mode`` as in `sfm_plain.py`."""
    program = str(Path(__file__).with_name("sfm_plain.py"))
    run = subprocess.run(
        [sys.executable, program, str(photos), str(folder), mode],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    row: dict[str, Any] = {"workload": work.name, "source": f"plain {mode}", "error": None}
    row |= {"stages": {}, "wall": 0.0, "cpu": 0.0, "peak_mb": None}
    if run.returncode:
        return row | {"error": f"COLMAP ended with status {run.returncode}"}
    row |= json.loads(run.stdout.splitlines()[-1])
    row["photos"] = sum(path.is_file() for path in photos.rglob("*"))
    return row | judged(work, photos, folder / "sparse")


def judged(work: Workload, photos: Path, model: Path) -> dict[str, Any]:
    """The poses and the lens of the COLMAP model in a folder, compared with the truth if known.

    ``photos``: the folder of the photos or frames of which the model was made.
    """
    row: dict[str, Any] = {}
    found: dict[str, Tensor] = {}
    if (model / "cameras.bin").is_file():
        found = poses_in(model)
        row["lens"] = lens_in(model)
        row |= compared_with_gps(found, photos)
    row["placed"] = len(found)
    if work.true is not None:
        true = work.true
        frames = work.source.with_name("frames")
        if work.source.is_file() and frames.is_dir():  # a video of a scene
            shown = frames_shown(photos, frames)
            true = {name: true[frame] for name, frame in shown.items()}
        compared = placed(found, true)
        row |= {"photos": len(true), "placed": len(found)}
        row |= {"correct": len(compared.correct), "wrong": compared.wrong}
        row |= {"missing": compared.missing}
        if compared.correct:
            row |= {
                "rotation_error": float(compared.rotations.quantile(_SHARE)),
                "centre_error": 100 * float(compared.centres.quantile(_SHARE)),
                "rotation_errors": compared.rotations.tolist(),
                "centre_errors": (100 * compared.centres).tolist(),
            }
    return row


def lens_in(model: Path) -> str:
    """The camera model, and the smallest and the largest focal length in pixels."""
    used = read_model(model)
    ids = {image.camera_id for image in used.images}
    cameras = [camera for number, camera in used.cameras.items() if number in ids]
    focals = sorted(camera.params[0] for camera in cameras)
    span = f"{focals[0]:.0f}" + (f" to {focals[-1]:.0f}" if len(focals) > 1 else "")
    return f"{cameras[0].model} {span}"


def compared_with_gps(found: Mapping[str, Tensor], photos: Path) -> dict[str, Any]:
    """The distance between the camera centres and the positions by GPS, in metres; empty without.

    The centres are mapped to the plane of the earth by the affine map with the least sum of
    distances: SfM knows neither the scale nor the vertical direction.
    """
    places = {}
    for name in found:
        with Image.open(photos / name) as image:
            location = read_exif(image.getexif(), *image.size).location
        if location is not None:
            places[name] = location
    if len({place[:2] for place in places.values()}) < 3:
        return {}
    locations = np.array(list(places.values()))
    gps = east_north_up(locations, middle_of(locations))[:, :2]
    poses = torch.stack([found[name] for name in places])
    centres = -(poses[:, :, :3].transpose(1, 2) @ poses[:, :, 3:])[..., 0].numpy()
    weights = np.ones(len(gps))
    for _ in range(30):  # iteratively reweighted least squares, over affine maps 3D -> 2D
        system = np.concatenate([centres, np.ones((len(gps), 1))], 1)
        root = np.sqrt(weights)[:, None]
        solution = np.linalg.lstsq(system * root, gps * root, rcond=1e-3)[0]
        away = np.linalg.norm(system @ solution - gps, axis=1)
        weights = 1 / np.maximum(away, 0.3)
    return {"gps_error": float(np.median(away)), "gps_length": float(np.ptp(gps, 0).max())}


# Tables


def _cell(value: float | int | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _gps(row: Mapping[str, Any]) -> str:
    if "gps_error" not in row:
        return ""
    return f"; median distance from GPS {row['gps_error']:.1f} m of {row['gps_length']:.0f} m"


def print_quality(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    heads = ("photos", "correct", "wrong", "none", "points", "error px", "rot °", "centre %", "MB")
    print(f"{'':22}" + "".join(f"{head:>10}" for head in heads))
    for name, row in zip(names, rows, strict=True):
        photos, found = row.get("photos"), row.get("placed")
        none = None if photos is None else photos - (found or 0)
        cells = [_cell(photos), _cell(row.get("correct"))]
        cells.append(_cell(len(row["wrong"]) if "wrong" in row else None))
        cells += [_cell(none), _cell(row.get("points")), _cell(row.get("reprojection_error"), 2)]
        cells += [_cell(row.get("rotation_error"), 3), _cell(row.get("centre_error"), 3)]
        cells.append(_cell(row["peak_mb"] or None))
        print(f"{name:22}" + "".join(f"{cell:>10}" for cell in cells))
        if "lens" in row:
            print(f"  {row['lens']}" + _gps(row))
        if row["error"]:
            print(f"  {row['error']}")


def print_times(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    found = [stage for row in rows for stage in row["stages"]]
    stages = [stage for stage in _STAGES if stage in found]
    stages += sorted(set(found) - set(stages))
    print(f"\n{'seconds: wall, cpu':22}" + "".join(f"{stage:>15}" for stage in [*stages, "total"]))
    for name, row in zip(names, rows, strict=True):
        times = [row["stages"].get(stage) for stage in stages] + [row]
        cells = [f"{t['wall']:.1f}, {t['cpu']:.1f}" if t else "-" for t in times]
        print(f"{name:22}" + "".join(f"{cell:>15}" for cell in cells))


def print_ratios(rows: Sequence[Mapping[str, Any]]) -> None:
    """For each stage: the least processor time with this build / that with the other build."""
    a, b = dict.fromkeys(row["source"] for row in rows)
    print(f"\n{'processor time: this build / ' + a:40}")
    for name in dict.fromkeys(row["workload"] for row in rows):
        own = [row for row in rows if row["workload"] == name]
        print(f"  {name}")
        for stage in [*_STAGES, "total"]:
            least = []
            for source in (a, b):
                times = [
                    row["cpu"] if stage == "total" else row["stages"].get(stage, {}).get("cpu", 0)
                    for row in own
                    if row["source"] == source
                ]
                least.append(min(times))
            if min(least) > 0:
                print(f"    {stage:16}{least[1] / least[0]:8.3f}")


def _names(arguments: argparse.Namespace) -> list[str]:
    """The names of the workloads; those of scenes end in a number of photos ("room-60")."""
    chosen = arguments.workloads or [*(n for n in DATASETS if n not in _LONG), *KINDS]
    names = []
    for name in chosen:
        kind, dash, count = name.partition("-")
        number = count.removesuffix("s")
        if name in DATASETS or (kind in KINDS and number.isdecimal() and int(number) >= 3):
            names.append(name)
        elif kind in KINDS and not dash:
            names += [f"{kind}-{photos}" for photos in arguments.photos]
        else:
            known = ", ".join([*DATASETS, *KINDS])
            raise UserError(f"workload: unknown name {name!r}; use one of {known}")
    return names


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument(
        "workloads",
        nargs="*",
        help="a real dataset, a scene, SCENE-N for N photos, or SCENE-Ns for N seconds of video",
    )
    parser.add_argument(
        "--photos", type=int, nargs="+", default=[60], help="numbers of photos of the scenes (60)"
    )
    parser.add_argument(
        "--size", type=_size, default=SIZE, help="size of the photos of the scenes (800x600)"
    )
    parser.add_argument(
        "--datasets",
        "--captures",
        type=Path,
        default=ROOT.parent / "shared" / "captures",
        help="folder with the real datasets",
    )
    parser.add_argument(
        "--cache",
        type=Path,
        default=None,
        help=f"folder for the photos of the scenes; default: ${CACHE_VARIABLE}",
    )
    parser.add_argument("--render-only", action="store_true", help="only render the photos")
    parser.add_argument("--effort", default="normal", choices=["draft", "normal", "best"])
    parser.add_argument("--mapper", default="incremental", choices=["incremental", "global"])
    parser.add_argument(
        "--threads", type=int, default=None, help="CPU threads; default: one per processor"
    )
    parser.add_argument(
        "--versus", type=Path, metavar="SRC", help="compare with the package in another src folder"
    )
    parser.add_argument(
        "--plain",
        action="store_true",
        help="also run COLMAP at its defaults, with one camera and with one per photo",
    )
    parser.add_argument("--repeats", type=int, default=1, help="measurements of each workload")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the datasets in DIR")
    parser.add_argument("--json", type=Path, help="also write all values to this file")
    arguments = parser.parse_args()
    cache = arguments.cache or cache_folder()
    options = {key: getattr(arguments, key) for key in ("effort", "mapper", "threads")}
    sources = [*([arguments.versus.resolve()] if arguments.versus else []), ROOT / "src"]
    rows: list[dict[str, Any]] = []
    labels: list[str] = []
    with ExitStack() as stack:
        out = arguments.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in _names(arguments):
            work = workload(name, arguments.datasets, cache, arguments.size)
            if work is None:
                print(f"{name}: skipped, not in {arguments.datasets}")
                continue
            if arguments.render_only:
                continue
            for _ in range(arguments.repeats):
                for i, source in enumerate(sources):
                    folder = out / f"{name}-{len(rows)}"
                    rows.append(measure(work, folder, options, source))
                    other = arguments.versus is not None and i == 0
                    labels.append(f"{name} other" if other else name)
                    print(f"{labels[-1]}: {rows[-1]['wall']:.0f} s", file=sys.stderr, flush=True)
                for mode in MODES if arguments.plain else ():
                    photos = folder / "input"
                    rows.append(measure_plain(work, photos, out / f"{name}-plain-{mode}", mode))
                    labels.append(f"  plain, {mode}")
                if arguments.json:
                    arguments.json.write_text(json.dumps(rows, indent=1))
    if rows:
        print_quality(rows, labels)
        print_times(rows, labels)
        if arguments.versus:
            print_ratios(rows)


if __name__ == "__main__":
    # On SIGTERM, exit by an exception: then the worker is ended, too.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")
