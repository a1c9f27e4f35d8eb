"""`tracks_off`: are the points where the observations that came with them say?

Programs that reconstruct a scene write where each photo shows each point. For a model as it was
written, the typical distance to the projected point is below 2 pixels. It is more if poses, points
or intrinsics were changed later, each in another way, or lost digits; and if the photos were
scaled, cropped or undistorted later: then the matches of the photos agree with the poses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from snowsplat.data.dataset import Points, View
from snowsplat.data.judge.rig import Rig

# Distance relative to the longer side of the photo: 10 pixels of 1000. Programs discard
# observations that are more than 4 to 16 pixels away; the typical distance is far less.
_OFF = 0.01
_FEWEST = 10  # observations that a photo needs to be judged


def tracks_off(views: Sequence[View], rig: Rig, points: Points | None) -> tuple[int, list[float]]:
    """The number of photos with enough observations; and the typical distances of points in those
    where it is more than 1% of the longer side, relative to it: infinite if most points are behind
    the camera.

    Args:
        views: the views of the dataset.
        rig: their cameras.
        points: with or without tracks.
    """
    tracks = None if points is None else points.tracks
    if points is None or tracks is None:
        return 0, []
    number = {view.name: i for i, view in enumerate(views)}
    xyz = points.xyz.numpy().astype(np.float64)[tracks.point]
    count, off = 0, []
    for photo, name in enumerate(tracks.photos):
        chosen = np.flatnonzero(tracks.photo == photo)
        if (view := number.get(name)) is None or len(chosen) < _FEWEST:
            continue
        where, depth = rig.project(view, xyz[chosen])
        rest = where - rig.centre[view] - tracks.ray[chosen] * rig.focal[view]
        distance = np.linalg.norm(rest * rig.aspect[view], axis=1)
        typical = float(np.median(np.where(depth > 0, distance, np.inf)))
        count += 1
        if not typical <= _OFF:
            off.append(typical)
    return count, off
