"""The settings of the viewer of finished scenes: views, colours, its film, annotations."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from snowsplat.scene.initial_view import InitialView
from snowsplat.viewer.web.panel import view_numbers

#: Duration of the animation of the page.
FILM_SECONDS = 20.0


class Annotation(NamedTuple):
    """A text at a place: the target of the view that shows it."""

    title: str
    text: str
    view: InitialView


def settings(
    start: InitialView,
    background: Sequence[float],
    film: Sequence[InitialView] = (),
    notes: Sequence[Annotation] = (),
) -> dict[str, Any]:
    """The viewer's settings: its initial view, and a background colour in 0..1.

    ``film``: views at equal distances in time, `FILM_SECONDS` in total: the animation of the page.
    If there are none, the viewer uses an animation of its own.
    """
    off = {"enabled": False}
    first = view_numbers(start, start.aspect)
    return {
        "version": 2,
        "tonemapping": "none",  # colours are displayed as they were trained
        "highPrecisionRendering": False,
        "background": {"color": list(background)},
        "postEffectSettings": {
            "sharpness": {**off, "amount": 0},
            "bloom": {**off, "intensity": 0.1, "blurLevel": 2},
            "grading": {**off, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {**off, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {**off, "intensity": 0.5},
        },
        "animTracks": [_track(film, start.aspect)] if film else [],
        "cameras": [{"initial": {"position": first[:3], "target": first[3:6], "fov": first[6]}}],
        "annotations": [_annotation(note, start.aspect) for note in notes],
        "startMode": "animTrack" if film else "default",
    }


def _annotation(note: Annotation, aspect: float) -> dict[str, Any]:
    numbers = view_numbers(note.view, aspect)
    position, target, fov = numbers[:3], numbers[3:6], numbers[6]
    initial = {"position": position, "target": target, "fov": fov}
    texts = {"title": note.title, "text": note.text}
    return {"position": target, **texts, "extras": {}, "camera": {"initial": initial}}


def _track(film: Sequence[InitialView], aspect: float) -> dict[str, Any]:
    times = [i * FILM_SECONDS / (len(film) - 1) for i in range(len(film))]
    keys = [view_numbers(view, aspect) for view in film]
    return {
        "name": "film",
        "duration": FILM_SECONDS,
        "frameRate": 1,  # times are in seconds
        "loopMode": "pingpong",
        "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": times,
            "values": {
                "position": [x for key in keys for x in key[:3]],
                "target": [x for key in keys for x in key[3:6]],
                "fov": [key[6] for key in keys],
            },
        },
    }
