"""Figures of the page "Structure from motion", of the photos and the database of the demo."""

from pathlib import Path

import numpy as np
import pycolmap
from drawing import Drawing
from PIL import Image

import scene

FIRST, SECOND = "IMG_0013.jpg", "IMG_0015.jpg"
WIDTH = 330.0


def folder() -> Path:
    return scene.dataset_folder() / "distorted"


def photo(panel: Drawing, name: str, low: tuple, high: tuple) -> None:
    image = Image.open(scene.dataset_folder() / "input" / name).convert("RGB")
    image = image.resize((440, round(440 * image.height / image.width)))
    panel.picture(np.asarray(image), low, high, quality=60)


def panel_of(camera: pycolmap.Camera, title: str) -> Drawing:
    """A panel in the pixels of a photo."""
    height = WIDTH * camera.height / camera.width + 24
    x, y = (0, camera.width), (camera.height, 0)
    panel = Drawing(WIDTH, height, x=x, y=y, margins=(0, 24, 0, 0))
    panel.title(title)
    return panel


def model() -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(folder() / "sparse" / "0"))


def image_of(found: pycolmap.Reconstruction, name: str) -> pycolmap.Image:
    return next(image for image in found.images.values() if image.name == name)


def features(database: pycolmap.Database, ids: dict[str, int], camera: pycolmap.Camera) -> None:
    """Keypoints with their sizes and orientations: x, y, and a 2×2 matrix per row."""
    keypoints = np.asarray(database.read_keypoints(ids[FIRST]))
    panel = panel_of(camera, "features")
    photo(panel, FIRST, (0, camera.height), (camera.width, 0))
    chosen = keypoints[np.random.default_rng(0).choice(len(keypoints), 160, replace=False)]
    angle = np.linspace(0, 2 * np.pi, 17)[:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for x, y, *matrix in chosen:
        axes = 3 * np.reshape(matrix, (2, 2))
        panel.line(np.array([x, y]) + (axes @ circle).T, "orange", 1.1, closed=True)
        panel.line([(x, y), (x + axes[0, 0], y + axes[1, 0])], "orange", 1.1)
    panel.save("sfm-features", "A photo with circles at 160 of its features")
    print(len(keypoints), "features")


def matches(database: pycolmap.Database, ids: dict[str, int], camera: pycolmap.Camera) -> None:
    """The matches of two photos: those that agree with one relative pose, and the others."""
    first, second = (np.asarray(database.read_keypoints(ids[n]))[:, :2] for n in (FIRST, SECOND))
    found = np.asarray(database.read_matches(ids[FIRST], ids[SECOND]))
    good = {
        tuple(m) for m in database.read_two_view_geometry(ids[FIRST], ids[SECOND]).inlier_matches
    }
    w, h = camera.width, camera.height
    panel = Drawing(WIDTH, 24 + 2 * WIDTH * h / w, x=(0, w), y=(2 * h, 0), margins=(0, 24, 0, 0))
    panel.title("matches")
    photo(panel, FIRST, (0, h), (w, 0))
    photo(panel, SECOND, (0, 2 * h), (w, h))
    rng = np.random.default_rng(1)
    wrong = [m for m in map(tuple, found) if m not in good]
    right = sorted(good)
    for rows, colour, count in ((right, "green", 40), (wrong, "red", 12)):
        for i in rng.permutation(len(rows))[:count]:
            a, b = rows[i]
            panel.line([first[a], second[b] + (0, h)], colour, 1)
    panel.save("sfm-matches", "Two photos with lines between matched features")
    print(len(found), "matches;", len(good), "agree")


def two_views(found: pycolmap.Reconstruction) -> None:
    """The epipolar lines of some points of the first photo, in the second one."""
    one, two = (image_of(found, name) for name in (FIRST, SECOND))
    camera = found.cameras[one.camera_id]
    common = [p for p in one.points2D if p.has_point3D()]
    seen = {p.point3D_id: p.xy for p in two.points2D if p.has_point3D()}
    pairs = [(p.xy, seen[p.point3D_id]) for p in common if p.point3D_id in seen]
    order = np.random.default_rng(4).permutation(len(pairs))[:6]
    world = one.cam_from_world().inverse()
    panels = panel_of(camera, "points"), panel_of(camera, "their epipolar lines")
    for panel, name in zip(panels, (FIRST, SECOND), strict=True):
        photo(panel, name, (0, camera.height), (camera.width, 0))
    colours = ("blue", "orange", "green", "violet", "red", "ink")
    for i, colour in zip(order, colours, strict=True):
        start, end = pairs[i]
        panels[0].dot(start, colour, 4.5)
        ray = np.append(camera.cam_from_img(start[None])[0], 1.0)
        line = []
        for depth in np.geomspace(0.4, 60, 200):
            xyz = two.cam_from_world() * (world * (depth * ray))
            pixel = camera.img_from_cam(xyz[None])[0] if xyz[2] > 0.05 else None
            if (
                pixel is not None
                and 0 <= pixel[0] <= camera.width
                and 0 <= pixel[1] <= camera.height
            ):
                line.append(pixel)
        panels[1].line(line, colour, 1.8)
        panels[1].dot(end, colour, 4.5)
    panels[0].save("sfm-points", "A photo with six marked points")
    panels[1].save("sfm-epipolar", "Another photo: each point is on a curve")


def triangulation(found: pycolmap.Reconstruction) -> None:
    """The rays of one point, from above, in the plane of its cameras."""
    point = max(found.points3D.values(), key=lambda p: p.track.length())
    images = [found.images[e.image_id] for e in point.track.elements]
    centres = np.array([image.projection_center() for image in images])
    everywhere = np.array([p.xyz for p in found.points3D.values()])
    up = np.linalg.svd(centres - centres.mean(0))[2][:2]
    flat = (centres - point.xyz) @ up.T
    near = everywhere[np.linalg.norm(everywhere - point.xyz, axis=1) < 3] - point.xyz
    limit = 1.1 * np.abs(flat).max()
    panel = Drawing(
        WIDTH, 260, x=(-limit, limit), y=(-limit, limit), equal=True, margins=(2, 24, 2, 2)
    )
    panel.title("one point, seen in many photos")
    for xy in near[np.random.default_rng(0).permutation(len(near))[:500]] @ up.T:
        panel.dot(xy, "line", 1)
    for xy in flat:
        panel.line([xy, (0, 0)], "blue", 0.9, opacity=0.6)
        panel.dot(xy, "blue", 3)
    panel.dot((0, 0), "orange", 5)
    panel.save("sfm-triangulation", "Rays from many cameras meet in one point")
    print("track of", point.track.length(), "photos, error", round(point.error, 2))


def errors(found: pycolmap.Reconstruction) -> np.ndarray:
    """The distances of all observations from the images of their points, in pixels."""
    distances = []
    for image in found.images.values():
        camera = found.cameras[image.camera_id]
        own = [p for p in image.points2D if p.has_point3D()]
        xyz = np.array([image.cam_from_world() * found.points3D[p.point3D_id].xyz for p in own])
        pixels = np.array(camera.img_from_cam(xyz))
        distances.append(np.linalg.norm(pixels - np.array([p.xy for p in own]), axis=1))
    return np.concatenate(distances)


def adjustment(found: pycolmap.Reconstruction) -> None:
    """Reprojection errors of poses that are 0.3° wrong about each axis, before and after it."""
    rng = np.random.default_rng(0)
    for frame in found.frames.values():
        noise = pycolmap.Rotation3d(rng.normal(0, np.radians(0.3), 3))
        frame.rig_from_world = pycolmap.Rigid3d(noise, np.zeros(3)) * frame.rig_from_world
    before = errors(found)
    pycolmap.bundle_adjustment(found)
    after = errors(found)
    panel = Drawing(WIDTH, 240, x=(-2, 1.5), y=(0, 0.17), margins=(38, 26, 10, 40))
    ticks = [(value, f"{10.0**value:g}") for value in (-2, -1, 0, 1)]
    panel.axes("error of an observation (pixels)", "share", x_ticks=ticks, counts=(4, 4))
    for values, colour, words, dy in (
        (before, "orange", "before", 14),
        (after, "blue", "after", 32),
    ):
        share, edges = np.histogram(np.log10(values.clip(1e-9)), 60, (-2, 1.5))
        panel.line(zip(edges[:-1], share / len(values), strict=True), colour, 2.2)
        panel.text((1.5, 0.17), words, colour, anchor="end", dx=-6, dy=dy)
        print(words, "median", round(float(np.median(values)), 3))
    panel.save("sfm-adjustment", "The errors are smaller after bundle adjustment")


def lens(found: pycolmap.Reconstruction) -> None:
    """How far the lens moves a ray from the image of a pinhole with the same focal length."""
    (camera, *_) = found.cameras.values()
    focal = camera.mean_focal_length()
    radius = np.linspace(0, 0.5 * np.hypot(camera.width, camera.height), 40)
    rays = np.stack([radius / focal, 0 * radius, 1 + 0 * radius], axis=1)
    pixels = np.array(camera.img_from_cam(rays))[:, 0] - camera.principal_point_x
    moved = pixels - radius
    low, high = min(moved.min(), 0), max(moved.max(), 0)
    pad = 0.1 * (high - low)
    range_ = (low - pad, high + pad)
    panel = Drawing(WIDTH, 240, x=(0, radius[-1]), y=range_, margins=(44, 26, 10, 40))
    panel.axes("distance from the middle (pixels)", "moved by (pixels)")
    panel.line(zip(radius, moved, strict=True), "blue", 2.2)
    panel.save("sfm-lens", "The lens moves rays more, the farther they are from the middle")
    print(camera.model, camera.params, "at the corner", round(float(moved[-1]), 2))


def main() -> None:
    found = model()
    (camera, *_) = found.cameras.values()
    with pycolmap.Database.open(str(folder() / "database.db")) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        features(database, ids, camera)
        matches(database, ids, camera)
    two_views(found)
    triangulation(found)
    lens(found)
    adjustment(found)


if __name__ == "__main__":
    main()
