"""The frame of the scene: origin, axes and scale, from all that is known about a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from snowsplat.data.frame.placement import Placement
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.orientation import VIEWING_DISTANCE
from snowsplat.sfm.gps import east_north_up, location_of, middle_of, position_errors
from snowsplat.sfm.ingest.photo import Attitude, Photo
from snowsplat.sfm.ingest.photos.attitude import UPRIGHT
from snowsplat.sfm.orient.cameras import Cameras, read_cameras
from snowsplat.sfm.orient.marker import MarkerScale
from snowsplat.sfm.orient.positions import Alignment, align
from snowsplat.sfm.orient.up import (
    CONTRADICTION,
    FEWEST,
    Evidence,
    combine_evidence,
    directions_of,
    of_cameras,
    of_ground,
    of_sensors,
    robust_mean,
    with_markers,
)
from snowsplat.util.messages import Message, message
from snowsplat.util.names import all_names

if TYPE_CHECKING:
    import pycolmap

# GPS is used if it determines the scale to this relative standard deviation.
_SCALE_ERROR = 0.08
# North determines the axes of the scene if it is known to this standard deviation.
_NORTH_ERROR = math.radians(10)
# Standard deviations of the mean of many gimbals and compasses: metal is near, and yaw drifts.
_GIMBAL_YAW, _COMPASS = math.radians(3), math.radians(15)
# Directions of sensors that differ by more than this from their median are wrong, and at most this
# share of them may be.
_WRONG_NORTH, _MOST_WRONG = math.radians(30), 0.25
# The level is also that of GPS if GPS makes its error smaller than this share.
_BETTER = 0.8


@dataclass(frozen=True)
class Oriented:
    """The transform from the world frame of SfM to that of the scene, and where it comes from."""

    scene_from_sfm: Similarity
    placement: Placement


@dataclass(frozen=True)
class _Gps:
    alignment: Alignment  # of the cameras to metres east, north and up of `origin`
    name: Message
    origin: np.ndarray  # (3,) latitude, longitude (°), altitude (m)


@dataclass(frozen=True)
class _North:
    direction: np.ndarray  # (3,) horizontal unit vector in the world frame of SfM
    name: Message
    error: float  # radians


def orientation(
    model: pycolmap.Reconstruction,
    photos: Sequence[Photo] = (),
    marker: tuple[MarkerScale | None, list[Message]] = (None, []),
) -> Oriented:
    """The frame of the scene, in which y points down.

    Up is combined from all evidence; see `up`. If GPS positions or a gimbal tell where north is, z
    points north and x east. Otherwise, z is the mean viewing direction, made horizontal. The origin
    is the point that the cameras look at. If they look outwards or all in the same direction, it is
    the median of the points. If markers or GPS positions determine the scale, the unit is a metre;
    markers are more accurate. Otherwise, the median distance from a camera to the points that it
    sees is `VIEWING_DISTANCE`.

    Args:
        photos: with the metadata; photos that are not in the model are ignored.
        marker: the result of `scale_of_markers`.

    Raises: ValueError: the model has no cameras.
    """
    cameras = read_cameras(model)
    by_name = {photo.name: photo for photo in photos}
    known = [by_name.get(name) for name in cameras.names]
    cameras = _upright(cameras, known)
    attitudes = [None if photo is None else photo.attitude for photo in known]
    evidence, doubts = of_sensors(cameras, attitudes)
    held = of_cameras(cameras)
    ground = None if evidence else of_ground(cameras, held)
    up, more = combine_evidence([*evidence, held, *([] if ground is None else [ground])])
    doubts += more
    measured, of_markers = marker
    if measured is not None:
        up, more = with_markers(up, measured.normals, measured.tilts)
        doubts += more
    gps, more = _gps(cameras, known, up)
    doubts += more + of_markers
    up_from, direction, level_error = list(up.names), up.up, up.error
    if gps is not None:
        direction = gps.alignment.rotation[2]
        if gps.alignment.level_error < _BETTER * level_error:
            up_from.append(gps.name)
        level_error = gps.alignment.level_error
    north: _North | None
    if gps is not None and gps.alignment.north_error <= _NORTH_ERROR:
        north = _North(gps.alignment.rotation[1], gps.name, gps.alignment.north_error)
    else:
        north = _north_of_sensors(cameras, attitudes, direction)
    if north is not None and north.error < _NORTH_ERROR:
        ahead = _horizontal(north.direction, direction)
    else:
        ahead = _viewing_direction(cameras, direction)
    rotation = np.stack([np.cross(-direction, ahead), -direction, ahead])
    scale = VIEWING_DISTANCE / cameras.distance
    found: dict[str, Any] = {}
    if north is not None:
        towards = rotation @ _horizontal(north.direction, direction)
        found["north"] = tuple(round(float(value), 12) for value in towards)
        found["north_from"], found["north_error"] = north.name, math.degrees(north.error)
    if gps is not None:
        scale = gps.alignment.scale
        found |= {
            "metres_per_unit": 1.0,
            "scale_from": gps.name,
            "scale_error": gps.alignment.scale_error,
            "position_error": gps.alignment.error,
            "origin": location_of(gps.alignment.place(cameras.subject[None])[0], gps.origin),
        }
    if measured is not None:
        if gps is not None:
            ratio = measured.metres_per_unit / scale
            errors = math.hypot(gps.alignment.scale_error, measured.error)
            if abs(math.log(ratio)) > CONTRADICTION * errors:
                doubts.append(
                    message(
                        "by the marker, the scene is {share:.0f}% {larger} than by GPS; is its "
                        "side right?",
                        share=100 * abs(ratio - 1),
                        larger=message("larger") if ratio > 1 else message("smaller"),
                    )
                )
        scale = measured.metres_per_unit
        found |= {
            "metres_per_unit": 1.0,
            "scale_from": measured.name,
            "scale_error": measured.error,
            "position_error": None,
        }
    placement = Placement(up_from, math.degrees(level_error), doubts=doubts, **found)
    shift = -scale * rotation @ cameras.subject
    return Oriented(
        Similarity(scale, torch.from_numpy(rotation), torch.from_numpy(shift)), placement
    )


def _upright(cameras: Cameras, photos: Sequence[Photo | None]) -> Cameras:
    """The cameras of the upright photos."""
    turned = np.eye(3)[None].repeat(len(photos), axis=0)
    for matrix, photo in zip(turned, photos, strict=True):
        if photo is not None and photo.turned in UPRIGHT:
            matrix[:2, :2] = UPRIGHT[photo.turned]
    return replace(cameras, rotations=turned @ cameras.rotations)


def _gps(
    cameras: Cameras, photos: Sequence[Photo | None], up: Evidence
) -> tuple[_Gps | None, list[Message]]:
    """The GPS positions if they determine the scale, and doubts as text for users."""
    rows = [i for i, photo in enumerate(photos) if photo is not None and photo.location is not None]
    located = [photo for photo in photos if photo is not None and photo.location is not None]
    if len(located) < FEWEST:
        return None, []
    locations = np.array([photo.location for photo in located])
    origin = middle_of(locations)
    places, errors = east_north_up(locations, origin), position_errors(located)
    alignment = align(cameras.centres[rows], places, errors, up)
    if alignment is None:
        return None, [
            message("GPS gives no scale: the photos have fewer than three different positions")
        ]
    spread = float(np.sqrt(np.square(places[:, :2] - places[:, :2].mean(axis=0)).sum(1).mean()))
    if alignment.scale_error > _SCALE_ERROR or not alignment.agrees:
        if spread < CONTRADICTION * float(np.median(errors)):
            why = message("the positions differ too little for their error")
        else:
            why = message("the positions do not agree with the camera poses")
        return None, [message("GPS gives no scale: {why}", why=why)]
    doubts = []
    if alignment.up_away > CONTRADICTION:
        doubts.append(
            message(
                "GPS positions and {others} disagree about the level", others=all_names(up.names)
            )
        )
    name = message("GPS positions of {n} photos", n=len(located))
    return _Gps(alignment, name, origin), doubts


def _north_of_sensors(
    cameras: Cameras, attitudes: Sequence[Attitude | None], up: np.ndarray
) -> _North | None:
    """North from the yaw of gimbals or else from compasses, if most of them agree."""
    for gimbal, name, usual in (
        (True, message("gimbal angles"), _GIMBAL_YAW),
        (False, message("compasses"), _COMPASS),
    ):
        found = directions_of(cameras, attitudes, "north", gimbal)
        if len(found) < FEWEST:
            continue
        norths = np.array([_horizontal(north, up) for north in found])
        mean, spread = robust_mean(norths)
        wrong = (norths @ mean < math.cos(_WRONG_NORTH)).mean()
        if wrong <= _MOST_WRONG:
            about = message("the {name} of {n} photos", name=name, n=len(norths))
            return _North(mean, about, math.hypot(usual, spread))
    return None


def _horizontal(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The unit vector (3,) of the horizontal part of ``direction``."""
    level = direction - (direction @ up) * up
    return level / max(float(np.linalg.norm(level)), 1e-12)


def _viewing_direction(cameras: Cameras, up: np.ndarray) -> np.ndarray:
    """(3,) unit vector: the horizontal part of the mean viewing direction. If this part is too
    short, that of the viewing direction of the first camera."""
    level = np.eye(3) - np.outer(up, up)
    forward = cameras.forward
    # If the first camera looks straight down, use the direction of its upper image edge.
    candidates = (forward.mean(axis=0), forward[0], -cameras.rotations[0, 1])
    for direction, least in zip(candidates, (0.5, 0.1, 0.0), strict=True):
        horizontal = level @ direction
        length = float(np.linalg.norm(horizontal))
        if length > least:
            break
    return horizontal / length
