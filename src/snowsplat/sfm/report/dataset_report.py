"""dataset_report.html: the result of structure from motion as one self-contained page."""

import json
import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from PIL import Image

from snowsplat.data.colmap.model import posed_camera, read_model, read_points
from snowsplat.data.frame.placement import placement_of
from snowsplat.data.photos.colour_profile import plain_pixels
from snowsplat.evaluation.verdict import Verdict
from snowsplat.project.dataset_folder import DatasetFolder, left_out_of
from snowsplat.sfm.colmap.options import PANORAMA_MODEL
from snowsplat.sfm.pinhole_model import photo_of
from snowsplat.sfm.report.more_photos import Advice, advice
from snowsplat.sfm.report.photo_problems import what_to_do
from snowsplat.sfm.report.scene_map import PlacedPhoto, draw_scene
from snowsplat.util.files import write_text
from snowsplat.util.html import render_page
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import printable

_MAX_PICTURES = 24  # evenly spaced over the photos
_PICTURE_HEIGHT = 480  # pixels, of the pictures that can be opened
_MAX_UNUSED = 200  # number of unused photos that are listed; the others are only counted

# By `focal_from` and `focal_held` of a camera.
_FOCAL_FROM = {
    ("exif", False): message("from EXIF, refined"),
    ("exif", True): message("from EXIF; the photos do not determine it"),
    ("guessed", False): message("estimated from the photos"),
    ("guessed", True): message("a usual one; the photos do not determine it"),
}
_STAGES = {
    "photos": message("reading photos"),
    "poses": message("estimating poses"),
    "images": message("undistorting"),
}


def write_report(dataset: Path, facts: dict[str, Any]) -> Path:
    """Write ``dataset_report.html`` of a finished dataset; returns its path.

    ``facts``: JSON values: "inputs", a list of paths; "settings"; "gathered", a `Gathered`; "sfm",
    an `SfmResult`; "undistorted", an `Undistorted`; "seconds", the duration of each stage;
    "problems", what is wrong with single photos, by name; "verdict", a `Verdict`; "alone", whether
    the user has to start the training.

    Raises: UserError: the model in ``sparse/0`` or an image cannot be read.
    """
    sfm, gathered, undistorted = facts["sfm"], facts["gathered"], facts["undistorted"]
    photos = _photos_with_poses(dataset, gathered["photos"])
    first, folder = Path(facts["inputs"][0]), DatasetFolder(dataset)
    name = first.parent.name if first.name == "input" else first.stem
    xyz, rgb = _points(dataset)
    more = advice(photos, xyz)
    placement = placement_of(undistorted)
    unit = "m" if placement is not None and placement.is_metric else message("units")
    bad = list(facts["problems"].items())[:_MAX_PICTURES]
    command = f"snowsplat train {quote(str(dataset))} -o {quote(dataset.name + '-out')}"
    values = {
        "title": f"{name} – dataset",
        "name": name,
        "photos": photos,
        "verdict": Verdict.from_json(facts["verdict"]),
        "advice": more,
        "more_photos": _number_places(more),
        "bad_photos": [(_small(folder, each), each, what_to_do(what)) for each, what in bad],
        "drawings": draw_scene(photos, xyz, rgb, more.places, unit),
        "placement": None if placement is None else placement.rows(),
        "strip": _strip(folder, photos),
        "lenses": [_lens(camera) for camera in sfm["cameras"]],
        "sizes": [f"{width} × {height}" for width, height, *_ in undistorted["sizes"]],
        "unused": sorted(left_out_of(gathered, sfm), key=lambda each: each.stage != "poses"),
        "listed": _MAX_UNUSED,
        "stages": _STAGES,
        "longest": max([*facts["seconds"].values(), 1e-9]),
        "settings": json.dumps(facts["settings"], indent=2, ensure_ascii=False),
        "command": command if facts["alone"] else None,
    }
    write_text(folder.report, render_page("sfm/report/dataset_report.html.j2", **facts | values))
    return folder.report


def draw_from_above(dataset: Path) -> str:
    """An SVG drawing of the cameras and points of a dataset, from above.

    Raises: UserError: the model in ``sparse/0`` cannot be read.
    """
    return draw_scene(_photos_with_poses(dataset, []), *_points(dataset))[0].svg


def _points(dataset: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (P, 3) float64, and colours (P, 3) uint8."""
    points = read_points(DatasetFolder(dataset).model)
    if points is None:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    return points.xyz.numpy().astype(np.float64), points.rgb.numpy()


def _photos_with_poses(dataset: Path, gathered: Sequence[dict[str, Any]]) -> list[PlacedPhoto]:
    sequences = {photo["name"]: photo["sequence"] for photo in gathered}
    model = read_model(DatasetFolder(dataset).model)
    photos, drawn = [], set[str]()
    for image in model.images:
        camera = posed_camera(model, image)
        half = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
        pose = camera.cam_from_world.numpy()
        # One of several views of a photo stands for the others in the line of a video.
        photo = photo_of(image.name) if image.number in model.frames else image.name
        sequence = None if photo in drawn else sequences.get(photo)
        drawn.add(photo)
        photos.append(PlacedPhoto(printable(image.name), sequence, pose, *half))
    return photos


def _number_places(more: Advice) -> list[tuple[Message, Message]]:
    """The places for more photos, "1" or "1 to 3", and why."""
    numbers = iter(range(1, len(more.reasons) + 1))
    rows = []
    for reason, same in groupby(more.reasons):
        first, *rest = [next(numbers) for _ in same]
        which = message("{first}", first=first)
        if rest:
            which = message("{first} to {last}", first=first, last=rest[-1])
        rows.append((which, reason))
    return rows


def _strip(folder: DatasetFolder, photos: Sequence[PlacedPhoto]) -> list[tuple[Image.Image, str]]:
    count = min(len(photos), _MAX_PICTURES)
    names = [photos[i * len(photos) // count].name for i in range(count)]
    return [(_small(folder, name), name) for name in names if (folder.images / name).is_file()]


def _small(folder: DatasetFolder, photo: str) -> Image.Image:
    """The undistorted photo, or the photo itself if it became several views; reduced."""
    path = folder.images / photo
    path = path if path.is_file() else folder.photos / photo
    with Image.open(path) as image:
        image.draft("RGB", (2 * _PICTURE_HEIGHT, _PICTURE_HEIGHT))  # faster JPEG decoding
        scale = min(1.0, _PICTURE_HEIGHT / image.height)
        size = max(1, round(image.width * scale)), round(image.height * scale)
        small = plain_pixels(image, path).resize(size, Image.Resampling.LANCZOS)
    if small.mode == "RGBA":
        ground = Image.new("RGBA", small.size, (128, 128, 128, 255))
        small = Image.alpha_composite(ground, small).convert("RGB")
    return small


def _lens(camera: Mapping[str, Any]) -> dict[str, Any]:
    """What the page shows of a camera of `SfmResult`."""
    width, height, focal = camera["width"], camera["height"], float(camera["params"][0])
    shown = {"photos": camera["images"], "size": f"{width} × {height}", "model": camera["model"]}
    if camera["model"] == PANORAMA_MODEL:
        return shown | {"focal": message("all directions"), "parameters": ""}
    # The angle of view without distortion; that of the distorted lens differs a little.
    half = max(width, height) / 2 / focal if focal > 0 else 0.0
    fisheye = camera["model"].endswith("FISHEYE")
    about = message(
        "{focal:.0f} px ({angle:.0f}°), {origin}",
        focal=focal,
        angle=math.degrees(2 * (half if fisheye else math.atan(half))),
        origin=_FOCAL_FROM[camera["focal_from"], bool(camera.get("focal_held"))],
    )
    parameters = ", ".join(f"{value:.5g}" for value in camera["params"])
    return shown | {"focal": about, "parameters": parameters}
