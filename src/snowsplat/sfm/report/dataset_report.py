"""dataset_report.html: the result of structure from motion as one self-contained page."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from snowsplat.data.colmap import posed_camera, read_model, read_points
from snowsplat.data.frame.placement import Placement, placement_of
from snowsplat.data.photos.colour_profile import plain_pixels
from snowsplat.evaluation import verdict
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.options import PANORAMA_MODEL
from snowsplat.sfm.pinhole_model import photo_of
from snowsplat.sfm.report.more_photos import Advice, advice
from snowsplat.sfm.report.photo_problems import Problem, what_to_do
from snowsplat.sfm.report.scene_map import PlacedPhoto, draw_scene
from snowsplat.util.duration import duration
from snowsplat.util.files import write_text
from snowsplat.util.html import bar, cards, page, picture, table, text
from snowsplat.util.messages import message
from snowsplat.util.safe_json import printable

_MAX_PICTURES = 24  # evenly spaced over the photos
_PICTURE_HEIGHT = 480  # pixels, of the pictures that can be opened
_MAX_UNUSED = 200  # number of unused photos that are listed; the others are only counted

# By `focal_from` and `focal_held` of a camera; earlier versions did not have the latter.
_FOCAL_FROM = {
    ("exif", False): "from EXIF, refined",
    ("exif", True): "from EXIF; the photos do not determine it",
    ("guessed", False): "estimated from the photos",
    ("guessed", True): "a usual one; the photos do not determine it",
}
_STAGES = {"photos": "reading photos", "poses": "estimating poses", "images": "undistorting"}

_STYLE = """
.maps { display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-start; }
svg.map { width: 100%; height: auto; display: block; }
.strip { display: flex; gap: 6px; overflow-x: auto; padding-bottom: 8px; }
.strip img { height: 110px; border-radius: 4px; display: block; }
td img { height: 74px; border-radius: 4px; display: block; }
"""


def write_report(dataset: Path, facts: dict[str, Any]) -> Path:
    """Write ``dataset_report.html`` of a finished dataset; returns its path.

    ``facts``: JSON values: "inputs", a list of paths; "settings"; "gathered", a `Gathered`; "sfm",
    an `SfmResult`; "undistorted", an `Undistorted`; "seconds", the duration of each stage;
    "problems", what is wrong with single photos, by name; "verdict", a `Verdict`; "alone", whether
    the user has to start the training.

    Raises: UserError: the model in ``sparse/0`` or an image cannot be read.
    """
    photos = _photos_with_poses(dataset, facts["gathered"]["photos"])
    name = _name(facts["inputs"])
    xyz, rgb = _points(dataset)
    more, judged = advice(photos, xyz), verdict.Verdict.from_json(facts["verdict"])
    placement = placement_of(facts["undistorted"])
    body = [
        _headline(name, facts),
        "" if judged is None else judged.html(message("the photos")),
        _cards(facts),
        _your_photos(dataset, [photo.name for photo in photos], facts, more),
        _maps(photos, xyz, rgb, more.places, placement),
        _placed(placement),
        _strip(dataset, [photo.name for photo in photos]),
        _lenses(facts["sfm"], facts["undistorted"]),
        _left_out(facts),
        _timing(facts),
        _next_step(dataset) if facts["alone"] else "",
    ]
    path = DatasetFolder(dataset).report
    write_text(path, page(f"{name} – dataset", body, _STYLE + verdict.STYLE))
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


# The parts of the page, from top to bottom


def _headline(name: str, facts: dict[str, Any]) -> str:
    sfm = facts["sfm"]
    registered, unregistered = len(sfm["registered"]), len(sfm["unregistered"])
    total = registered + unregistered
    which = f"{registered} of {total}" if unregistered else f"all {total}"
    summary = f"The poses of {which} photos were found."
    lines = [f"<h1>{text(name)}</h1>", f"<p>{summary}</p>"]
    if len(sfm["sub_models"]) > 1:
        sizes = ", ".join(map(str, sfm["sub_models"]))
        lines.append(
            f'<p class="bad">The photos form {len(sfm["sub_models"])} separate groups ({sizes} '
            "photos); only the largest is used. Take more photos in between to connect them.</p>"
        )
    return "\n".join(lines)


def _cards(facts: dict[str, Any]) -> str:
    sfm = facts["sfm"]
    total = len(sfm["registered"]) + len(sfm["unregistered"])
    error = sfm["reprojection_error"]
    figures = [
        (f"{len(sfm['registered'])} / {total}", "photos with a pose"),
        (f"{sfm['points']:,}", f"points, {sfm['observations']:,} observations"),
        ("–" if error is None else f"{error:.2f} px", "mean reprojection error"),
        (str(len(sfm["cameras"])), "lens" if len(sfm["cameras"]) == 1 else "lenses"),
        (duration(sum(facts["seconds"].values())), "total time"),
    ]
    return cards(figures)


def _your_photos(dataset: Path, names: Sequence[str], facts: dict[str, Any], more: Advice) -> str:
    """What was wrong, and what to do better, for the person who took the photos."""
    lines = ["<p>No photo is blurred, too dark or too bright.</p>"]
    without = len(facts["sfm"]["unregistered"]) + len(facts["gathered"]["skipped"])
    if bad := facts["problems"]:
        count = f"{len(bad)} of {len(names)} photos"
        lines = [
            f"<p>{count} may be better. Take them again, or leave them out if others show the same."
            f"</p>\n{_bad_photos(dataset, bad)}"
        ]
    if without:
        lines.append(f"<p>{without} photos were not used; the reasons are below.</p>")
    lines += [
        f"<p>Fixed to the frame: {text(note)}.</p>" for note in facts["gathered"].get("notes", [])
    ]
    lines += _more_photos(more)
    return "<h2>Your photos</h2>\n" + "\n".join(lines)


def _bad_photos(dataset: Path, bad: dict[str, Problem]) -> str:
    rows = [
        [picture(_reduced(_file_of(dataset, name)), name), text(name), text(what_to_do(problem))]
        for name, problem in list(bad.items())[:_MAX_PICTURES]
    ]
    rest = "" if len(bad) <= _MAX_PICTURES else f", and {len(bad) - _MAX_PICTURES:,} more"
    names = ", ".join(list(bad)[_MAX_PICTURES:_MAX_UNUSED])
    others = f'<p class="soft">{text(names)}{rest}.</p>' if rest else ""
    return table(["", "photo", "what is wrong"], rows, "names") + others


def _more_photos(more: Advice) -> list[str]:
    lines = []
    if more.seldom:
        lines.append(
            f"<p>{100 * more.seldom:.0f}% of the points are in at most three photos. There, the "
            "scene will look right only from the places of these photos.</p>"
        )
    if len(more.places):
        count = len(more.places)
        photos = "a photo" if count == 1 else f"{count} more photos"
        numbers = iter(range(1, count + 1))
        reasons = []
        for reason, same in groupby(more.reasons):
            first, *rest = [next(numbers) for _ in same]
            which = f"{first} to {rest[-1]}" if rest else str(first)
            reasons.append([which, text(reason)])
        lines.append(
            f"<p>Take {photos} from the numbered places in the drawing from above:</p>\n"
            f"{table([], reasons)}"
        )
    return lines


def _maps(
    photos: Sequence[PlacedPhoto],
    xyz: np.ndarray,
    rgb: np.ndarray,
    marks: np.ndarray,
    placement: Placement | None,
) -> str:
    unit = "m" if placement is not None and placement.is_metric else "units"
    above = "From above. Orange: the cameras; white: the first camera."
    above += " Numbers: places for more photos." if len(marks) else ""
    above += " Blue: the path of the video." if any(p.sequence is not None for p in photos) else ""
    captions = (above, "From the side.")
    drawings = draw_scene(photos, xyz, rgb, marks, unit)
    # Side by side, both drawings have the same scale: flex-grow is proportional to the width.
    figures = "\n".join(
        f'<figure style="flex:{drawing.width} 1 {drawing.width // 2}px;'
        f'max-width:{2 * drawing.width}px">{drawing.svg}'
        f"<figcaption>{caption}</figcaption></figure>"
        for drawing, caption in zip(drawings, captions, strict=True)
    )
    return f'<h2>Cameras and points</h2>\n<div class="maps">{figures}</div>'


def _placed(placement: Placement | None) -> str:
    """What the frame of the scene was found from."""
    if placement is None:  # a dataset of an earlier version
        return ""
    rows = [[text(part) for part in line.split(": ", 1)] for line in placement.lines()]
    return f"<h2>Level, north and scale</h2>\n{table([], rows)}"


def _strip(dataset: Path, names: Sequence[str]) -> str:
    count = min(len(names), _MAX_PICTURES)
    chosen = [names[i * len(names) // count] for i in range(count)]
    images = "".join(
        picture(_reduced(DatasetFolder(dataset).images / name), name)
        for name in chosen
        if (DatasetFolder(dataset).images / name).is_file()
    )
    return f'<h2>Images</h2>\n<div class="strip">{images}</div>'


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


def _lenses(sfm: dict[str, Any], undistorted: dict[str, Any]) -> str:
    rows = []
    for camera in sfm["cameras"]:
        width, height, focal = camera["width"], camera["height"], float(camera["params"][0])
        if camera["model"] == PANORAMA_MODEL:
            size = f"{width} × {height}"
            rows.append([str(camera["images"]), size, "all directions", camera["model"]])
            continue
        # The angle of view without distortion; that of the distorted lens differs a little.
        half = max(width, height) / 2 / focal if focal > 0 else 0.0
        fisheye = str(camera["model"]).endswith("FISHEYE")
        angle = math.degrees(2 * (half if fisheye else math.atan(half)))
        parameters = ", ".join(f"{value:.5g}" for value in camera["params"])
        focal_from = _FOCAL_FROM[camera["focal_from"], bool(camera.get("focal_held"))]
        rows.append(
            [
                str(camera["images"]),
                f"{width} × {height}",
                f"{focal:.0f} px ({angle:.0f}°), {focal_from}",
                f"{camera['model']} <span class='soft'>{parameters}</span>",
            ]
        )
    sizes = ", ".join(f"{w} × {h}" for w, h, *_ in undistorted["sizes"])
    how = "undistorted" if undistorted["resampled"] else "copied, as there is no distortion"
    lenses = table(["photos", "size", "focal length (longer side)", "lens model"], rows)
    said = ""
    if zooms := sfm.get("zooms", ""):
        said = f"<p>The photos have {text(zooms)}, so each group of them has its own lens.</p>\n"
    if sfm.get("fisheye"):
        said += f"<p>{text(sfm['fisheye'][0].upper() + sfm['fisheye'][1:])}.</p>\n"
    return (
        f'<h2>Lenses</h2>\n{said}{lenses}\n<p class="soft">Images for training: {sizes}, {how}.</p>'
    )


def _left_out(facts: dict[str, Any]) -> str:
    entries = [
        *((name, why) for name, why in facts["sfm"]["unregistered"].items()),
        *((source, why) for source, why in facts["gathered"]["skipped"]),
    ]
    if not entries:
        return ""
    rows = [[text(name), text(why)] for name, why in entries[:_MAX_UNUSED]]
    more = len(entries) - _MAX_UNUSED
    rest = f'<p class="soft">… and {more:,} more, see sfm.json.</p>' if more > 0 else ""
    return f"<h2>Photos not used</h2>\n{table(['photo', 'reason'], rows, 'names')}{rest}"


def _timing(facts: dict[str, Any]) -> str:
    seconds = facts["seconds"]
    longest = max([*seconds.values(), 1e-9])
    rows = []
    for stage, value in seconds.items():
        rows.append([text(_STAGES.get(stage, stage)), duration(value), bar(value / longest)])
    sfm = facts["sfm"]
    attempts = "".join(f"<li>{text(attempt)}</li>" for attempt in sfm["attempts"])
    settings = text(json.dumps(facts["settings"], indent=2, ensure_ascii=False))
    inputs = ", ".join(text(path) for path in facts["inputs"])
    return (
        f"<h2>Time and settings</h2>\n{table(['stage', 'time', ''], rows)}\n"
        f'<p class="soft">Inputs: {inputs}. Matched pairs: {text(sfm["pairs"])}.</p>\n'
        f"<ol>{attempts}</ol>\n"
        f"<details><summary>Settings</summary><pre>{settings}</pre></details>"
    )


def _name(inputs: Sequence[str]) -> str:
    """The name of the dataset: that of the input, or if it is ``input``, of its parent folder."""
    first = Path(inputs[0])
    return first.parent.name if first.name == "input" else first.stem


def _next_step(dataset: Path) -> str:
    command = f"snowsplat train {shlex.quote(str(dataset))} -o {shlex.quote(dataset.name + '-out')}"
    return f"<h2>Next step</h2>\n<pre>{text(command)}</pre>"
