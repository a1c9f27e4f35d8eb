"""A finished scene prepared for the browser: upright, at a usual scale, compressed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import normalize

from snowsplat.formats import GaussianArrays, glb
from snowsplat.formats.compressed_ply import encode_compressed_ply
from snowsplat.formats.lod import lod_files
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, rotation_from_quat, shortest_rotation
from snowsplat.scene.initial_view import InitialView, bounding_sphere, overview, view_of_camera
from snowsplat.scene.orientation import VIEWING_DISTANCE, scene_up, up_of_surfaces
from snowsplat.scene.render import render
from snowsplat.surface.ground import Ground, ground_of
from snowsplat.trajectory.follow import training_path
from snowsplat.util.errors import UserError
from snowsplat.viewer.http.static import Served, ServedFile, served
from snowsplat.viewer.web.panel import Description, Hiding, hiding_of, panel_settings
from snowsplat.viewer.web.stops import Stops, first_stop, shown_at, stops_of
from snowsplat.viewer.web.viewer_page import asset, content_policy, page, script
from snowsplat.viewer.web.viewer_settings import Annotation, settings

_SCENE = "scene.compressed.ply"
#: The file with the pictures of the stops.
PICTURES = "stops.webp"
_KEYFRAMES = 121  # of the film; the viewer interpolates between them
_LEVEL_ENOUGH = math.radians(3)  # a smaller tilt of the horizon is not visible
_SURFACES = 20_000  # maximum number of surfaces that determine the up direction
_UP = np.array([0.0, -1.0, 0.0])  # of the viewer
_EYE_HEIGHT = 1.3  # of the viewer, above the ground, where people walk
_TOO_LARGE = 3.0  # maximum factor between the distances of the scene and the usual ones
_TOO_FAR = 30.0  # the same for an overview: a house in metres is walked through in metres


def site(
    about: Description,
    scene: ReadyScene,
    levels: Callable[[Gaussians], Path] | None = None,
    count: int | None = None,
) -> tuple[dict[str, Served], dict[str, str]]:
    """The files of a page that shows a scene, by name, and the HTTP headers for them.

    ``levels`` returns the index (`lod-meta.json`) of levels of detail of a scene, which the page
    loads instead of the complete scene. ``count``: the number of Gaussians, if ``scene`` is only a
    coarse level, `ready` without a turn. Then the levels stay as they are, and the page only scales
    them.
    """
    in_place = count is not None
    if levels is not None:
        scene = scene.complete()
    content = _content(scene.gaussians, levels)
    bootstrap = scene.bootstrap(about, f"./{PICTURES}", count)
    bootstrap["contentUrl"] = f"./{next(iter(content))}"
    index = page(f"{about.title} - snowsplat", bootstrap)
    files: dict[str, Served] = {
        "": ServedFile(index.encode(), "text/html; charset=utf-8"),
        "index.css": ServedFile(asset("index.css").encode(), "text/css; charset=utf-8"),
        "index.js": ServedFile(
            script(scene.scale if in_place else 1.0).encode(), "text/javascript; charset=utf-8"
        ),
        **content,
    }
    if scene.stops.views:
        files[PICTURES] = ServedFile(scene.stops.pictures, "image/webp")
    own = "'self'"
    policy = f"{content_policy(index, own)}; frame-ancestors 'none'"
    return files, {"Content-Security-Policy": policy}


def _content(gaussians: Gaussians, levels: Callable[[Gaussians], Path] | None) -> dict[str, Served]:
    """What the page loads to show the Gaussians; the first file is the scene."""
    if levels is None:
        arrays = GaussianArrays.from_gaussians(gaussians)
        scene = encode_compressed_ply(Path(_SCENE), arrays)
        return {_SCENE: ServedFile(scene, "application/octet-stream")}
    index = levels(gaussians)
    return served(index.parent, lod_files(index))


class ReadyScene(NamedTuple):
    """A scene in a frame that suits the viewer."""

    gaussians: Gaussians
    start: InitialView  # the initial view
    # Views along the path of the photographer, at equal distances in time; empty if there is no
    # such path.
    film: list[InitialView]
    stops: Stops  # views of some of the photos, and the subject of the scene
    background: Sequence[float]  # red, green, blue in 0..1
    hiding: Hiding  # what the page can hide
    scale: float  # of the frame, relative to that of the scene that was given
    metres: float | None  # in a unit of the scene that was given, if that is known
    first: int  # the stop of the initial view; -1: it was given, or there are no stops
    notes: Sequence[Annotation] = ()
    ground: bytes = b""  # a GLB file of what stops a person who walks; empty: nobody walks

    def camera(self, width: int, height: int) -> Camera:
        """What a window of this size, in pixels, shows at first."""
        if self.first < 0:
            return self.start.camera(width, height)
        return shown_at(self.stops, self.first, width, height)

    def complete(self) -> ReadyScene:
        """Nothing is hidden at first; for levels of detail, whose coarse Gaussians are large."""
        return self._replace(hiding=replace(self.hiding, start=0))

    def bootstrap(
        self, about: Description, pictures: str, count: int | None = None
    ) -> dict[str, Any]:
        """What `page` needs, except for the address of the scene.

        ``pictures``: the address of the pictures of the stops. ``count``: the number of Gaussians,
        if those here are only a coarse level.
        """
        count = count or len(self.gaussians)
        return {
            "settings": settings(self.start, self.background, self.film, self.notes),
            "antialiased": self.gaussians.antialiased,
            "panel": panel_settings(
                about,
                count,
                self.start,
                self.stops,
                pictures,
                self.hiding,
                self.scale,
                self.metres,
                self.first,
            ),
        }


def ready(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    background: Sequence[float] = (0.0, 0.0, 0.0),
    start: InitialView | None = None,
    notes: Sequence[Annotation] = (),
    *,
    turn: bool = True,
    walk: bool = False,
) -> ReadyScene:
    """The scene in a frame that suits the viewer, and views in that frame.

    ``start``: the initial view; None: the `first_stop`, or an overview. ``turn``: see
    `viewing_frame`. ``walk``: with the ground, in a frame in metres, so that people walk through
    the scene at their size. If the scene is not known in metres, photos are taken at the height of
    the eyes.

    Raises: UserError: ``walk``, but no ground is known; see `ground_of`.
    """
    change, depth = viewing_frame(gaussians, cameras, turn=turn)
    metres = gaussians.metres_per_unit
    ground = None
    if walk:
        change = change or Similarity.identity()
        ground = ground_of(gaussians, cameras, change.rotation.T.numpy() @ _UP)
        change = replace(change, scale=metres or _EYE_HEIGHT / ground.eye_height)
    if change is not None:
        gaussians = transform(gaussians, change)
        depth *= change.scale
        cameras = [camera.transformed(change) for camera in cameras]
        start = start and start.transformed(change)
        notes = [note._replace(view=note.view.transformed(change)) for note in notes]
    stops = stops_of(gaussians, cameras, depth if cameras else 1.0, background)
    hiding = hiding_of(gaussians, stops.middle, stops.radius, hide=not cameras)
    film = _film(cameras, depth) if cameras else []
    first = first_stop(stops) if cameras and start is None else -1
    start = start or (stops.view(first) if cameras else overview(gaussians))
    scale = change.scale if change else 1.0
    found = gaussians, start, film, stops, background, hiding, scale, metres, first, notes
    return ReadyScene(*found, b"" if ground is None else _ground_file(ground, change))


def _ground_file(ground: Ground, change: Similarity | None) -> bytes:
    """A GLB file in the world of the viewer, which turns scenes by 180° about z: y is up."""
    assert change is not None
    vertices = change.apply(torch.from_numpy(ground.vertices).double()).numpy() * [-1, -1, 1]
    rows = ground.faces.astype("<u4").reshape(-1, 1)
    attributes = {"POSITION": vertices.astype("<f4")}
    scene, arrays = glb.contents({"mesh": 0}, {"mode": 4}, attributes, rows)
    return b"".join(glb.pack({"asset": {"version": "2.0"}} | scene, arrays))


def viewing_frame(
    gaussians: Gaussians, cameras: Sequence[Camera], *, turn: bool = True
) -> tuple[Similarity | None, float]:
    """The transform to a frame that suits the viewer; None if that of the scene does. And the
    depth of what the first camera shows, in world units.

    In the viewer −y is up, and navigation has a fixed speed. If the cameras imply another up
    direction, or distances very different from `VIEWING_DISTANCE`, the scene is rotated and scaled.
    Without cameras, the surfaces may imply another up direction, and the distance is that of
    the `overview`. Without ``turn``, the scene is only scaled: a person has turned it upright, or
    its files stay as they are.
    """
    if cameras:
        depth = _depth_ahead(gaussians, cameras[0])
        rotations = torch.stack([camera.cam_from_world[:, :3] for camera in cameras])
        return _change(scene_up(rotations.numpy()) if turn else _UP, depth), depth
    up = up_of_surfaces(*_surfaces(gaussians)) if turn else None
    view = overview(gaussians)
    depth = math.dist(view.position, view.target)
    return _change(_UP if up is None else up, depth, _TOO_FAR), depth


def _film(cameras: Sequence[Camera], depth: float) -> list[InitialView]:
    """The path of the photographer; see `trajectory.training_path`."""
    in_order = [f"{number:08}" for number in range(len(cameras))]
    try:
        path = training_path(cameras, in_order, _KEYFRAMES, depth)
    except UserError:  # all cameras are at the same place
        return []
    return [view_of_camera(camera, depth) for camera in path]


def _change(direction: np.ndarray, depth: float, most: float = _TOO_LARGE) -> Similarity | None:
    """Transform to a frame with −y up and usual distances; None if the scene has both."""
    up = torch.from_numpy(direction)
    rotation = shortest_rotation(up, torch.from_numpy(_UP))
    tilt = math.acos(max(-1.0, min(1.0, -float(up[1]))))
    ratio = VIEWING_DISTANCE / depth
    is_level, is_near = tilt < _LEVEL_ENOUGH, 1 / most < ratio < most
    if is_level and is_near:
        return None
    turn = torch.eye(3, dtype=torch.float64) if is_level else rotation
    return Similarity(1.0 if is_near else ratio, turn, torch.zeros(3, dtype=torch.float64))


def _surfaces(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals (N, 3), areas (N,) and positions (N, 3) of a scene's surfaces: the flat opaque
    Gaussians in its `bounding_sphere`."""
    middle, radius = bounding_sphere(gaussians)
    scales, axes = gaussians.log_scales.detach().double().sort(1)
    inside = (gaussians.means.detach().double() - middle).norm(dim=1) < radius
    flat = scales[:, 1] - scales[:, 0] > math.log(2)
    rows = (inside & flat & (gaussians.opacities.detach() > 0.2)).nonzero()[:, 0]
    rows = rows[:: -(-len(rows) // _SURFACES) or 1]
    rotations = rotation_from_quat(normalize(gaussians.quats.detach()[rows].double(), dim=1))
    normals = rotations.gather(2, axes[rows, :1, None].expand(-1, 3, 1))[:, :, 0]
    areas = (scales[rows, 1] + scales[rows, 2]).exp()
    if len(areas):  # a few may be huge
        areas = areas.clamp_max(float(areas.quantile(0.9)))
    return normals.numpy(), areas.numpy(), gaussians.means.detach()[rows].double().numpy()


def _depth_ahead(gaussians: Gaussians, camera: Camera) -> float:
    """Median depth, in world units, at the centre of a camera's image."""
    factor = max(1, max(camera.width, camera.height) // 160)
    small = camera.downscaled(factor)
    with torch.no_grad():
        output = render(gaussians.detach(), small, with_depth=True)
    assert output.depth is not None
    rows = slice(3 * small.height // 8, -(-5 * small.height // 8))
    columns = slice(3 * small.width // 8, -(-5 * small.width // 8))
    depth, alpha = output.depth[rows, columns], output.alpha[rows, columns]
    solid = alpha > 0.5
    if bool(solid.any()):
        return float((depth[solid] / alpha[solid]).median())
    # There are no Gaussians at the centre: use the median distance to all Gaussians.
    distances = (gaussians.means.double() - camera.position).norm(dim=1)
    distances = distances[distances.isfinite()]
    found = float(distances.median()) if len(distances) else 0.0
    return found if found > 0 else 1.0
