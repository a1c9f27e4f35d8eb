"""The web viewer: its input, and its image in a real browser."""

import dataclasses
import json
import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from snowsplat.formats import GaussianArrays
from snowsplat.formats.lod import INDEX, read_index
from snowsplat.formats.lod_writer import LodSizes, write_lod
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.scene.initial_view import InitialView, overview
from snowsplat.scene.render import render
from snowsplat.viewer.http.server import WebServer
from snowsplat.viewer.http.static import static_app
from snowsplat.viewer.web.panel import Description
from snowsplat.viewer.web.scene import ready, site
from snowsplat.viewer.web.viewer_settings import FILM_SECONDS

from ...browser import Browser, Page

WIDTH, HEIGHT = 480, 360
LOADED = "!!window.app"  # the viewer sets it after its first complete frame
PLACE = """(({ x, y, z }) => [x, y, z])(
    sse.viewer.app.root.findByName("camera").getPosition())"""


def serve(files, headers) -> WebServer:
    return WebServer(static_app(files), headers=headers)


def camera_of(start: InitialView) -> Camera:
    """The viewer's camera."""
    return start.camera(WIDTH, HEIGHT)


def wide(camera: Camera, start: InitialView) -> Camera:
    """A camera's pose, with the window size and field of view of the initial view."""
    like = camera_of(start)
    return dataclasses.replace(like, cam_from_world=camera.cam_from_world)


def picture(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    with torch.no_grad():
        return render(gaussians, camera).image.clamp(0, 1).mul(255).numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a.astype(float) - b) ** 2) / 255**2))


def test_the_initial_view_is_the_first_camera(trained):
    gaussians, start, *_ = ready(trained.gaussians, trained.cameras)
    camera = trained.cameras[0]
    # World z was up. The scale is unchanged, as the distances are usual ones.
    turned = transform(trained.gaussians, _similarity(1.0, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]))
    torch.testing.assert_close(gaussians.means, turned.means, rtol=0, atol=1e-2)
    torch.testing.assert_close(gaussians.sh_rest, turned.sh_rest, rtol=0, atol=1e-2)
    x, y, z = camera.position.tolist()
    assert start.position == pytest.approx((x, -z, y), abs=1e-3)
    # In front is the ball of radius 0.6 around the origin, at a distance of 3.
    distance = math.dist(start.position, start.target)
    assert distance == pytest.approx(2.4, abs=0.3)
    assert math.dist(start.target, (0, 0, 0)) == pytest.approx(3 - distance, abs=0.05)
    assert start.fov == pytest.approx(math.degrees(2 * math.atan(0.5 / 0.9)), abs=1e-6)
    ours = picture(trained.gaussians, wide(camera, start))
    assert psnr(picture(gaussians, camera_of(start)), ours) > 45


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_scenes_of_unusual_scale_are_rescaled(trained, scale):
    change = _similarity(scale, rotation_from_quat(torch.tensor([0.9, 0.2, -0.3, 0.1])).tolist())
    odd = transform(trained.gaussians, change)
    cameras = [
        Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, change.apply_to_poses(c.cam_from_world))
        for c in trained.cameras
    ]
    gaussians, start, *_ = ready(odd, cameras)
    assert math.dist(start.position, start.target) == pytest.approx(3.0, abs=1e-3)
    ours = picture(trained.gaussians, wide(trained.cameras[0], start))
    assert psnr(picture(gaussians, camera_of(start)), ours) > 40
    alone = transform(odd, _similarity(scale, torch.eye(3).tolist()))  # a file without cameras
    gaussians, start, *_ = ready(alone, ())
    assert math.dist(start.position, start.target) == pytest.approx(3.0, abs=1e-3)
    there = overview(alone)
    assert psnr(picture(gaussians, camera_of(start)), picture(alone, camera_of(there))) > 40


def test_an_upright_scene_is_unchanged(trained):
    upright, *_ = ready(trained.gaussians, trained.cameras)
    change = _similarity(1.0, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    cameras = [
        Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, change.apply_to_poses(c.cam_from_world))
        for c in trained.cameras
    ]
    assert ready(upright, cameras)[0] is upright
    assert ready(trained.gaussians, [])[0] is trained.gaussians


def test_a_scene_without_cameras_is_levelled():
    """A tilted floor of flat Gaussians; other Gaussians are round."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(600, 3, generator=generator) - 0.5
    means[:300, 1] = 0.5
    log_scales = torch.full((600, 3), -3.0)
    log_scales[:300, 1] = -6.0
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(600, 1)
    logits, colors = torch.full((600,), 3.0), torch.zeros(600, 1, 3)
    level = Gaussians(means, log_scales, quats, logits, colors, torch.zeros(600, 0, 3))
    assert ready(level, ()).gaussians is level
    tilt = rotation_from_quat(torch.tensor([math.cos(0.25), 0.0, 0.0, math.sin(0.25)])).tolist()
    back = ready(transform(level, _similarity(1.0, tilt)), ()).gaussians
    floor = back.means[:300]
    assert float((floor[:, 1] - floor[:, 1].mean()).abs().max()) < 0.02
    assert float(floor[:, 1].mean()) > 0.4  # below


def test_empty_space_in_front_of_the_camera(trained):
    away = torch.tensor([0.0, 0.0, 50.0], dtype=torch.float64)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    camera = Camera(96, 72, 90.0, 90.0, 48.0, 36.0, look_at(away, 2 * away, up))
    _, start, *_ = ready(trained.gaussians, [camera])
    assert all(map(math.isfinite, (*start.position, *start.target, start.fov)))


def test_the_page_and_its_policy(trained):
    files, headers = site(
        Description("<b>&"), ready(trained.gaussians, trained.cameras, (1.0, 1.0, 1.0))
    )
    assert sorted(files) == ["", "index.css", "index.js", "scene.compressed.ply", "stops.webp"]
    page = files[""].content.decode()
    assert "<title>&lt;b&gt;&amp; - snowsplat</title>" in page
    (bootstrap,) = re.findall(r'id="sse-bootstrap">(.*?)</script>', page)
    settings = json.loads(bootstrap)["settings"]
    assert settings["background"]["color"] == [1.0, 1.0, 1.0]
    assert files["scene.compressed.ply"].content.startswith(b"ply\n")
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    (scripts,) = re.findall(r"script-src ([^;]*)", policy)
    assert "'unsafe-inline'" not in scripts
    assert "'unsafe-eval'" not in scripts
    assert "http" not in policy


@pytest.mark.browser
def test_a_real_browser_shows_our_render(trained, tmp_path):
    gaussians, start, *_ = ready(trained.gaussians, trained.cameras)
    ours = picture(gaussians, camera_of(start))
    files, headers = site(Description("scene"), ready(trained.gaussians, trained.cameras))
    with (
        WebServer(static_app(files), headers=headers) as server,
        Browser(WIDTH, HEIGHT, frames=5.0) as browser,
    ):
        page = browser.open(f"{server.url}?webgl&noui")
        page.wait_for(LOADED, 60)
        # At once, although the page has a film.
        x, y, z = start.position
        assert page.evaluate(PLACE) == pytest.approx([-x, -y, z], abs=1e-4)
        shown = page.wait_for_picture(lambda shown: psnr(shown, ours) > 30)
        page.screenshot(tmp_path / "viewer.png")  # for inspection
        assert shown.std() > 10
        assert np.corrcoef(shown.ravel(), ours.ravel())[0, 1] > 0.98
        assert not page.errors
        assert all(url.startswith((server.url, f"blob:{server.url[:16]}")) for url in page.requests)
        with_controls(browser, server, shown)


@pytest.mark.browser
def test_a_real_browser_shows_levels_of_detail(trained, tmp_path):
    """First the coarsest level, then the complete scene."""
    gaussians, start, *_ = ready(trained.gaussians, trained.cameras)
    ours = picture(gaussians, camera_of(start))

    def levels(scene: Gaussians) -> Path:
        write_lod(
            tmp_path / INDEX,
            GaussianArrays.from_gaussians(scene),
            sizes=LodSizes(leaf=200, file=400, coarsest=300),
        )
        return tmp_path / INDEX

    about = Description("scene")
    files, headers = site(about, ready(trained.gaussians, trained.cameras), levels)
    assert "scene.compressed.ply" not in files
    with (
        WebServer(static_app(files), headers=headers) as server,
        Browser(WIDTH, HEIGHT, frames=5.0) as browser,
    ):
        page = browser.open(f"{server.url}?webgl&noui")
        page.wait_for(LOADED, 60)
        page.wait_for_picture(lambda shown: psnr(shown, ours) > 29)
        counts = read_index(tmp_path / INDEX).counts()
        # Behind the camera, coarser levels are enough.
        page.wait_for(f"window.app.stats.frame.gsplats > {counts[0] // 2}", 60)
        assert page.evaluate("window.app.stats.frame.gsplats") <= counts[0]
        assert not page.errors
        assert all(url.startswith((server.url, f"blob:{server.url[:16]}")) for url in page.requests)
        loaded = [url.split("/")[-2] for url in page.requests if url.endswith("/meta.json")]
        assert loaded[0].startswith(f"{len(counts) - 1}_")
        assert {name[0] for name in loaded} >= {"0", str(len(counts) - 1)}


@pytest.mark.browser
def test_a_real_browser_shows_an_antialiased_scene(trained, tmp_path):
    """Its Gaussians are about as large as a pixel; without the filter they would look different."""
    small = trained.gaussians.clone()
    small.log_scales = small.log_scales.clamp(-6.0, -5.2)
    small.opacity_logits += 4.0
    small.antialiased = True
    shown_scene, start, *_ = ready(small, trained.cameras)
    ours = picture(shown_scene, camera_of(start))
    unfiltered = dataclasses.replace(shown_scene, antialiased=False)
    files, headers = site(Description("scene"), ready(small, trained.cameras))
    with (
        WebServer(static_app(files), headers=headers) as server,
        Browser(WIDTH, HEIGHT, frames=5.0) as browser,
    ):
        page = browser.open(f"{server.url}?webgl&noui")
        page.wait_for(LOADED, 60)
        shown = page.wait_for_picture(lambda shown: psnr(shown, ours) > 30)
        page.screenshot(tmp_path / "viewer.png")  # for inspection
        assert shown.mean() == pytest.approx(ours.mean(), rel=0.05)
        assert picture(unfiltered, camera_of(start)).mean() > 1.2 * shown.mean()
        assert not page.errors


def with_controls(browser: Browser, server: WebServer, before: np.ndarray) -> None:
    """A second viewer at the same time, with its controls.

    It begins in orbit. Dragging rotates the scene. The film follows the photos; dragging ends it,
    and the viewer is in orbit again.
    """
    mode = "window.sse.viewer.state.cameraMode"
    page: Page = browser.open(f"{server.url}?webgl")
    page.wait_for(LOADED, 60)
    assert page.evaluate(mode) == "orbit"
    # Except for the controls.
    still = page.wait_for_picture(lambda shown: psnr(shown, before) > 12)
    page.drag(WIDTH / 2, HEIGHT / 2, WIDTH / 2 + 120, HEIGHT / 2 + 20)
    turned = page.wait_for_picture(lambda shown: psnr(shown, still) < 22)
    page.evaluate(f"window.sse.viewer.seek({FILM_SECONDS / 2})")
    assert page.evaluate(mode) == "anim"
    page.wait_for_picture(lambda shown: psnr(shown, turned) < 22)
    page.drag(WIDTH / 2, HEIGHT / 2, WIDTH / 2 + 120, HEIGHT / 2 + 20)
    page.wait_for(f"{mode} === 'orbit'", 30)
    assert not page.errors


def test_the_film_follows_the_photos(trained):
    """It is a smooth path near the cameras."""
    film = ready(trained.gaussians, trained.cameras).film
    moved, _, alone, *_ = ready(trained.gaussians, trained.cameras[:1] * 3)
    assert alone == []  # all photos from one place
    assert len(moved) == len(trained.gaussians)
    assert len(film) == 121
    extent = max(math.dist(a.position, b.position) for a in film for b in film[::20])
    steps = [math.dist(a.position, b.position) for a, b in pairwise(film)]
    assert max(steps) < 0.1 * extent
    places = [camera.position.tolist() for camera in trained.cameras]
    for view in film:
        assert min(math.dist(view.position, (x, -z, y)) for x, y, z in places) < 0.3 * extent


def _similarity(scale: float, rotation: list[list[float]]) -> Similarity:
    matrix = torch.tensor(rotation, dtype=torch.float64)
    return Similarity(scale, matrix, torch.zeros(3, dtype=torch.float64))
