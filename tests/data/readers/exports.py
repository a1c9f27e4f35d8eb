"""Writes small exports of other programs, from their descriptions, independent of the readers.

Each function writes the files of one program into a folder, for the cameras of `rig`. It returns by
photo the pixels (P, 2) of `POINTS` as the equations of that program give them, with the centre of
the first pixel at (0.5, 0.5).
"""

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.data.points_ply import write_points

WIDTH, HEIGHT = 64, 48
NAMES = ("a.png", "b.png", "c.png", "d.png")
POINTS = np.random.default_rng(1).uniform(-0.5, 0.5, (40, 3))
COLORS = np.random.default_rng(2).integers(0, 256, (40, 3))


def rig() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """cam_from_world (R, t) in OpenCV axes of cameras around the origin, which look at it."""
    found = {}
    for number, name in enumerate(NAMES):
        centre = np.array([3 * math.cos(number), 3 * math.sin(number), 0.7 * number - 1])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, (0.1, 0.2, 1.0))
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        found[name] = rotation, -rotation @ centre
    return found


def photos(folder: Path, names=NAMES, size=(WIDTH, HEIGHT)) -> None:
    """Write the photos of some cameras, in one colour each."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        Image.new("RGB", size, (40 * number, 90, 20)).save(folder / name)


def painted_photos(folder: Path) -> None:
    """Write photos in which the points are seen as squares, by a camera with the focal length 55
    in the centre."""
    photos(folder)
    for name in NAMES:
        x, y, z = in_camera(name)
        columns, rows = (55 * x / z + WIDTH / 2).astype(int), (55 * y / z + HEIGHT / 2).astype(int)
        picture = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
        for i in np.argsort(-z):
            picture[rows[i] - 1 : rows[i] + 2, columns[i] - 1 : columns[i] + 2] = COLORS[i]
        Image.fromarray(picture).save(folder / name)


def in_camera(name: str) -> np.ndarray:
    """`POINTS` in the frame of a camera, (3, P)."""
    rotation, translation = rig()[name]
    return rotation @ POINTS.T + translation[:, None]


def brown(x, y, k, p1, p2):
    """Positions with distortion: radial by r², r⁴, …, and tangential by p1 along x, p2 along y."""
    r2 = x * x + y * y
    radial = 1 + sum(value * r2**n for n, value in enumerate(k, 1))
    u = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    v = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return u, v


def points(folder: Path, xyz=POINTS, name="points.ply") -> None:
    """Write a point cloud."""
    write_points(folder / name, xyz, COLORS)


def metashape(folder: Path, kind="frame", k=(0.03, -0.02, 0.01, 0.0), b1=0.7, b2=0.0, world=True):
    """cameras.xml, with a chunk of another scale and rotation than the world, and a photo that is
    not aligned."""
    f, cx, cy, p1, p2 = 55.0, 1.5, -0.8, 0.002, -0.003
    turn, shift, scale = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]), 2.5
    lines, expected = [], {}
    for number, (name, (rotation, translation)) in enumerate(rig().items()):
        matrix = np.eye(4)
        # chunk_from_cam: a point of the world is scale · turn · x + shift of the chunk.
        centre = -rotation.T @ translation
        matrix[:3, :3] = turn.T @ rotation.T if world else rotation.T
        matrix[:3, 3] = turn.T @ (centre - shift) / scale if world else centre
        text = " ".join(repr(float(v)) for v in matrix.ravel())
        label = Path(name).stem
        lines.append(
            f'<camera id="{number}" sensor_id="0" component_id="0" label="{label}">'
            f"<transform>{text}</transform></camera>"
        )
        x, y, z = in_camera(name)
        x, y = x / z, y / z
        if kind == "fisheye":
            r0 = np.hypot(x, y)
            x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
        u, v = brown(x, y, k, p1, p2)
        expected[name] = np.column_stack(
            [WIDTH / 2 + cx + u * f + u * b1 + v * b2, HEIGHT / 2 + cy + v * f]
        )
    lines.append('<camera id="9" sensor_id="0" label="not_aligned"/>')
    similar = " ".join(map(str, turn.ravel())), " ".join(map(str, shift)), scale
    transform = "<transform><rotation>{}</rotation><translation>{}</translation><scale>{}</scale>"
    coefficients = "".join(f"<k{i}>{value}</k{i}>" for i, value in enumerate(k, 1))
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">'
        f'<chunk label="Chunk 1" enabled="true"><sensors next_id="1"><sensor id="0" type="{kind}">'
        f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
        f'<calibration type="{kind}" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{WIDTH}" '
        f'height="{HEIGHT}"/><f>{f}</f><cx>{cx}</cx><cy>{cy}</cy><b1>{b1}</b1><b2>{b2}</b2>{coefficients}'
        f"<p1>{p1}</p1><p2>{p2}</p2></calibration></sensor></sensors>"
        + (
            f"<components><component id='0'>{transform.format(*similar)}</transform></component>"
            "</components>"
            if world
            else ""
        )
        + f"<cameras>{''.join(lines)}</cameras></chunk></document>"
    )
    photos(folder / "images")
    points(folder)
    return expected


def realityscan(folder: Path, newer=False):
    """cameras.csv; ``newer``: with the names of columns of RealityScan 2."""
    f35, px, py = 30.0, 0.01, -0.02
    k, (t1, t2) = (0.05, -0.01, 0.004), (0.002, -0.001)
    unit = max(WIDTH, HEIGHT)
    columns = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
    if newer:
        columns = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
    rows, expected = [columns], {}
    for name, (rotation, translation) in rig().items():
        x, y, alt = -rotation.T @ translation
        # world_from_cam with y up and z backwards is Rz(−heading) Rx(pitch) Ry(roll): its third
        # row is (−cos p sin r, sin p, cos p cos r), its second column (sin h cos p, cos h cos p,
        # sin p).
        m = rotation.T @ np.diag([1.0, -1, -1])
        pitch = math.asin(m[2, 1])
        roll = math.atan2(-m[2, 0], m[2, 2])
        heading = math.atan2(m[0, 1], m[1, 1])
        angles = [math.degrees(a) for a in (heading, pitch, roll)]
        rows.append(",".join(map(str, (name, x, y, alt, *angles, f35, px, py, *k, 0, t1, t2))))
        a, b, z = in_camera(name)
        u, v = brown(a / z, b / z, k, t1, t2)
        expected[name] = np.column_stack(
            [
                (f35 / 36 * u + px) * unit + WIDTH / 2,
                (f35 / 36 * v + py) * unit + HEIGHT / 2,
            ]
        )
    (folder / "cameras.csv").write_text("\n".join(rows) + "\n")
    photos(folder / "images")
    points(folder)
    return expected


def bundler(folder: Path):
    """bundle.out and list.txt, with a photo that is not aligned."""
    f, k1, k2 = 60.0, 0.02, -0.03
    lines, expected = ["# Bundle file v0.3", f"{len(NAMES) + 1} {len(POINTS)}"], {}
    for name, (rotation, translation) in rig().items():
        flipped, moved = np.diag([1.0, -1, -1]) @ rotation, translation * (1, -1, -1)
        lines += [f"{f} {k1} {k2}", *(" ".join(map(repr, r)) for r in flipped.tolist())]
        lines.append(" ".join(map(repr, moved.tolist())))
        x, y, z = flipped @ POINTS.T + moved[:, None]
        a, b = -x / z, -y / z
        radial = f * (1 + k1 * (a * a + b * b) + k2 * (a * a + b * b) ** 2)
        expected[name] = np.column_stack([WIDTH / 2 + radial * a, HEIGHT / 2 - radial * b])
    lines += ["0 0 0"] + ["0 0 0"] * 4
    for xyz, color in zip(POINTS.tolist(), COLORS.tolist(), strict=True):
        lines += [" ".join(map(repr, xyz)), " ".join(map(str, color)), "1 0 5 1.5 -2.5"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"images/{n} 0 60.5\n" for n in [*NAMES, "e.png"]))
    photos(folder / "images")
    return expected


def polycam(folder: Path, corrected=True, sizes=True):
    """Keyframes with depth maps in millimetres, and maps of confidence."""
    keyframes = folder / "keyframes"
    prefix = "corrected_" if corrected else ""
    (keyframes / f"{prefix}cameras").mkdir(parents=True)
    (keyframes / "depth").mkdir()
    (keyframes / "confidence").mkdir()
    fx, fy, cx, cy = 50.0, 51.0, 31.0, 25.0
    expected = {}
    for name, (rotation, translation) in rig().items():
        pose = np.column_stack([rotation.T @ np.diag([1.0, -1, -1]), -rotation.T @ translation])
        values = {f"t_{i}{j}": float(pose[i, j]) for i in range(3) for j in range(4)}
        values |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        values |= {"width": WIDTH, "height": HEIGHT} if sizes else {}
        stem = Path(name).stem
        (keyframes / f"{prefix}cameras" / f"{stem}.json").write_text(json.dumps(values))
        x, y, z = in_camera(name)
        expected[name] = np.column_stack([fx * x / z + cx, fy * y / z + cy])
        depth = np.full((HEIGHT // 4, WIDTH // 4), 3000, np.uint16)
        Image.fromarray(depth).save(keyframes / "depth" / f"{stem}.png")
        confidence = Image.new("L", (WIDTH // 4, HEIGHT // 4), 127)
        confidence.save(keyframes / "confidence" / f"{stem}.png")
    photos(keyframes / f"{prefix}images")
    return expected


def record3d(folder: Path, rows=False):
    """metadata.json, with K by columns, or by ``rows``."""
    fx, fy, cx, cy = 50.0, 51.0, 31.0, 25.0
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    poses, expected = [], {}
    names = [f"{i}.png" for i in range(len(NAMES))]
    for name, new in zip(NAMES, names, strict=True):
        rotation, translation = rig()[name]
        m = rotation.T @ np.diag([1.0, -1, -1])
        w = math.sqrt(max(0.0, 1 + np.trace(m))) / 2
        x, y, z = (m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]) / np.array(4 * w)
        poses.append([x, y, z, w, *(-rotation.T @ translation)])
        a, b, depth = in_camera(name)
        expected[new] = np.column_stack([fx * a / depth + cx, fy * b / depth + cy])
    values = {"w": WIDTH, "h": HEIGHT, "K": (k if rows else k.T).ravel().tolist(), "fps": 60}
    (folder / "metadata.json").write_text(json.dumps(values | {"poses": poses}))
    photos(folder / "rgb", names)
    return expected


def openmvg(folder: Path, kind="pinhole_brown_t2"):
    """sfm_data.json, with a view that is not aligned."""
    name = {"pinhole_brown_t2": "disto_t2", "fisheye": "fisheye"}[kind]
    k = {"disto_t2": [0.03, -0.02, 0.01, 0.002, -0.003], "fisheye": [0.03, -0.02, 0.01, 0.005]}
    f, px, py = 55.0, 33.0, 22.5
    base = {"width": WIDTH, "height": HEIGHT, "focal_length": f, "principal_point": [px, py]}
    views, extrinsics, expected = [], [], {}
    for number, photo in enumerate([*NAMES, "e.png"]):
        data = {"local_path": "", "filename": photo, "width": WIDTH, "height": HEIGHT}
        data |= {"id_view": number, "id_intrinsic": number % 2, "id_pose": number}
        views.append({"key": number, "value": {"ptr_wrapper": {"id": 1, "data": data}}})
        if photo not in rig():
            continue
        rotation, translation = rig()[photo]
        pose = {"rotation": rotation.tolist(), "center": (-rotation.T @ translation).tolist()}
        extrinsics.append({"key": number, "value": pose})
        x, y, z = in_camera(photo)
        x, y = x / z, y / z
        r = np.hypot(x, y)
        if kind == "fisheye":
            a = np.arctan(r)
            d = a + sum(c * a**n for c, n in zip(k[name], (3, 5, 7, 9), strict=True))
            u, v = x * d / r, y * d / r
        else:
            *radial, t1, t2 = k[name]
            u, v = brown(x, y, radial, t2, t1)
        # The centre of the first pixel of OpenMVG is at (0, 0).
        expected[photo] = np.column_stack([f * u + px + 0.5, f * v + py + 0.5])
    wrapper = {"id": 2, "data": {**base, name: k[name]}}
    first = {"polymorphic_id": 2147483649, "polymorphic_name": kind, "ptr_wrapper": wrapper}
    second = {"polymorphic_id": 1, "ptr_wrapper": wrapper}
    scene = {"sfm_data_version": "0.3", "root_path": "/home/me/photos", "views": views}
    scene["intrinsics"] = [{"key": 0, "value": first}, {"key": 1, "value": second}]
    scene["extrinsics"] = extrinsics
    scene["structure"] = [
        {"key": i, "value": {"X": xyz, "observations": []}} for i, xyz in enumerate(POINTS.tolist())
    ]
    (folder / "sfm_data.json").write_text(json.dumps(scene))
    photos(folder / "images")
    return expected


def opensfm(folder: Path, kind="brown"):
    """reconstruction.json of two reconstructions; the second is larger."""
    lens = {
        "brown": {"focal_x": 0.9, "focal_y": 0.95, "c_x": 0.01, "c_y": -0.02, "k1": 0.03}
        | {"k2": -0.02, "k3": 0.01, "p1": 0.002, "p2": -0.003},
        "perspective": {"focal": 0.9, "k1": 0.05, "k2": -0.01},
        "fisheye": {"focal": 0.9, "k1": 0.05, "k2": -0.01},
    }[kind]
    camera = {"projection_type": kind, "width": WIDTH, "height": HEIGHT, **lens}
    shots, expected = {}, {}
    for name, (rotation, translation) in rig().items():
        angle = math.acos((np.trace(rotation) - 1) / 2)
        skew = (rotation - rotation.T) / (2 * math.sin(angle))
        vector = angle * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        shots[name] = {"rotation": vector.tolist(), "translation": translation.tolist()}
        shots[name]["camera"] = "v2 phone"
        x, y, z = in_camera(name)
        x, y = x / z, y / z
        if kind == "fisheye":
            r = np.hypot(x, y)
            x, y = x * np.arctan(r) / r, y * np.arctan(r) / r
        k1, k2, k3, p1, p2 = (lens.get(key, 0.0) for key in ("k1", "k2", "k3", "p1", "p2"))
        u, v = brown(x, y, (k1, k2, k3), p2, p1)
        u = lens.get("focal_x", lens.get("focal")) * u + lens.get("c_x", 0.0)
        v = lens.get("focal_y", lens.get("focal")) * v + lens.get("c_y", 0.0)
        # OpenSfM: the pixel with the whole number p is at ((p + 0.5) - size / 2) / larger side.
        unit = max(WIDTH, HEIGHT)
        expected[name] = np.column_stack([u * unit + WIDTH / 2, v * unit + HEIGHT / 2])
    cloud = {
        str(i): {"coordinates": xyz, "color": color}
        for i, (xyz, color) in enumerate(zip(POINTS.tolist(), COLORS.tolist(), strict=True))
    }
    scenes = [
        {"cameras": {"v2 phone": camera}, "shots": {"a.png": shots["a.png"]}, "points": {}},
        {"cameras": {"v2 phone": camera}, "shots": shots, "points": cloud},
    ]
    (folder / "reconstruction.json").write_text(json.dumps(scenes))
    photos(folder / "images")
    return expected


def alicevision(folder: Path, newer=True):
    """cameras.sfm of version 1.2.6, or of 1.2.0, whose focal length is in pixels."""
    k, fx, (ox, oy) = [0.03, -0.02, 0.01], 52.0, (1.5, -0.8)
    camera = {"intrinsicId": "7", "width": str(WIDTH), "height": str(HEIGHT)}
    if newer:
        camera |= {"type": "pinhole", "distortionType": "radialk3", "sensorWidth": "23.5"}
        camera |= {"focalLength": str(fx * 23.5 / WIDTH), "pixelRatio": "1"}
        camera["principalPoint"] = [str(ox), str(oy)]
    else:
        camera |= {"type": "radial3", "pxFocalLength": str(fx)}
        camera["principalPoint"] = [str(WIDTH / 2 + ox), str(HEIGHT / 2 + oy)]
    camera["distortionParams"] = list(map(str, k))
    views, poses, expected = [], [], {}
    for number, (name, (rotation, translation)) in enumerate(rig().items()):
        ids = {"viewId": str(number), "poseId": str(number), "intrinsicId": "7"}
        views.append(ids | {"path": f"/home/me/photos/{name}"})
        transform = {"rotation": list(map(str, rotation.T.ravel().tolist()))}
        transform["center"] = list(map(str, (-rotation.T @ translation).tolist()))
        poses.append({"poseId": str(number), "pose": {"transform": transform, "locked": "0"}})
        x, y, z = in_camera(name)
        x, y = x / z, y / z
        u, v = brown(x, y, k, 0.0, 0.0)
        # The centre of the first pixel of AliceVision is at (0, 0).
        expected[name] = np.column_stack(
            [fx * u + WIDTH / 2 + ox + 0.5, fx * v + HEIGHT / 2 + oy + 0.5]
        )
    version = ["1", "2", "6" if newer else "0"]
    scene = {"version": version, "views": views, "intrinsics": [camera], "poses": poses}
    (folder / "cameras.sfm").write_text(json.dumps(scene, indent=1))
    photos(folder / "images")
    points(folder)
    return expected


def llff(folder: Path):
    """poses_bounds.npy of photos four times as large as those in the folder."""
    f = 220.0
    rows, expected = [], {}
    for name, (rotation, translation) in rig().items():
        right, down, forward = rotation
        centre = -rotation.T @ translation
        sizes = np.array([4 * HEIGHT, 4 * WIDTH, f])
        rows.append([*np.column_stack([down, right, -forward, centre, sizes]).ravel(), 1.0, 9.0])
        x, y, z = in_camera(name)
        expected[name] = np.column_stack([f * x / z + 2 * WIDTH, f * y / z + 2 * HEIGHT])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    photos(folder / "images")
    return expected


def matrices(folder: Path, layout: str):
    """A layout of `snowsplat.data.readers.pose_matrices`, with depth maps if it has any; of cameras
    without distortion, except for TUM."""
    fx, fy, cx, cy = 55.0, 52.0, 30.5, 25.0
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    integer = k - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # the centre of the first pixel is (0, 0)
    worlds = []
    for rotation, translation in rig().values():
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([rotation.T, -rotation.T @ translation])
        worlds.append(matrix)

    def text(path: str, *rows, head="") -> None:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        lines = (" ".join(repr(float(value)) for value in row) for row in rows)
        (folder / path).write_text(head + "\n".join(lines) + "\n")

    folder.mkdir(exist_ok=True)

    def depth(path: str, unit: float) -> None:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((6, 8), round(1.25 / unit), np.uint16)).save(folder / path)

    if layout == "ScanNet":
        names = [f"color/{i}.jpg" for i in range(4)]
        for i, world in enumerate(worlds):
            text(f"pose/{i}.txt", *world)
            depth(f"depth/{i}.png", 1e-3)
        text("pose/4.txt", *np.full((4, 4), -np.inf))  # tracking was lost
        text("intrinsic/intrinsic_color.txt", *np.pad(k, (0, 1)))
    elif layout == "NSVF":
        names = [f"rgb/{i // 3}_{i:04d}.png" for i in range(4)]
        for name, world in zip(names, worlds, strict=True):
            text(f"pose/{name[4:-4]}.txt", *world)
        text("intrinsics.txt", (fx, cx, cy, 0), (0, 0, 0), (0,), (1,), (HEIGHT, WIDTH))
        fy = fx
    elif layout == "KITTI":
        names = [f"image_2/{i:06d}.png" for i in range(4)]
        shift = np.eye(4)
        shift[0, 3] = 0.1  # of the colour camera, from the grey one
        text("poses.txt", *(np.ravel((world @ shift)[:3]) for world in worlds))
        projection = integer @ np.linalg.inv(np.linalg.inv(shift))[:3]
        lines = [f"P{i}: " + " ".join(map(repr, projection.ravel().tolist())) for i in (0, 2)]
        (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    elif layout == "MVSNet":
        names = [f"images/{i:08d}.jpg" for i in range(4)]
        for i, world in enumerate(worlds):
            text(f"cams/{i:08d}_cam.txt", *np.linalg.inv(world), head="extrinsic\n")
            with open(folder / f"cams/{i:08d}_cam.txt", "a") as file:
                file.write("\nintrinsic\n")
                np.savetxt(file, k)
                file.write("\n0.5 0.1\n")
    elif layout == "IDR":
        names = [f"image/{i:06d}.png" for i in range(4)]
        cameras = {}
        for i, world in enumerate(worlds):
            cameras[f"scale_mat_{i}"] = np.diag([3.0, 3, 3, 1])
            cameras[f"world_mat_{i}"] = -2.5 * np.pad(integer, (0, 1)) @ np.linalg.inv(world)
        np.savez(folder / "cameras_sphere.npz", **cameras)
    elif layout == "TUM":
        names = [f"rgb/13{i}.04.png" for i in range(4)]
        rows = []
        for i, world in enumerate(worlds):
            w, x, y, z = quaternion(world[:3, :3])
            rows += [(130 + i + 0.039, *world[:3, 3], x, y, z, w), (130.5 + i, 9, 9, 9, 0, 0, 0, 1)]
            depth(f"depth/13{i}.05.png", 1 / 5000)
        text("groundtruth.txt", *rows, head="# time tx ty tz qx qy qz qw\n")
        text("intrinsics.txt", (fx, fy, cx, cy, 0.03, -0.02, 0.002, -0.003, 0.01))
    elif layout == "Replica":
        names = [f"results/frame{i:06d}.jpg" for i in range(4)]
        text("traj.txt", *(world.ravel() for world in worlds))
        camera = {"w": WIDTH, "h": HEIGHT, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
        (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
        for i in range(4):
            depth(f"results/depth{i:06d}.png", 1 / 6553.5)
    elif layout == "Tanks and Temples":
        names = [f"Barn/{i + 1:06d}.jpg" for i in range(4)]
        text("Barn.log", *(row for i, w in enumerate(worlds) for row in [(i, i, 0), *w]))
        text("intrinsics.txt", (fx, fy, cx, cy))
    else:
        names = [f"frame_{i:05d}.jpg" for i in range(4)]
        for i, world in enumerate(worlds):
            pose = (world @ np.diag([1.0, -1, -1, 1])).ravel().tolist()
            frame = {"cameraPoseARFrame": pose, "intrinsics": k.ravel().tolist(), "time": i}
            (folder / f"frame_{i:05d}.json").write_text(json.dumps(frame))
            depth(f"depth_{i:05d}.png", 1e-3)
    for name in names:
        photos((folder / name).parent, [Path(name).name])
    expected = {}
    for number, name in enumerate(names):
        x, y, z = in_camera(NAMES[number])
        x, y = x / z, y / z
        if layout == "TUM":
            k1, k2, p1, p2, k3 = 0.03, -0.02, 0.002, -0.003, 0.01
            x, y = brown(x, y, (k1, k2, k3), p2, p1)
        expected[Path(name).name] = np.column_stack([fx * x + cx, fy * y + cy])
    return expected


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w x y z of a rotation (3, 3): the eigenvector of Bar-Itzhack's matrix (2000)."""
    q = rotation
    n = np.array(
        [
            [q[0, 0] + q[1, 1] + q[2, 2], q[2, 1] - q[1, 2], q[0, 2] - q[2, 0], q[1, 0] - q[0, 1]],
            [0, q[0, 0] - q[1, 1] - q[2, 2], q[0, 1] + q[1, 0], q[0, 2] + q[2, 0]],
            [0, 0, q[1, 1] - q[0, 0] - q[2, 2], q[1, 2] + q[2, 1]],
            [0, 0, 0, q[2, 2] - q[0, 0] - q[1, 1]],
        ]
    )
    return np.linalg.eigh(n, UPLO="U")[1][:, -1]


def realitycapture(folder: Path):
    """An XMP file for each photo."""
    unit, focal, px, py = max(WIDTH, HEIGHT), 30.0, 0.02, -0.03
    k1, k2, k3, t1, t2 = 0.03, -0.02, 0.01, 0.002, -0.003
    expected = {}
    folder.mkdir(exist_ok=True)
    for name, (rotation, translation) in rig().items():
        attributes = {
            "DistortionModel": "brown3t2",
            "FocalLength35mm": focal,
            "Skew": 0,
            "AspectRatio": 1,
            "PrincipalPointU": px,
            "PrincipalPointV": py,
        }
        head = " ".join(f'xcr:{key}="{value}"' for key, value in attributes.items())
        elements = {
            "Rotation": rotation.ravel(),
            "Position": -rotation.T @ translation,
            "DistortionCoeficients": (k1, k2, k3, 0, t1, t2),
        }
        body = "".join(
            f"<xcr:{key}>{' '.join(repr(float(v)) for v in values)}</xcr:{key}>"
            for key, values in elements.items()
        )
        (folder / name).with_suffix(".xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
            'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
            f'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" {head}>{body}'
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )
        x, y, z = in_camera(name)
        x, y = x / z, y / z
        u, v = brown(x, y, (k1, k2, k3), t1, t2)
        f = focal / 36 * unit
        expected[name] = np.column_stack(
            [f * u + px * unit + WIDTH / 2, f * v + py * unit + HEIGHT / 2]
        )
    photos(folder)
    return expected
