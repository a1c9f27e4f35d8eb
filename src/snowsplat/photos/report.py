"""capture_report.html: what came of the photos, on one page that needs nothing else."""

from __future__ import annotations

import base64
import io
import json
import math
import shlex
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from snowsplat.capture.colmap import posed_camera
from snowsplat.capture.colmap_files import read_model, read_points
from snowsplat.files import write_text
from snowsplat.photos.scene_map import PlacedPhoto, draw_scene

_FILE = "capture_report.html"
_THUMBNAILS = 24  # at most, evenly chosen
_THUMBNAIL_HEIGHT = 110  # pixels
_NAMED = 200  # photos that are listed one by one
_ERROR_HIGH = 1.5  # pixels; good ones are below 1

_FOCAL_FROM = {"exif": "the camera's note (EXIF) refined", "guessed": "found from the photos"}
_STAGES = {"photos": "reading photos", "poses": "finding poses", "images": "undistorting"}

_STYLE = """
:root { color-scheme: light dark; --bg: #fbfaf7; --card: #fff; --ink: #20252c; --soft: #667080;
  --line: #e3e0d8; --accent: #b8650a; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --bg: #14171b; --card: #1c2127; --ink: #e6e9ed;
  --soft: #98a2ae; --line: #2e353d; --accent: #ffb454; --bad: #ff8a80; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--bg); color: var(--ink); line-height: 1.5;
  font-family: system-ui, -apple-system, "Segoe UI", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 32px 20px 64px; }
h1 { font-size: 1.7rem; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; margin: 36px 0 10px; }
p { margin: 6px 0; } .soft, figcaption { color: var(--soft); } .bad { color: var(--bad); }
.cards { display: flex; flex-wrap: wrap; gap: 12px; margin: 22px 0; }
.card { flex: 1 1 150px; background: var(--card); border: 1px solid var(--line);
  border-radius: 8px; padding: 12px 16px; }
.card b { display: block; font-size: 1.6rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.maps { display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-start; }
figure { margin: 0; min-width: 0; } svg.map { width: 100%; height: auto; display: block; }
figcaption { font-size: .9rem; margin-top: 4px; }
.strip { display: flex; gap: 6px; overflow-x: auto; padding-bottom: 8px; }
.strip img { height: 110px; border-radius: 4px; display: block; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: 5px 14px 5px 0; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: break-word; }
th { color: var(--soft); font-weight: 500; } .names td { overflow-wrap: anywhere; }
code, pre { font-family: ui-monospace, Menlo, Consolas, monospace; font-size: .9em; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: 10px 14px; overflow-x: auto; margin: 8px 0; }
.bar { display: inline-block; height: .7em; border-radius: 2px; background: var(--accent); }
summary { cursor: pointer; color: var(--soft); } ol { margin: 6px 0; padding-left: 1.4em; }
"""


def write_report(capture: Path, facts: dict[str, Any]) -> Path:
    """Write ``capture_report.html`` of a finished capture; gives its path.

    Args:
        facts: "inputs", a list of paths; "settings"; "gathered", a `Gathered`; "sfm", an
            `SfmResult`; "undistorted", an `Undistorted`; "seconds" of each stage: JSON values.

    Raises:
        UserError: the model in ``sparse/0`` or an image cannot be read.
    """
    photos = _placed(capture, facts)
    name = _name(facts["inputs"])
    body = [
        _headline(name, facts),
        _cards(facts),
        _maps(capture, photos),
        _strip(capture, [photo.name for photo in photos]),
        _lenses(facts["sfm"]["cameras"], facts["undistorted"]),
        _left_out(facts),
        _course(facts),
        _next(capture),
    ]
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f"<title>{_text(name)} – capture</title><style>{_STYLE}</style></head>\n"
        "<body><main>\n" + "\n".join(filter(None, body)) + "\n</main></body></html>\n"
    )
    path = capture / _FILE
    write_text(path, page)
    return path


def _placed(capture: Path, facts: dict[str, Any]) -> list[PlacedPhoto]:
    sequences = {photo["name"]: photo["sequence"] for photo in facts["gathered"]["photos"]}
    model = read_model(capture / "sparse" / "0")
    photos = []
    for image in model.images:
        camera = posed_camera(model, image)
        half = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
        pose = camera.cam_from_world.numpy()
        photos.append(PlacedPhoto(_printable(image.name), sequences.get(image.name), pose, *half))
    return photos


# The parts of the page, from top to bottom


def _headline(name: str, facts: dict[str, Any]) -> str:
    sfm = facts["sfm"]
    placed, rest = len(sfm["registered"]), len(sfm["unregistered"])
    if not rest:
        verdict = f"All {placed} photos have their place."
    else:
        verdict = f"{placed} of {placed + rest} photos have their place."
    lines = [f"<h1>{_text(name)}</h1>", f"<p>{verdict}</p>"]
    if len(sfm["sub_models"]) > 1:
        sizes = ", ".join(map(str, sfm["sub_models"]))
        lines.append(
            f'<p class="bad">The photos fall into {len(sfm["sub_models"])} parts that do not hang '
            f"together ({sizes} photos); the largest is used. Photos from in between join them.</p>"
        )
    error = sfm["reprojection_error"]
    if error is not None and error > _ERROR_HIGH:
        lines.append(
            '<p class="bad">The reprojection error is high: look for photos that are blurred, or '
            "of things that moved, or another camera model.</p>"
        )
    return "\n".join(lines)


def _cards(facts: dict[str, Any]) -> str:
    sfm = facts["sfm"]
    total = len(sfm["registered"]) + len(sfm["unregistered"])
    error = sfm["reprojection_error"]
    cards = [
        (f"{len(sfm['registered'])} / {total}", "photos placed"),
        (f"{sfm['points']:,}", f"points, seen {sfm['observations']:,} times"),
        ("–" if error is None else f"{error:.2f} px", "mean reprojection error"),
        (str(len(sfm["cameras"])), "lens" if len(sfm["cameras"]) == 1 else "lenses"),
        (_duration(sum(facts["seconds"].values())), "in all"),
    ]
    inner = "".join(f'<div class="card"><b>{value}</b>{label}</div>' for value, label in cards)
    return f'<div class="cards">{inner}</div>'


def _maps(capture: Path, photos: Sequence[PlacedPhoto]) -> str:
    points = read_points(capture / "sparse" / "0")
    xyz = np.empty((0, 3)) if points is None else points.xyz.numpy().astype(np.float64)
    rgb = np.empty((0, 3), np.uint8) if points is None else points.rgb.numpy()
    captions = (
        "From above. Orange: the cameras; white: the first one.",
        "From the side. Up is up.",
    )
    if any(photo.sequence is not None for photo in photos):
        captions = (captions[0] + " Blue: the way of the video.", captions[1])
    # Beside each other they fill the page at one scale: they grow as they are wide.
    figures = "\n".join(
        f'<figure style="flex:{drawing.width} 1 {drawing.width // 2}px;'
        f'max-width:{2 * drawing.width}px">{drawing.svg}'
        f"<figcaption>{caption}</figcaption></figure>"
        for drawing, caption in zip(draw_scene(photos, xyz, rgb), captions, strict=True)
    )
    return f'<h2>Cameras and points</h2>\n<div class="maps">{figures}</div>'


def _strip(capture: Path, names: Sequence[str]) -> str:
    count = min(len(names), _THUMBNAILS)
    chosen = [names[i * len(names) // count] for i in range(count)]
    images = "".join(
        f'<img src="data:image/jpeg;base64,{_thumbnail(capture / "images" / name)}" '
        f'alt="{_text(name)}" title="{_text(name)}"/>'
        for name in chosen
        if (capture / "images" / name).is_file()
    )
    return f'<h2>Images</h2>\n<div class="strip">{images}</div>'


def _thumbnail(path: Path) -> str:
    with Image.open(path) as image:
        image.draft("RGB", (4 * _THUMBNAIL_HEIGHT, 2 * _THUMBNAIL_HEIGHT))  # JPEG decodes smaller
        width = max(1, round(image.width * _THUMBNAIL_HEIGHT / image.height))
        small = image.convert("RGBA" if "A" in image.mode else "RGB")
        small = small.resize((width, _THUMBNAIL_HEIGHT), Image.Resampling.LANCZOS)
    if small.mode == "RGBA":
        ground = Image.new("RGBA", small.size, (128, 128, 128, 255))
        small = Image.alpha_composite(ground, small).convert("RGB")
    data = io.BytesIO()
    small.save(data, "JPEG", quality=75)
    return base64.b64encode(data.getvalue()).decode("ascii")


def _lenses(cameras: Iterable[dict[str, Any]], undistorted: dict[str, Any]) -> str:
    rows = []
    for camera in cameras:
        width, height, focal = camera["width"], camera["height"], float(camera["params"][0])
        # The angle that a pinhole of that focal length sees; a lens' own differs a little.
        angle = math.degrees(2 * math.atan(max(width, height) / 2 / focal)) if focal > 0 else 0.0
        parameters = ", ".join(f"{value:.5g}" for value in camera["params"])
        rows.append(
            [
                str(camera["images"]),
                f"{width} × {height}",
                f"{focal:.0f} px ({angle:.0f}°), {_FOCAL_FROM[camera['focal_from']]}",
                f"{camera['model']} <span class='soft'>{parameters}</span>",
            ]
        )
    sizes = ", ".join(f"{w} × {h}" for w, h, *_ in undistorted["sizes"])
    how = (
        "without lens distortion" if undistorted["resampled"] else "copied: there is no distortion"
    )
    table = _table(["photos", "size", "focal length (longer side)", "lens model"], rows)
    return f'<h2>Lenses</h2>\n{table}\n<p class="soft">Images for training: {sizes}, {how}.</p>'


def _left_out(facts: dict[str, Any]) -> str:
    entries = [
        *((name, why) for name, why in facts["sfm"]["unregistered"].items()),
        *((source, why) for source, why in facts["gathered"]["skipped"]),
    ]
    if not entries:
        return ""
    rows = [[_text(name), _text(why)] for name, why in entries[:_NAMED]]
    more = len(entries) - _NAMED
    rest = f'<p class="soft">… and {more:,} more, see capture.json.</p>' if more > 0 else ""
    return f"<h2>Not used</h2>\n{_table(['photo', 'why'], rows, 'names')}{rest}"


def _course(facts: dict[str, Any]) -> str:
    seconds = facts["seconds"]
    longest = max([*seconds.values(), 1e-9])
    rows = []
    for stage, value in seconds.items():
        share = max(0.01, value / longest)
        width = f"width:{35 * share:.1f}vw;max-width:{400 * share:.0f}px"
        bar = f'<span class="bar" style="{width}"></span>'
        rows.append([_text(_STAGES.get(stage, stage)), _duration(value), bar])
    sfm = facts["sfm"]
    attempts = "".join(f"<li>{_text(attempt)}</li>" for attempt in sfm["attempts"])
    settings = _text(json.dumps(facts["settings"], indent=2, ensure_ascii=False))
    inputs = ", ".join(_text(path) for path in facts["inputs"])
    return (
        f"<h2>How it went</h2>\n{_table(['stage', 'time', ''], rows)}\n"
        f'<p class="soft">From {inputs}. Pairs of photos: {_text(sfm["pairs"])}.</p>\n'
        f"<ol>{attempts}</ol>\n"
        f"<details><summary>Settings</summary><pre>{settings}</pre></details>"
    )


def _name(inputs: Sequence[str]) -> str:
    """What the capture is of; of photos in LOCATION/input, that is LOCATION."""
    first = Path(inputs[0])
    return first.parent.name if first.name == "input" else first.stem


def _next(capture: Path) -> str:
    command = f"snowsplat train {shlex.quote(str(capture))} -o {shlex.quote(capture.name + '-out')}"
    return f"<h2>Next</h2>\n<pre>{_text(command)}</pre>"


# Words and tables


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "plain") -> str:
    """Cells are HTML already."""
    top = "".join(f"<th>{head}</th>" for head in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table class='{kind}'><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def _text(value: object) -> str:
    return escape(_printable(str(value)))


def _printable(text: str) -> str:
    """File names may hold bytes that are no text, and control characters that XML refuses."""
    text = text.encode("utf-8", "replace").decode("utf-8")
    return "".join(c if c in "\n\t" or c.isprintable() else "\ufffd" for c in text)
