"""`repairs`: the usual mistakes in camera poses, each with the cameras that it should have been.

Exporters confuse the axes of the camera, camera-to-world with world-to-camera, the order of the
numbers of a quaternion, units, and the frame of the points. The judge tests each of them on the
data: if one of them fits and the given cameras do not, the mistake has a name.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import torch

from snowsplat.data.judge.rig import Rig
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.util.messages import Message, message

_OPENGL = np.diag([1.0, -1.0, -1.0])
_MIRROR = np.diag([-1.0, 1.0, 1.0])
# Factors of focal lengths and of units: steps of 12%. A match of photos tolerates half of it.
_ZOOMS = 1.12 ** np.arange(-42, 43)
_UNITS = 1.12 ** np.arange(-82, 83)


@dataclass(frozen=True)
class Repair:
    """Cameras and points without one mistake.

    Attributes:
        about: "axes", "direction", "focal length" …, as in `Finding`.
        mistake: what is wrong with the given ones: "the poses are inverted …"
        rig: the cameras.
        points: (3, 3), a linear map of the points to the frame of these cameras; None: the same
            points.
    """

    about: str
    mistake: Message
    rig: Rig
    points: np.ndarray | None = None


def _signed_permutations() -> list[np.ndarray]:
    """The 48 (3, 3) matrices that exchange and flip axes; the identity is the first."""
    matrices = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            matrices.append(matrix)
    return matrices


_AXES = _signed_permutations()
_ROTATIONS = [m for m in _AXES if np.linalg.det(m) > 0]


def pose_repairs(rig: Rig) -> Iterator[Repair]:
    """Mistakes in the poses and lenses, which do not concern points. The usual ones come first."""
    yield Repair(
        "axes",
        message(
            "the y and z axes of the cameras are flipped (transforms.json has OpenGL axes: y up, z "
            "backward; COLMAP has OpenCV axes: y down, z forward)"
        ),
        _turned(rig, _OPENGL),
    )
    for before, after in product((np.eye(3), _OPENGL), repeat=2):
        yield Repair(
            "direction",
            message(
                "the poses are inverted: world-to-camera where camera-to-world is expected, or the "
                "reverse"
            ),
            _turned(_inverted(_turned(rig, before)), after),
        )
    for before, after in product((np.eye(3), _OPENGL), repeat=2):
        turned = _turned(rig, before)
        transposed = turned.rotation.transpose(0, 2, 1)
        text = message("the rotations of the poses are transposed")
        yield Repair("direction", text, _turned(turned.moved(transposed, turned.positions), after))
        kept = replace(turned, rotation=transposed)
        yield Repair("direction", text, _turned(kept, after))
    yield Repair(
        "positions",
        message(
            "the translations of the poses are camera positions, where -R·position is expected"
        ),
        rig.moved(rig.rotation, rig.translation),
    )
    yield Repair(
        "positions",
        message("the positions of the poses are translations, where -R'·translation is expected"),
        replace(rig, translation=rig.positions),
    )
    for given, expected, order in (
        ("x y z w", "w x y z", (3, 0, 1, 2)),
        ("w x y z", "x y z w", (1, 2, 3, 0)),
    ):
        quats = quat_from_rotation(torch.from_numpy(rig.rotation))[:, order]
        yield Repair(
            "quaternions",
            message(
                "the numbers of the quaternions are in the order {given} where {expected} is "
                "expected",
                given=given,
                expected=expected,
            ),
            replace(rig, rotation=rotation_from_quat(quats).numpy()),
        )
    for axes in _ROTATIONS[1:]:
        yield Repair(
            "axes",
            message(
                "the axes of the cameras are exchanged or flipped: x must be right, y down and z "
                "forward in COLMAP models, and x right, y up and z backward in transforms.json"
            ),
            _turned(rig, axes),
        )
    mirrored = message("the poses are mirrored (a left-handed frame)")
    for axes in _ROTATIONS:
        yield Repair("axes", mirrored, _mirrored(rig, axes))
    yield from zooms(rig)


def zooms(rig: Rig) -> Iterator[Repair]:
    """Other focal lengths."""
    for factor in _ZOOMS:
        text = message("the focal length is {times} the right one", times=_times(1 / factor))
        yield Repair("focal length", text, rig.zoomed(factor))


def point_repairs(rig: Rig) -> Iterator[Repair]:
    """Mistakes in the frame of the points against that of the poses."""
    for axes in _AXES[1:]:
        text = message("the axes of the points are mirrored against those of the poses")
        if np.linalg.det(axes) > 0:
            text = message(
                "the axes of the points are exchanged or flipped against those of the poses"
            )
        yield Repair("points", text, rig, axes)
    for factor in _UNITS:
        text = message("the unit of the poses is {times} that of the points", times=_times(factor))
        yield Repair("units", text, rig, factor * np.eye(3))


def _times(factor: float) -> Message:
    """ "3 times" or "1/3 of", with two digits."""
    number = float(f"{max(factor, 1 / factor):.2g}")
    if factor >= 1:
        return message("{number:,g} times", number=number)
    return message("1/{number:,g} of", number=number)


def _turned(rig: Rig, axes: np.ndarray) -> Rig:
    """The cameras turned about their centres: other axes, (3, 3)."""
    return rig.moved(axes @ rig.rotation, rig.positions)


def _inverted(rig: Rig) -> Rig:
    return rig.moved(rig.rotation.transpose(0, 2, 1), rig.translation)


def _mirrored(rig: Rig, axes: np.ndarray) -> Rig:
    """The mirror image of the poses. A mirrored rotation is none, so one camera axis is flipped."""
    return rig.moved(axes @ _MIRROR @ rig.rotation @ -np.eye(3), -rig.positions)
