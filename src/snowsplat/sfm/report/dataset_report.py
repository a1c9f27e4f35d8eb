"""dataset_report.html: the result of structure from motion as one self-contained page."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
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
from snowsplat.sfm.report.photo_problems import Problem, what_to_do
from snowsplat.sfm.report.scene_map import PlacedPhoto, draw_scene
from snowsplat.util.files import write_text
from snowsplat.util.html import render_page
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import printable

_MAX_PICTURES = 24  # evenly spaced over the photos
_PICTURE_HEIGHT = 480  # pixels, of the pictures that can be opened
_MAX_UNUSED = 200  # number of unused photos that are listed; the others are only counted

# By `focal_from` and `focal_held` of a camera; earlier versions did not have the latter.
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


@dataclass(frozen=True)
class _BadPhoto:
    name: str
    image: Image.Image
    problem: Message


@dataclass(frozen=True)
class _Lens:
    photos: int
    size: str
    focal: Message
    model: str
    parameters: str


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
    name, names = _name(facts["inputs"]), [photo.name for photo in photos]
    xyz, rgb = _points(dataset)
    more = advice(photos, xyz)
    placement = placement_of(undistorted)
    unit = "m" if placement is not None and placement.is_metric else message("units")
    path = DatasetFolder(dataset).report
    values = {
        "title": f"{name} – dataset",
        "name": name,
        "photos": photos,
        "verdict": Verdict.from_json(facts["verdict"]),
        "advice": more,
        "more_photos": _numbered(more),
        "bad_photos": _bad_photos(dataset, facts["problems"]),
        "drawings": draw_scene(photos, xyz, rgb, more.places, unit),
        "placement": None if placement is None else placement.rows(),
        "strip": _strip(dataset, names),
        "lenses": [_lens(camera) for camera in sfm["cameras"]],
        "sizes": [f"{width} × {height}" for width, height, *_ in undistorted["sizes"]],
        "unused": sorted(left_out_of(gathered, sfm), key=lambda each: each.stage != "poses"),
        "listed": _MAX_UNUSED,
        "stages": _STAGES,
        "longest": max([*facts["seconds"].values(), 1e-9]),
        "settings": json.dumps(facts["settings"], indent=2, ensure_ascii=False),
        "command": _next_step(dataset) if facts["alone"] else None,
    }
    write_text(path, render_page("sfm/report/dataset_report.html.j2", **facts | values))
    return path


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


def _bad_photos(dataset: Path, bad: dict[str, Problem]) -> list[_BadPhoto]:
    return [
        _BadPhoto(name, _reduced(_file_of(dataset, name)), what_to_do(problem))
        for name, problem in list(bad.items())[:_MAX_PICTURES]
    ]


def _numbered(more: Advice) -> list[tuple[Message, Message]]:
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


def _strip(dataset: Path, names: Sequence[str]) -> list[tuple[Image.Image, str]]:
    count = min(len(names), _MAX_PICTURES)
    chosen = [names[i * len(names) // count] for i in range(count)]
    return [
        (_reduced(dataset / "images" / name), name)
        for name in chosen
        if (dataset / "images" / name).is_file()
    ]


def _file_of(dataset: Path, photo: str) -> Path:
    """The undistorted photo, or the photo itself if it became several views."""
    path = DatasetFolder(dataset).images / photo
    return path if path.is_file() else DatasetFolder(dataset).photos / photo


def _reduced(path: Path) -> Image.Image:
    with Image.open(path) as image:
        image.draft("RGB", (2 * _PICTURE_HEIGHT, _PICTURE_HEIGHT))  # faster JPEG decoding
        scale = min(1.0, _PICTURE_HEIGHT / image.height)
        size = max(1, round(image.width * scale)), round(image.height * scale)
        small = plain_pixels(image, path).resize(size, Image.Resampling.LANCZOS)
    if small.mode == "RGBA":
        ground = Image.new("RGBA", small.size, (128, 128, 128, 255))
        small = Image.alpha_composite(ground, small).convert("RGB")
    return small


def _lens(camera: Mapping[str, Any]) -> _Lens:
    width, height, focal = camera["width"], camera["height"], float(camera["params"][0])
    photos, size, model = int(camera["images"]), f"{width} × {height}", str(camera["model"])
    if model == PANORAMA_MODEL:
        return _Lens(photos, size, message("all directions"), model, "")
    # The angle of view without distortion; that of the distorted lens differs a little.
    half = max(width, height) / 2 / focal if focal > 0 else 0.0
    angle = math.degrees(2 * (half if model.endswith("FISHEYE") else math.atan(half)))
    about = message(
        "{focal:.0f} px ({angle:.0f}°), {origin}",
        focal=focal,
        angle=angle,
        origin=_FOCAL_FROM[camera["focal_from"], bool(camera.get("focal_held"))],
    )
    parameters = ", ".join(f"{value:.5g}" for value in camera["params"])
    return _Lens(photos, size, about, model, parameters)


def _name(inputs: Sequence[str]) -> str:
    """The name of the dataset: that of the input, or if it is ``input``, of its parent folder."""
    first = Path(inputs[0])
    return first.parent.name if first.name == "input" else first.stem


def _next_step(dataset: Path) -> str:
    return f"snowsplat train {shlex.quote(str(dataset))} -o {shlex.quote(dataset.name + '-out')}"
