"""Where more photos would help: gaps between the cameras, and parts that too few photos show.

The frame is that of `orient`: y points down.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snowsplat.sfm.report.coverage import SAME_PLACE
from snowsplat.sfm.report.scene_map import PlacedPhoto
from snowsplat.util.messages import Message, message

#: At most this number of places is suggested.
_PLACES = 5
#: With fewer photos, everything is a gap.
_FEWEST = 3
# Photos surround a subject if they look at it from directions that cover at least half of a circle.
# Then a gap of at least 40 degrees between them is worth a photo.
_SURROUND, _GAP = math.radians(180), math.radians(40)
# Directions of a gap are suggested at this distance from one another.
_SPACING = math.radians(20)
# A photo is far from the others if the nearest one is this many times as far away as usual.
_FAR = 4.0
#: A point is seen seldom if at most this number of photos shows it.
_SELDOM = 3
#: A smaller share of points that are seen seldom is not reported.
_SHARE = 0.05
_POINTS = 5000  # a sample


@dataclass(frozen=True)
class Advice:
    """Where more photos would help."""

    places: np.ndarray  # (K, 3) camera positions in the world frame, at most five
    reasons: list[Message]  # for each of them, what is missing there, as a phrase
    seldom: float  # share of the points, 0..1, that at most three photos show; 0 if it is below 5%


def advice(photos: Sequence[PlacedPhoto], xyz: np.ndarray) -> Advice:
    """Where more photos would help.

    Args:
        photos: those with a pose.
        xyz: (P, 3) points of the scene.
    """
    centres = np.array([photo.centre for photo in photos]).reshape(-1, 3)
    if len(photos) < _FEWEST:
        return Advice(np.empty((0, 3)), [], 0.0)
    ahead = np.array([photo.cam_from_world[2, :3] for photo in photos])
    found = _gaps_around(centres, ahead) + _lonely(centres, ahead)
    seldom, place = _seen_seldom(photos, centres, xyz)
    if place is not None:
        found.append((place, message("this part of the scene is in few photos")))
    found = found[:_PLACES]
    places = np.array([place for place, _ in found]).reshape(-1, 3)
    return Advice(places, [reason for _, reason in found], seldom)


def _gaps_around(centres: np.ndarray, ahead: np.ndarray) -> list[tuple[np.ndarray, Message]]:
    """Places in the largest gaps between cameras that surround a subject."""
    subject = _focus(centres, ahead)
    out = (centres - subject)[:, [0, 2]]
    # Only cameras that look at the subject; those of a room look away from its middle. Most of them
    # are beside it; those of a drone may look down.
    toward = (-(centres - subject) * ahead).sum(1) > 0.5 * np.linalg.norm(centres - subject, axis=1)
    beside = (-out * ahead[:, [0, 2]]).sum(1) > 0.5 * np.linalg.norm(out, axis=1)
    if (toward & beside).sum() < max(_FEWEST, 0.7 * len(centres)):
        return []
    angles = np.sort(np.arctan2(out[toward, 1], out[toward, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * math.pi)
    if 2 * math.pi - gaps.max() < _SURROUND:
        return []
    radius = float(np.median(np.linalg.norm(out[toward], axis=1)))
    height = float(np.median(centres[toward, 1]))
    places = []
    for i in np.argsort(-gaps, kind="stable"):
        if gaps[i] < _GAP:
            break
        count = round(gaps[i] / _SPACING) - 1
        for step in range(1, count + 1):
            angle = angles[i] + gaps[i] * step / (count + 1)
            place = np.array([radius * math.cos(angle), 0.0, radius * math.sin(angle)]) + subject
            place[1] = height
            gap = message(
                "no photo shows the subject from here ({angle:.0f}° gap)",
                angle=math.degrees(gaps[i]),
            )
            places.append((place, gap))
    return places


def _lonely(centres: np.ndarray, ahead: np.ndarray) -> list[tuple[np.ndarray, Message]]:
    """Places between photos that are far from all others and their nearest neighbours."""
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    # The photo itself, and other photos from its place, such as the views of a panorama.
    apart[apart <= SAME_PLACE * apart.max()] = np.inf
    nearest = apart.min(1)
    usual = float(np.median(nearest))
    lonely = np.flatnonzero(nearest > max(_FAR * usual, 1e-9))
    return [
        ((centres[i] + centres[apart[i].argmin()]) / 2, message("the next photos are far apart"))
        for i in lonely[np.argsort(-nearest[lonely], kind="stable")]
    ]


def _seen_seldom(
    photos: Sequence[PlacedPhoto], centres: np.ndarray, xyz: np.ndarray
) -> tuple[float, np.ndarray | None]:
    """The share of the points that few photos show, and a camera position that shows them.

    A photo is assumed to show what is inside its frame; occlusion is not considered, so the true
    number may be smaller.
    """
    points = xyz[:: max(1, len(xyz) // _POINTS)]
    if not len(points):
        return 0.0, None
    counts = np.zeros(len(points), np.int64)
    for photo in photos:
        x, y, z = photo.cam_from_world[:, :3] @ points.T + photo.cam_from_world[:, 3:]
        inside = (abs(x) < photo.half_width * z) & (abs(y) < photo.half_height * z)
        counts += inside
    seldom = (counts <= _SELDOM) & (counts > 0)
    share = float(seldom.mean())
    if share < _SHARE:
        return 0.0, None
    # From the photo that is nearest to the middle of these points, go on toward the next nearest.
    middle = np.median(points[seldom], axis=0)
    nearest = np.argsort(np.linalg.norm(centres - middle, axis=1), kind="stable")
    return share, (centres[nearest[0]] + centres[nearest[1]]) / 2


def _focus(centres: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """(3,): the point nearest to all optical axes, in the sense of least squares."""
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    total = across.sum(0) + 1e-9 * np.eye(3)
    point: np.ndarray = np.linalg.solve(total, (across @ centres[:, :, None]).sum(0)[:, 0])
    return point
