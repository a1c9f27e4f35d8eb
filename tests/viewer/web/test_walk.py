"""A page that people walk through: its ground, its size, and its walls."""

import json
import math

import numpy as np
import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.scene.initial_view import InitialView
from snowsplat.surface.ground import ground_of
from snowsplat.util.errors import UserError
from snowsplat.viewer.http.server import WebServer
from snowsplat.viewer.http.static import static_app
from snowsplat.viewer.web.panel import Description
from snowsplat.viewer.web.publication import site_files, write_site
from snowsplat.viewer.web.scene import ready

from ...browser import Browser, Page

UP = np.array([0.0, -1.0, 0.0])
EYES, WALL = 0.5, 1.5  # world units: of the photographer, above the floor; the distance of a wall
STEP = 0.05
# (3,) of the camera, in the world of the viewer.
PLACE = """(({ x, y, z }) => [x, y, z])(
    sse.viewer.app.root.findByName("camera").getPosition())"""

FRAMES = """new Promise(done => {
    const next = left => left ? requestAnimationFrame(() => next(left - 1)) : done(0);
    next(10);
})"""


def hall() -> tuple[Gaussians, list[Camera]]:
    """A floor of 4 × 4 at y = 0, a wall at z = WALL, and photos of both, from above the middle."""
    side = torch.arange(-2.0, 2.0, STEP)
    x, z = (grid.reshape(-1) for grid in torch.meshgrid(side, side, indexing="ij"))
    floor = torch.stack([x, 0 * x, z], 1)[z < WALL]
    x, y = (grid.reshape(-1) for grid in torch.meshgrid(side, side / 2 - 1, indexing="ij"))
    means = torch.cat([floor, torch.stack([x, y, 0 * x + WALL], 1)])
    scales = torch.full((len(means), 3), 0.7 * STEP)
    scales[: len(floor), 1] = scales[len(floor) :, 2] = 0.01 * STEP
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(len(means), 4)
    colours = torch.rand(len(means), 1, 3, generator=torch.Generator().manual_seed(0))
    opacity = torch.full((len(means),), 6.0)
    scene = Gaussians(means, scales.log(), quats, opacity, colours, torch.zeros(len(means), 0, 3))
    cameras = []
    for x, aside in ((-0.6, 0.8), (-0.2, -0.8), (0.2, 0.8), (0.6, -0.8)):
        for down in (0.2, 1.0):
            place = torch.tensor([x, -EYES, -0.5], dtype=torch.float64)
            target = torch.tensor([x + aside, -EYES + down, 0.7], dtype=torch.float64)
            pose = look_at(place, target, torch.from_numpy(UP))
            cameras.append(Camera(160, 120, 80.0, 80.0, 80.0, 60.0, pose))
    return scene, cameras


def test_ground():
    ground = ground_of(*hall(), UP)
    assert ground.eye_height == pytest.approx(EYES, rel=0.03)
    x, y, z = ground.vertices.T
    near = np.abs(x) < 1
    assert np.abs(y[near & (z < 1)]).max() < 0.02  # the floor
    assert np.abs(z[near & (y < -0.2)] - WALL).max() < 0.03  # the wall


def test_no_ground():
    scene, cameras = hall()
    with pytest.raises(UserError, match="needs the cameras"):
        ground_of(scene, [], UP)
    with pytest.raises(UserError, match="no ground is below"):
        ground_of(scene, cameras, -UP)
    with pytest.raises(UserError, match="show no surface"):
        ground_of(scene.select(scene.means[:, 2] < -1.9), cameras, UP)


def test_people_have_their_size():
    """Eyes are at 1.3 units, where the viewer has them; a scene in metres keeps its size."""
    scene, cameras = hall()
    # The world of COLMAP is turned.
    quat = torch.tensor([math.cos(0.4), 0.0, 0.0, math.sin(0.4)], dtype=torch.float64)
    change = Similarity(3.0, rotation_from_quat(quat), torch.zeros(3, dtype=torch.float64))
    turned = transform(scene, change), [camera.transformed(change) for camera in cameras]
    for given in ((scene, cameras), turned):
        page = ready(*given, walk=True)
        vertices = positions(page.ground)
        low = np.median(vertices[vertices[:, 1] < np.quantile(vertices[:, 1], 0.3), 1])
        assert -page.start.position[1] - low == pytest.approx(1.3, rel=0.05)
    scene.metres_per_unit = 4.0
    assert ready(scene, cameras, walk=True).scale == 4.0
    assert ready(scene, cameras).ground == b""


def positions(file: bytes) -> np.ndarray:
    """(V, 3): of the mesh in a GLB file, in the world of the viewer."""
    length = int.from_bytes(file[12:16], "little")
    accessor = json.loads(file[20 : 20 + length])["accessors"][0]
    return np.frombuffer(file, "<f4", 3 * accessor["count"], 28 + length).reshape(-1, 3)


@pytest.mark.browser
def test_a_wall_stops_people(tmp_path):
    ahead = InitialView((0.0, -EYES, -0.5), (0.0, -EYES, 1.0), 60.0, 4 / 3)
    page = ready(*hall(), start=ahead, walk=True)
    write_site(tmp_path, page, Description("hall"))
    files, headers = site_files(tmp_path)
    with WebServer(static_app(files), headers=headers) as server, Browser(320, 240) as browser:
        shown: Page = browser.open(f"{server.url}?webgl")
        shown.wait_for("window.sse?.viewer?.state.loaded && sse.viewer.state.walkAllowed", 60)
        shown.evaluate("document.querySelector('.sse-fpsCamera').click()")
        shown.wait_for("sse.viewer.state.cameraMode === 'walk'")
        wall = page.scale * WALL
        shown.call("Input.dispatchKeyEvent", type="rawKeyDown", key="w", code="KeyW")
        shown.wait_for(f"({PLACE})[2] > {wall - 0.4}", 60)
        shown.evaluate(FRAMES)  # the key is still pressed
        _, y, z = shown.evaluate(PLACE)
        shown.call("Input.dispatchKeyEvent", type="keyUp", key="w", code="KeyW")
        assert wall - 0.4 < z < wall  # a person has a radius of 0.2
        assert y == pytest.approx(1.3, abs=0.3)
        assert not shown.errors
