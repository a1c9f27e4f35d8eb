"""Metashape: the XML file of File > Export > Export Cameras.

A camera has chunk_from_cam in OpenCV axes, and its chunk or component the similarity from the frame
of the chunk to the world. Pixels are those of `Camera`, but the principal point is relative to the
centre of the photo. The lens model is in an appendix of the manual of Metashape.
"""

import logging
from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import equirectangular, fisheye, perspective
from snowsplat.data.readers.points import points_beside
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

logger = logging.getLogger(__name__)

_KINDS = ("frame", "fisheye", "equidistant_fisheye")
# Pixels: the skew of a fisheye lens, which no lens model has, is reported above this error.
_SKEW_ERROR = 0.5
# A world whose origin is further away, in extents of the cameras, is the Earth.
_FAR = 1000.0


def is_metashape(path: Path) -> bool:
    """Whether a file starts like cameras that Metashape has exported."""
    head = parse.head_of(path)
    return path.suffix.lower() == ".xml" and b"<document" in head and b"<chunk" in head


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras, and the points of a PLY file beside it."""
    chunks = [
        chunk
        for chunk in parse.load_xml(path).iter("chunk")
        if chunk.find("cameras") is not None and chunk.find("sensors") is not None
    ]
    if not chunks:
        raise parse.damaged(path, "has no cameras")
    cameras = [_cameras(chunk) for chunk in chunks]
    aligned = [sum(camera.find("transform") is not None for camera in each) for each in cameras]
    best = aligned.index(max(aligned))
    if len(chunks) > 1:
        logger.warning("%s: has %d chunks; using the largest", path, len(chunks))
    return _read_chunk(path, chunks[best], cameras[best], photos)


def _cameras(chunk: Element) -> list[Element]:
    """The cameras that are not disabled. The labels of their groups, which may be folders, tell
    cameras of one label apart."""
    cameras = chunk.find("cameras")
    assert cameras is not None
    found = [
        (group, camera)
        for group in cameras.iter()
        for camera in group.findall("camera")
        if camera.get("label") and camera.get("enabled", "true") not in ("false", "0")
    ]
    count = Counter(camera.get("label") for _, camera in found)
    for group, camera in found:
        if count[label := camera.get("label")] > 1:
            camera.set("label", f"{group.get('label', '')}/{label}")
    return [camera for _, camera in found]


def _read_chunk(
    path: Path, chunk: Element, cameras: list[Element], photos: PhotoFolder
) -> Reconstruction:
    sensors: dict[str | None, Element] = {
        sensor.get("id"): sensor for sensor in chunk.iter("sensor")
    }
    lenses: dict[str | None, Lens] = {}
    worlds = {
        component.get("id"): _similarity(f"{path}: component", component.find("transform"))
        for component in chunk.iter("component")
    }
    whole = _similarity(f"{path}: chunk", chunk.find("transform"))
    groups: dict[str | None, list[tuple[str, Lens, np.ndarray]]] = {}
    found = Reconstruction(total=len(cameras))
    for camera in cameras:
        label = str(camera.get("label"))
        where = f"{path}: camera {quoted(label)}"
        transform = camera.find("transform")
        if transform is None:
            continue
        with found.one(label):
            matrix = parse.numbers(where, (transform.text or "").split(), 16).reshape(4, 4)
            pose = parse.rigid(where, matrix[:3, :3], matrix[:3, 3])
            if (photo := found.photo(photos, label)) is None:
                continue
            key = camera.get("sensor_id")
            if key not in lenses:
                if key not in sensors:
                    raise parse.damaged(
                        where, f"has the sensor {quoted(key)}, which is not in the file"
                    )
                lenses[key] = _lens(f"{path}: sensor {quoted(key)}", sensors[key])
            groups.setdefault(camera.get("component_id"), []).append((photo, lenses[key], pose))
    if not groups:
        return found
    # Components are not aligned with each other.
    component = max(groups, key=lambda key: len(groups[key]))
    if len(groups) > 1:
        logger.warning(
            "%s: has %d components, which are not aligned with each other; using the largest",
            path,
            len(groups),
        )
    given = worlds.get(component)
    scale, world = _world(given if given is not None else whole, groups[component])
    for photo, lens, pose in groups[component]:
        world_from_cam = parse.rigid(
            path, world[:, :3] @ pose[:, :3], scale * world[:, :3] @ pose[:, 3] + world[:, 3]
        )
        found.add(photos, photo, lens, parse.inverse(world_from_cam))
    # The points may be in the frame of the chunk, or in that of the chunk in world units.
    similar = np.column_stack([scale * world[:, :3], world[:, 3]])
    points_beside(path.parent, found, (np.eye(4)[:3], similar, world))
    return found


def _similarity(where: str, transform: Element | None) -> tuple[float, np.ndarray] | None:
    """Scale and rigid part (3, 4) of world_from_chunk; None if it is not given."""
    if transform is None or transform.find("rotation") is None:
        return None
    rotation = parse.numbers(where, (transform.findtext("rotation") or "").split(), 9).reshape(3, 3)
    translation = parse.numbers(where, (transform.findtext("translation") or "0 0 0").split(), 3)
    scale = parse.number(where, {"scale": transform.findtext("scale")}, "scale", 1.0)
    if not scale > 0:
        raise parse.damaged(where, f"the scale {scale:g} is not positive")
    return scale, parse.rigid(where, rotation, translation)


def _world(
    given: tuple[float, np.ndarray] | None, cameras: list[tuple[str, Lens, np.ndarray]]
) -> tuple[float, np.ndarray]:
    """Scale and rigid part of world_from_chunk for training.

    The world of a chunk with GPS positions is the Earth, whose centre is too far away for 32-bit
    numbers. Then the origin is in the middle of the cameras, z is up, and y is north.
    """
    if given is None:
        return 1.0, np.eye(4)[:3]
    scale, world = given
    centres = np.stack([pose[:, 3] for _, _, pose in cameras])
    centres = scale * centres @ world[:, :3].T + world[:, 3]
    middle = centres.mean(0)
    extent = np.linalg.norm(centres - middle, axis=1).max()
    distance = np.linalg.norm(middle)
    if not distance > _FAR * extent or not distance > 1e6:
        return given
    up = middle / distance
    east = np.cross((0.0, 0.0, 1.0), up)
    if np.linalg.norm(east) < 1e-6:  # at a pole
        east = np.array([1.0, 0.0, 0.0])
    east /= np.linalg.norm(east)
    local = np.stack([east, np.cross(up, east), up])
    return scale, np.column_stack([local @ world[:, :3], local @ (world[:, 3] - middle)])


def _calibration(sensor: Element) -> Element | None:
    calibrations = sensor.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class", "adjusted") == "adjusted"]
    return next(iter(adjusted or calibrations), None)


def _lens(where: str, sensor: Element) -> Lens:
    kind = sensor.get("type", "frame")
    size = sensor.find("resolution")
    if kind == "spherical" and size is not None:
        return equirectangular(where, *_size(where, size))
    calibration = _calibration(sensor)
    if calibration is None:
        raise parse.damaged(where, "has no calibration")
    kind = calibration.get("type", kind)
    own = calibration.find("resolution")
    size = size if own is None else own
    if kind not in _KINDS or size is None:
        raise UserError(
            "{where}: the camera type {kind} is not supported; export undistorted photos and a "
            "COLMAP model from Metashape",
            where=where,
            kind=quoted(kind),
        )
    width, height = _size(where, size)
    values = {element.tag: element.text for element in calibration if element.text}

    def value(name: str) -> float:
        return parse.number(where, values, name, 0.0)

    focal, cx, cy = parse.number(where, values, "f"), value("cx"), value("cy")
    intrinsics = (focal + value("b1"), focal, width / 2 + cx, height / 2 + cy)
    radial = [value(name) for name in ("k1", "k2", "k3", "k4")]
    tangential = value("p2"), value("p1")  # x += p₁ (r² + 2 x²) + 2 p₂ x y
    skew = value("b2")
    if kind == "frame":
        return perspective(where, width, height, intrinsics, radial, tangential, skew)
    if abs(skew) * height > 2 * _SKEW_ERROR * focal:
        logger.warning(
            "%s: the skew (b2) of a fisheye lens is not supported: an error of up to %.1f pixels "
            "at the borders; optimise the alignment without b2 if that matters",
            where,
            abs(skew) * height / (2 * focal),
        )
    return fisheye(where, width, height, intrinsics, radial, tangential)


def _size(where: str, resolution: Element) -> tuple[int, int]:
    sides = {key: resolution.get(key) for key in ("width", "height")}
    return parse.size_of(
        where, parse.number(where, sides, "width"), parse.number(where, sides, "height")
    )


READER = program("Metashape", ("*.xml",), is_metashape, read)
